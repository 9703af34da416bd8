//! The page's scene for Foxglove and Lichtblick, over Foxglove's WebSocket protocol, for their own
//! panels and plots.
//!
//! The crate `foxglove` implements the protocol, in threads of its own. A slow client loses its
//! oldest messages. Pictures and close-ups are made only while a client has subscribed to them.
//!
//! | topic | schema |
//! | --- | --- |
//! | `/tf` | `foxglove.FrameTransforms`: camera and neighbours in the frame `observer` |
//! | `/scene` | `foxglove.SceneUpdate`: bodies, ellipsoids, names |
//! | `/pose/NAME` | `foxglove.PoseInFrame` |
//! | `/sphere`, `/sphere/annotations` | `foxglove.CompressedImage`, `foxglove.ImageAnnotations` |
//! | `/closeup/NAME` | `foxglove.CompressedImage`: picture, model, residual |
//! | `/frames`, `/stages` | the page's messages `frame` and `stages` as JSON, for plots |

mod annotations;
mod scene;
mod values;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context as _;
use flockeye_config::{Flow, Resolved};
use flockeye_contract::FrameStamp;
use flockeye_convert::isometry;
use flockeye_runtime::clock;
use flockeye_runtime::instance::Instance;
use foxglove::messages::{
    CompressedImage, FrameTransforms, ImageAnnotations, PoseInFrame, SceneUpdate, Timestamp,
};
use foxglove::{
    Channel, ChannelBuilder, Context, Encode, PartialMetadata, RawChannel, WebSocketServer,
    WebSocketServerHandle,
};

use crate::pages::Demand;
use crate::scene::EndedFrame;
use crate::wire::ProcessReport;
use values::{CAMERA, OBSERVER, pose, timestamp};

/// Maximum messages that wait for a slow client.
const BACKLOG: usize = 64;

/// Channels of a Foxglove server for the pipeline or recording that is shown.
pub(crate) struct FoxgloveView {
    context: Arc<Context>,
    resolved: Resolved,
    transforms: Channel<FrameTransforms>,
    scene: Channel<SceneUpdate>,
    /// Poses, by the bodies' numbers.
    poses: Vec<Channel<PoseInFrame>>,
    sphere: Channel<CompressedImage>,
    annotations: Channel<ImageAnnotations>,
    /// Close-ups, by the bodies' numbers.
    closeups: Vec<Channel<CompressedImage>>,
    frames: Arc<RawChannel>,
    stages: Arc<RawChannel>,
    /// UTC less the exposures' clock, nanoseconds.
    unix_from_exposure_ns: i64,
    /// Current time of the recording that is shown, nanoseconds since 1970.
    recorded_ns: Option<i64>,
}

impl FoxgloveView {
    /// Advertises the channels of a pipeline and listens at `address`, in threads that end with the
    /// process. Returns the view and the port.
    ///
    /// # Errors
    /// The pipeline's configuration cannot be read, or the address is in use or not this machine's.
    pub(crate) fn start(address: SocketAddr, instance: &Instance) -> anyhow::Result<(Self, u16)> {
        let resolved = Resolved::of(instance.pipeline()?)?;
        let (view, server) = Self::serve(address, instance.name(), &resolved, |server| server)?;
        Ok((view, server.port()))
    }

    /// Serves a configuration. `more` adds further settings of the server.
    ///
    /// # Errors
    /// A channel cannot be made, or the address is in use or not this machine's.
    pub(crate) fn serve(
        address: SocketAddr,
        name: &str,
        resolved: &Resolved,
        more: impl FnOnce(WebSocketServer) -> WebSocketServer,
    ) -> anyhow::Result<(Self, WebSocketServerHandle)> {
        let context = Context::new();
        // The channels come first, because a client that subscribes to an unfinished channel may be
        // refused.
        let view = Self::new(context.clone(), resolved)?;
        let server = WebSocketServer::new()
            .context(&context)
            .name(format!("Flockeye {name}"))
            .bind(address.ip().to_string(), address.port())
            .message_backlog_size(BACKLOG);
        let server = more(server)
            .start_blocking()
            .with_context(|| format!("cannot serve Foxglove at {address}"))?;
        Ok((view, server))
    }

    fn new(context: Arc<Context>, resolved: &Resolved) -> anyhow::Result<Self> {
        let json = |topic: &str| {
            let channel = context.channel_builder(topic).message_encoding("json").build_raw();
            channel.with_context(|| format!("the channel {topic} cannot be made"))
        };
        let names = || resolved.bodies.iter().map(|body| body.name.as_str());
        let unix_ns = std::time::UNIX_EPOCH.elapsed().map_or(0, |since| since.as_nanos() as i64);
        let is_real_time = resolved.pipeline.flow() == Flow::Latest;
        Ok(Self {
            resolved: resolved.clone(),
            transforms: build(context.channel_builder("/tf")),
            scene: build(context.channel_builder("/scene")),
            poses: names()
                .map(|name| build(context.channel_builder(format!("/pose/{name}"))))
                .collect(),
            sphere: build(context.channel_builder("/sphere")),
            annotations: build(context.channel_builder("/sphere/annotations")),
            closeups: names()
                .map(|name| build(context.channel_builder(format!("/closeup/{name}"))))
                .collect(),
            frames: json("/frames")?,
            stages: json("/stages")?,
            // Exposures of a lossless run have the recording's own clock.
            unix_from_exposure_ns: if is_real_time { unix_ns - clock::monotonic_ns() } else { 0 },
            recorded_ns: None,
            context,
        })
    }

    /// Sets the time of a recording that the next messages carry, UTC nanoseconds.
    pub(crate) fn set_time(&mut self, utc_ns: u64) {
        self.recorded_ns = i64::try_from(utc_ns).ok();
    }

    /// Advertises the channels of a pipeline, in place of those of another.
    pub(crate) fn begin(&mut self, resolved: &Resolved) -> anyhow::Result<()> {
        if self.resolved.pipeline != resolved.pipeline {
            self.close();
            *self = Self::new(self.context.clone(), resolved)?;
        }
        Ok(())
    }

    fn close(&self) {
        self.transforms.close();
        self.scene.close();
        self.poses.iter().for_each(Channel::close);
        self.sphere.close();
        self.annotations.close();
        self.closeups.iter().for_each(Channel::close);
        self.frames.close();
        self.stages.close();
    }

    /// The clients' subscriptions.
    pub(crate) fn wanted(&self) -> Demand {
        let pictures = self.sphere.has_sinks() || self.annotations.has_sinks();
        let closeups = self.closeups.iter().any(Channel::has_sinks);
        let anything = pictures
            || closeups
            || self.transforms.has_sinks()
            || self.scene.has_sinks()
            || self.poses.iter().any(Channel::has_sinks)
            || self.frames.has_sinks()
            || self.stages.has_sinks();
        Demand { anything, pictures, closeups }
    }

    /// Sends the tracks and the message of a frame.
    pub(crate) fn frame(&self, ended: &EndedFrame) {
        let (at, stamped) = self.time(&ended.stamp);
        let tracks = &ended.tracks;
        put(&self.transforms, at, || scene::transforms(&self.resolved, tracks, stamped));
        put(&self.scene, at, || scene::scene(&self.resolved, tracks, stamped));
        for track in tracks {
            let Some(channel) = self.poses.get(track.target as usize) else { continue };
            put(channel, at, || PoseInFrame {
                timestamp: Some(stamped),
                frame_id: OBSERVER.to_owned(),
                pose: Some(pose(&isometry(&track.observer_from_target))),
            });
        }
        if self.frames.has_sinks()
            && let Ok(json) = serde_json::to_vec(&ended.message)
        {
            self.frames.log_with_meta(&json, meta(at));
        }
    }

    /// Sends a frame's picture, with its annotations if it has ended. `size`: width and height,
    /// pixels.
    pub(crate) fn picture(
        &self,
        stamp: &FrameStamp,
        ended: Option<&EndedFrame>,
        size: [u32; 2],
        jpeg: &[u8],
    ) {
        let (at, stamped) = self.time(stamp);
        put(&self.sphere, at, || image(CAMERA, stamped, jpeg));
        if let Some(ended) = ended {
            put(&self.annotations, at, || {
                annotations::annotations(&self.resolved, ended, size, stamped)
            });
        }
    }

    pub(crate) fn closeup(&self, stamp: &FrameStamp, target: u32, jpeg: &[u8]) {
        if let Some(channel) = self.closeups.get(target as usize) {
            let (at, stamped) = self.time(stamp);
            put(channel, at, || image(CAMERA, stamped, jpeg));
        }
    }

    pub(crate) fn stages(&self, stages: &[ProcessReport]) {
        if self.stages.has_sinks()
            && let Ok(json) = serde_json::to_vec(&BTreeMap::from([("stages", stages)]))
        {
            match self.recorded_ns {
                Some(at_ns) => self.stages.log_with_meta(&json, meta(at_ns)),
                None => self.stages.log(&json),
            }
        }
    }

    /// The time of a frame's messages: nanoseconds since 1970, and the same as Foxglove's type.
    fn time(&self, stamp: &FrameStamp) -> (i64, Timestamp) {
        let exposure_ns = stamp.exposure_ns.saturating_add(self.unix_from_exposure_ns);
        let at_ns = self.recorded_ns.unwrap_or(exposure_ns);
        (at_ns, timestamp(at_ns))
    }
}

fn build<T: Encode>(builder: ChannelBuilder) -> Channel<T> {
    builder.build()
}

/// Sends the value that `make` returns, if any client has subscribed to the channel.
fn put<T: Encode>(channel: &Channel<T>, at_ns: i64, make: impl FnOnce() -> T) {
    if channel.has_sinks() {
        channel.log_with_meta(&make(), meta(at_ns));
    }
}

fn meta(at_ns: i64) -> PartialMetadata {
    PartialMetadata { log_time: u64::try_from(at_ns).ok() }
}

fn image(frame_id: &str, timestamp: Timestamp, jpeg: &[u8]) -> CompressedImage {
    CompressedImage {
        timestamp: Some(timestamp),
        frame_id: frame_id.to_owned(),
        data: jpeg.to_vec().into(),
        format: "jpeg".to_owned(),
    }
}
