//! A folder of images. Each image has its own pipeline, so that a damaged image affects no other.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use flockeye_config::Flow;
use flockeye_runtime::clock::monotonic_ns;

use crate::CaptureError;
use crate::event::{EndReason, Event};
use crate::file;
use crate::input::Input;
use crate::parameters::SourceParameters;
use crate::picture::{PictureStamp, SourcePicture};
use crate::playback::{Playback, PlaybackEvent};

/// A folder of images, in the order of their names.
#[derive(Debug)]
pub(crate) struct Folder {
    path: PathBuf,
    images: Vec<PathBuf>,
    params: SourceParameters,
    position: usize,
    /// The decoded image that is not due yet.
    waiting: Option<(usize, SourcePicture)>,
    /// Due time of the first image: as `Instant`, and on CLOCK_MONOTONIC, nanoseconds.
    started: Option<(Instant, i64)>,
    handed_out: u64,
    skipped: u64,
}

impl Folder {
    /// Lists the images without decoding.
    pub(crate) fn open(path: &Path, params: &SourceParameters) -> Result<Self, CaptureError> {
        if !(params.images_per_second.is_finite() && params.images_per_second > 0.0) {
            return Err(CaptureError::Parameter {
                name: "images_per_second",
                value: params.images_per_second.to_string(),
                cure: "it must be a number above 0",
            });
        }
        let unreadable = |error: std::io::Error| CaptureError::Unreadable {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let mut images = Vec::new();
        for entry in fs::read_dir(path).map_err(unreadable)? {
            let file = entry.map_err(unreadable)?.path();
            if is_image(&file) && file.is_file() {
                images.push(file);
            }
        }
        if images.is_empty() {
            return Err(CaptureError::EmptyFolder { path: path.to_owned() });
        }
        images.sort();
        Ok(Self {
            path: path.to_owned(),
            images,
            params: params.clone(),
            position: 0,
            waiting: None,
            started: None,
            handed_out: 0,
            skipped: 0,
        })
    }

    /// Waits for at most `timeout`, but decoding of an image may take longer.
    pub(crate) fn next(&mut self, timeout: Duration) -> Event {
        let deadline = Instant::now() + timeout;
        let (index, picture) = match self.waiting.take() {
            Some(waiting) => waiting,
            None => {
                let index = self.upcoming();
                let Some(file) = self.images.get(index) else {
                    let (frames, skipped) = (self.handed_out, self.skipped);
                    return Event::End(EndReason::Complete { frames, skipped });
                };
                self.position = index + 1;
                match decode(file, &self.params) {
                    Ok(picture) => (index, picture),
                    Err(why) => {
                        self.skipped += 1;
                        return Event::Skipped { what: file.display().to_string(), why };
                    }
                }
            }
        };
        self.hand_out(index, picture, deadline)
    }

    /// Index of the next image to decode. In real time, images are skipped if the next one is due.
    fn upcoming(&self) -> usize {
        match self.started {
            Some((start, _)) if self.params.flow == Flow::Latest => {
                let due = (start.elapsed().as_secs_f64() * self.params.images_per_second) as usize;
                self.position.max(due)
            }
            _ => self.position,
        }
    }

    fn hand_out(&mut self, index: usize, mut picture: SourcePicture, deadline: Instant) -> Event {
        let stream_time = Duration::from_secs_f64(index as f64 / self.params.images_per_second);
        let stream_ns = stream_time.as_nanos() as i64;
        let mut exposure_ns = stream_ns;
        if self.params.flow == Flow::Latest {
            let begun = || (Instant::now() - stream_time, monotonic_ns() - stream_ns);
            let (start, start_ns) = *self.started.get_or_insert_with(begun);
            let due = start + stream_time;
            std::thread::sleep(due.min(deadline).saturating_duration_since(Instant::now()));
            if Instant::now() < due {
                self.waiting = Some((index, picture));
                return Event::Idle;
            }
            exposure_ns = start_ns + stream_ns;
        }
        let sequence = index as u64;
        picture.stamp = PictureStamp { sequence, stream_time, exposure_ns, pts: None };
        self.handed_out += 1;
        Event::Frame(picture)
    }

    pub(crate) fn describe(&self) -> String {
        let pace = match self.params.flow {
            Flow::Latest => format!("{} a second", self.params.images_per_second),
            Flow::Lossless => "each as soon as it is wanted".to_owned(),
        };
        format!("{}: {} images, {pace}", self.path.display(), self.images.len())
    }
}

fn is_image(file: &Path) -> bool {
    let extension = file.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
    ["jpg", "jpeg", "png"].iter().any(|known| extension.eq_ignore_ascii_case(known))
}

/// Decodes one image. The error is the reason of the failure.
fn decode(path: &Path, params: &SourceParameters) -> Result<SourcePicture, String> {
    file::check(path).map_err(|error| error.to_string())?;
    let lossless = SourceParameters { flow: Flow::Lossless, ..params.clone() };
    let mut playback = Playback::recording(Input::File(path.to_owned()), &lossless)
        .map_err(|error| error.to_string())?;
    match playback.next(Duration::from_secs(20)).map_err(|error| error.to_string())? {
        PlaybackEvent::Picture(picture) => Ok(picture),
        PlaybackEvent::Over { fault: Some(fault) } => Err(fault),
        PlaybackEvent::Over { fault: None }
        | PlaybackEvent::Idle
        | PlaybackEvent::Late(_)
        | PlaybackEvent::Behind { .. } => Err("no picture came out of it".to_owned()),
    }
}
