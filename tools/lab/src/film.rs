//! `flockeye film`: a simulated flight as a video, with its truth. It has the errors of a codec, and
//! it flies in real time even if drawing is slower.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::{Context, anyhow, bail, ensure};
use clap::Args;
use flockeye_cli::{Configuration, Screen, signals};
use flockeye_config::{Profile, Resolved};
use flockeye_contract::ImuSample;
use flockeye_simulator::{PictureMessages, draw_flight};
use flockeye_tables::{ImuRow, TableWriter, TruthRow};
use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app::AppSrc;

/// Number of frames from one key frame to the next.
const GOP_FRAMES: u32 = 30;
/// Largest size and bit rate that the encoder accepts (H.264, level 5.2), pixels and Mbit/s.
const MAX_PIXELS: u64 = 9_437_184;
const MAX_BITRATE: i64 = 288;
/// Longest time that the last frames take to be written.
const END_TIMEOUT: gst::ClockTime = gst::ClockTime::from_seconds(60);
/// Code value of a colour difference where there is no colour.
const NO_COLOUR: u8 = 128;

#[derive(Debug, Args)]
pub(crate) struct FilmArguments {
    /// Which simulated flight. simulator.frames is its length.
    #[command(flatten)]
    configuration: Configuration,
    /// Where to write the video, H.264.
    #[arg(long, value_name = "FILE.mp4")]
    out: PathBuf,
    /// Where to write the truth.
    #[arg(long, value_name = "FILE.csv")]
    truth: Option<PathBuf>,
    /// Where to write the samples of the simulated inertial sensor.
    #[arg(long, value_name = "FILE.csv")]
    imu: Option<PathBuf>,
    /// Bit rate of the video, megabits a second.
    #[arg(long, value_name = "MBIT", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=MAX_BITRATE))]
    bitrate: u32,
}

/// Draws the flight.
///
/// # Errors
/// An invalid configuration, a missing encoder, a file that cannot be written, or Ctrl-C.
pub(crate) fn run(arguments: &FilmArguments) -> anyhow::Result<()> {
    let sensor = if arguments.imu.is_some() { "sim" } else { "none" };
    let fixed = ["source.input=sim".to_owned(), format!("inertial.source={sensor}")];
    let configuration = arguments.configuration.clone().in_profile(Profile::Repeat);
    let resolved = Resolved::of(configuration.load_with(&[], &fixed)?)?;
    let painting = tempfile::tempdir().context("cannot make a temporary folder")?;
    let stopping = signals::stop_flag()?;
    // Opened for the first frame, so that a flight that cannot be drawn leaves no file.
    let mut film: Option<Film> = None;
    draw_flight(&resolved, painting.path(), |luma, messages| {
        match &mut film {
            Some(film) => film.add(luma, messages)?,
            None => film.insert(Film::open(&resolved, arguments)?).add(luma, messages)?,
        }
        Ok(!stopping.load(Ordering::Relaxed))
    })?;
    let frames = film.map_or(Ok(0), Film::finish)?;
    ensure!(!stopping.load(Ordering::Relaxed), "stopped after {frames} frames");
    Screen::new().line(&format!("{frames} frames in {}", arguments.out.display()));
    Ok(())
}

/// A video and its tables, which are being written.
struct Film {
    encoder: Encoder,
    truths: Option<TableWriter<TruthRow>>,
    samples: Option<TableWriter<ImuRow>>,
}

impl Film {
    fn open(resolved: &Resolved, arguments: &FilmArguments) -> anyhow::Result<Self> {
        let FilmArguments { out, truth, imu, bitrate, .. } = arguments;
        Ok(Self {
            encoder: Encoder::open(resolved, out, *bitrate)?,
            truths: truth.as_deref().map(TableWriter::create).transpose()?,
            samples: imu.as_deref().map(TableWriter::create).transpose()?,
        })
    }

    /// Adds a frame, with what belongs to it.
    fn add(&mut self, luma: &[u8], messages: &PictureMessages) -> anyhow::Result<()> {
        let (header, bodies) = &messages.truth;
        if let Some(truths) = &mut self.truths {
            bodies.iter().try_for_each(|body| truths.add(&TruthRow::of(header, body)))?;
        }
        if let (Some(table), Some((_, samples))) = (&mut self.samples, &messages.inertial) {
            let zero_ns = header.stamp.exposure_ns - header.stamp.stream_ns;
            let add = |sample: &ImuSample| table.add(&ImuRow::of(sample, zero_ns));
            samples.iter().try_for_each(add)?;
        }
        self.encoder.add(luma)
    }

    /// Ends the video and its tables, and returns the number of frames.
    fn finish(self) -> anyhow::Result<u64> {
        let frames = self.encoder.finish()?;
        self.truths.map(TableWriter::finish).transpose()?;
        self.samples.map(TableWriter::finish).transpose()?;
        Ok(frames)
    }
}

/// An H.264 encoder that writes a file.
struct Encoder {
    pipeline: gst::Pipeline,
    source: AppSrc,
    /// Frames a second.
    rate: gst::Fraction,
    /// Bytes of the two colour planes.
    colour_bytes: usize,
    /// Number of frames so far.
    frames: u64,
}

impl Encoder {
    fn open(resolved: &Resolved, out: &Path, megabits_s: u32) -> anyhow::Result<Self> {
        gst::init().context("GStreamer cannot be used")?;
        let (width, height) = (resolved.camera.width(), resolved.camera.height());
        // Otherwise the rows of the planes have gaps.
        ensure!(
            width.is_multiple_of(8) && height.is_multiple_of(2),
            "frames are {width}x{height}. Cure: a camera.width that is a multiple of 8, and an even \
             camera.height"
        );
        ensure!(
            u64::from(width) * u64::from(height) <= MAX_PIXELS,
            "frames of {width}x{height} are too large for the encoder. Cure: at most {MAX_PIXELS} \
             pixels, such as 4096x2048"
        );
        let rate = gst::Fraction::approximate_f64(resolved.pipeline.simulator.frames_per_second)
            .context("simulator.frames_per_second is no rate of a video")?;
        let bits = u64::from(megabits_s) * 1_000_000;
        let description = format!(
            "appsrc name=source format=time block=true max-buffers=2 \
             ! openh264enc bitrate={bits} max-bitrate={bits} rate-control=bitrate \
             gop-size={GOP_FRAMES} multi-thread=2 ! h264parse ! mp4mux ! filesink name=file"
        );
        let pipeline = gst::parse::launch(&description)
            .context(
            "cannot encode. Cure: apt-get install gstreamer1.0-plugins-base gstreamer1.0-plugins-good \
             gstreamer1.0-plugins-bad",
        )?;
        let pipeline = pipeline.downcast::<gst::Pipeline>();
        let pipeline = pipeline.ok().context("the encoder is no pipeline")?;
        let element = |name: &str| pipeline.by_name(name).context("the encoder lacks an element");
        element("file")?.set_property("location", out);
        let source = element("source")?.downcast::<AppSrc>();
        let source = source.ok().context("the encoder has no input")?;
        let caps = gst::Caps::builder("video/x-raw")
            .field("format", "I420")
            .field("width", width as i32)
            .field("height", height as i32)
            .field("framerate", rate)
            .build();
        source.set_caps(Some(&caps));
        // After an error nothing takes frames any more. The end of the stream wakes who waits for
        // room.
        let failed = source.downgrade();
        let bus = pipeline.bus().context("the encoder has no messages")?;
        bus.set_sync_handler(move |_, message| {
            if message.type_() == gst::MessageType::Error
                && let Some(source) = failed.upgrade()
            {
                // Refused only where the stream has ended already.
                let _ = source.end_of_stream();
            }
            gst::BusSyncReply::Pass
        });
        let colour_bytes = width as usize * height as usize / 2;
        let encoder = Self { pipeline, source, rate, colour_bytes, frames: 0 };
        match encoder.pipeline.set_state(gst::State::Playing) {
            Ok(_) => Ok(encoder),
            Err(error) => Err(encoder.failure(error)).context("cannot begin the video"),
        }
    }

    /// Encodes the next frame. Its codes are from 0 to 255; those of videos are from 16 to 235.
    fn add(&mut self, luma: &[u8]) -> anyhow::Result<()> {
        let limited = luma.iter().map(|&code| 16 + ((u32::from(code) * 219 + 127) / 255) as u8);
        let colour = std::iter::repeat_n(NO_COLOUR, self.colour_bytes);
        let mut buffer = gst::Buffer::from_slice(limited.chain(colour).collect::<Vec<u8>>());
        let (numerator, denominator) = (self.rate.numer() as u64, self.rate.denom() as u64);
        let time =
            |frame: u64| gst::ClockTime::SECOND.mul_div_round(frame * denominator, numerator);
        let (pts, end) = (time(self.frames), time(self.frames + 1));
        // A new buffer has no other owner.
        if let Some(buffer) = buffer.get_mut() {
            buffer.set_pts(pts);
            buffer.set_duration(end.zip(pts).map(|(end, pts)| end - pts));
        }
        self.frames += 1;
        self.source.push_buffer(buffer).map(drop).map_err(|error| self.failure(error))
    }

    /// Ends the video, and returns its number of frames.
    fn finish(self) -> anyhow::Result<u64> {
        self.source.end_of_stream().map_err(|error| self.failure(error))?;
        let bus = self.pipeline.bus().context("the encoder has no messages")?;
        let ends = [gst::MessageType::Eos, gst::MessageType::Error];
        match bus.timed_pop_filtered(END_TIMEOUT, &ends) {
            Some(message) if message.type_() == gst::MessageType::Eos => Ok(self.frames),
            Some(message) => Err(failure_of(&message)),
            None => bail!("the video does not end"),
        }
    }

    /// The encoder's own reason for a failure, if it has one.
    fn failure(&self, error: impl std::error::Error + Send + Sync + 'static) -> anyhow::Error {
        let bus = self.pipeline.bus();
        let message = bus.and_then(|bus| bus.pop_filtered(&[gst::MessageType::Error]));
        message.map_or_else(|| error.into(), |message| failure_of(&message))
    }
}

impl Drop for Encoder {
    fn drop(&mut self) {
        // An encoder that cannot stop has failed before, and its error was returned.
        let _ = self.pipeline.set_state(gst::State::Null);
    }
}

/// The error in a message of the encoder.
fn failure_of(message: &gst::Message) -> anyhow::Error {
    match message.view() {
        gst::MessageView::Error(error) => anyhow!("{}", error.error()),
        _ => anyhow!("the encoder failed"),
    }
}
