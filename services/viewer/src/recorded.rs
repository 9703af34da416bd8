//! A recording in place of a running pipeline: its scene, pictures and close-ups at any time of the
//! file.
//!
//! Memory holds one chunk of the file at once. Each page has its own player, and so its own
//! position.
//!
//! | module | what it does |
//! | --- | --- |
//! | `messages` | the contract's messages of a recording |
//! | `tape` | reads forward from a time, and returns each frame that ends |
//! | `playhead` | core: the frame that is shown, for seeks, steps and time that passes |
//! | `pictures` | the nearest picture before a frame, and close-ups |
//! | `overview` | an overview of the whole recording |
//! | `player` | plays to one page |
//! | `foxglove_player` | plays to Foxglove's clients |

pub(crate) mod foxglove_player;
pub(crate) mod messages;
pub(crate) mod overview;
pub(crate) mod pictures;
pub(crate) mod player;
pub(crate) mod playhead;
pub(crate) mod tape;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, ensure};
use flockeye_config::{Flow, Pipeline, Resolved};
use flockeye_contract::TopicId;
use flockeye_geometry::body::{Bodies, Body};
use flockeye_recording::channel::{FRAME_IMAGES, LOSSES};
use flockeye_recording::{About, Ending, IndexedRecording};
use serde_json::Value;

use crate::{setting, wire};
use messages::ContractChannels;

/// A recording that is shown. It is read by reference, from several threads at once.
pub(crate) struct Recorded {
    recording: IndexedRecording,
    resolved: Resolved,
    channels: ContractChannels,
    /// Channel numbers of the pictures, and of the lost messages.
    images: Option<u16>,
    losses: Option<u16>,
    /// Times of the first and the last message, UTC nanoseconds.
    first_ns: u64,
    last_ns: u64,
    utc_from_monotonic_ns: i64,
    /// UTC less the clock of exposures, nanoseconds.
    utc_from_exposure_ns: i64,
    pub hello: wire::Hello,
    /// Damage of the whole file, for people; empty where there is none.
    pub trouble: String,
}

impl Recorded {
    /// Opens the recording at `path`. `rate`: maximum pictures per second while it is played.
    ///
    /// # Errors
    /// The file is not a recording, is damaged at its very beginning, has no messages, or has
    /// another contract.
    pub(crate) fn open(path: &Path, rate: f64) -> anyhow::Result<Self> {
        let recording = IndexedRecording::open(path)?;
        let shown = path.display();
        let Some((first_ns, last_ns)) = recording.span_ns() else {
            let damage = recording.damage().map(|damage| format!(": {damage}"));
            anyhow::bail!(
                "{shown} has no messages{}. Cure: record for longer",
                damage.unwrap_or_default()
            );
        };
        let about = recording.about();
        let resolved = configuration(about).with_context(|| shown.to_string())?;
        let channels = ContractChannels::of(&recording);
        ensure!(
            !channels.is_foreign(TopicId::Tracks),
            "{shown} was recorded with contract {}, whose tracks this Flockeye does not know. Cure: view it with \
             version {} of Flockeye",
            said(about, "contract"),
            said(about, "version")
        );
        let number = |topic: &str| {
            let mut channels = recording.channels().iter();
            channels.find(|(_, kind)| kind.topic == topic).map(|(number, _)| *number)
        };
        let (images, losses) = (number(FRAME_IMAGES), number(LOSSES));
        let has_pictures = images.is_some_and(|images| {
            recording.chunks().iter().any(|chunk| chunk.channels.contains(&images))
        });
        let mut hello = setting::hello(&resolved, &said(about, "instance"), rate);
        hello.recording = Some(wire::RecordingSummary {
            file: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            began_s: first_ns as f64 * 1e-9,
            duration_s: last_ns.saturating_sub(first_ns) as f64 * 1e-9,
            pictures: has_pictures,
        });
        let utc_from_monotonic_ns = about.utc_from_monotonic_ns;
        let utc_from_exposure_ns = said(about, "utc_from_exposure_ns").parse().unwrap_or(0);
        let trouble = trouble(&recording, &channels);
        Ok(Self {
            resolved,
            channels,
            images,
            losses,
            first_ns,
            last_ns,
            utc_from_monotonic_ns,
            utc_from_exposure_ns,
            hello,
            trouble,
            recording,
        })
    }

    /// Seconds from the recording's beginning.
    pub(crate) fn seconds(&self, utc_ns: u64) -> f64 {
        utc_ns.saturating_sub(self.first_ns) as f64 * 1e-9
    }

    /// Time `seconds` after the recording's beginning, limited to the recording.
    pub(crate) fn time_ns(&self, seconds: f64) -> u64 {
        // NaN gives 0, and a value that is too large gives the end.
        self.first_ns.saturating_add((seconds * 1e9) as u64).min(self.last_ns)
    }

    /// Converts a UTC time to the monotonic clock of the machine that recorded.
    fn monotonic_ns(&self, utc_ns: u64) -> i64 {
        i64::try_from(utc_ns).unwrap_or(i64::MAX).saturating_sub(self.utc_from_monotonic_ns)
    }

    fn is_real_time(&self) -> bool {
        self.resolved.pipeline.flow() == Flow::Latest
    }
}

fn said(about: &About, name: &str) -> String {
    about.metadata.get(name).cloned().unwrap_or_default()
}

/// Damage of a recording that can be shown all the same.
fn trouble(recording: &IndexedRecording, channels: &ContractChannels) -> String {
    if let Some(damage) = recording.damage() {
        return format!("{damage}; what lies before is shown");
    }
    let foreign = channels.foreign();
    if !foreign.is_empty() {
        let foreign = foreign.join(", ");
        return format!("not shown, because they are of another contract: {foreign}");
    }
    if recording.ending() == Ending::Cut {
        return "the recording was cut off: what had been written is shown".to_owned();
    }
    String::new()
}

/// The configuration of a recorded pipeline, with its bodies at the time of recording.
fn configuration(about: &About) -> anyhow::Result<Resolved> {
    let attached = |name: &str| {
        let found = about.attachments.iter().find(|(attached, _, _)| attached == name);
        let (_, _, bytes) = found.with_context(|| format!("the recording has no {name}"))?;
        Ok::<_, anyhow::Error>(bytes.as_slice())
    };
    let json = attached("pipeline.json")?;
    let cure =
        "pipeline.json of the recording is of another version of Flockeye. Cure: view it with that";
    let pipeline = Pipeline::from_json(json).context(cure)?;
    let bodies = bodies(attached("bodies.json")?).context("bodies.json of the recording")?;
    Resolved::with_bodies(pipeline, bodies)
        .context("the recorded configuration cannot be worked with any more")
}

/// The bodies in the order of their recorded numbers. A file of bodies sorts them by name.
fn bodies(json: &[u8]) -> anyhow::Result<Bodies> {
    let json = std::str::from_utf8(json)?;
    let read = Bodies::from_json(json)?;
    let value: Value = serde_json::from_str(json)?;
    let number = |body: &Body| value["bodies"][&body.name]["target"].as_u64().unwrap_or(u64::MAX);
    let mut bodies: BTreeMap<(u64, String), Body> = BTreeMap::new();
    for body in read.iter() {
        bodies.insert((number(body), body.name.clone()), body.clone());
    }
    Ok(Bodies::new(read.dictionary.clone(), bodies.into_values().collect())?)
}

#[cfg(test)]
mod tests;
