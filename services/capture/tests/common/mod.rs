//! Clips made by GStreamer itself, in folders that vanish with the test.
#![allow(clippy::unwrap_used, clippy::expect_used, dead_code)]

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use flockeye_capture::{EndReason, Event, FrameSource, SourceParameters, SourcePicture};
use flockeye_config::Flow;
use gstreamer as gst;
use gstreamer::prelude::*;

pub(crate) const WIDTH: u32 = 320;
pub(crate) const HEIGHT: u32 = 240;

/// Runs `test` in a thread and fails when it has not come back after a minute.
pub(crate) fn watched(test: impl FnOnce() + Send + 'static) {
    let (done, finished) = mpsc::channel();
    let worker = std::thread::spawn(move || {
        test();
        done.send(()).unwrap();
    });
    match finished.recv_timeout(Duration::from_secs(60)) {
        Err(RecvTimeoutError::Timeout) => panic!("the test hangs"),
        _ => worker.join().unwrap_or_else(|cause| std::panic::resume_unwind(cause)),
    }
}

/// A folder of its own, removed when dropped.
pub(crate) struct Scratch(PathBuf);

impl Scratch {
    pub(crate) fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!(
            "flockeye-capture-{}-{}",
            std::process::id(),
            NEXT.fetch_add(1, Ordering::Relaxed)
        );
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    pub(crate) fn folder(&self) -> &Path {
        &self.0
    }

    /// Runs `video ! encoders ! filesink` to its end and returns the file.
    pub(crate) fn clip(&self, name: &str, pipeline: &str) -> PathBuf {
        let path = self.path(name);
        run(&format!("{pipeline} ! filesink location=\"{}\"", path.display()));
        path
    }

    /// The first `share` of a file, under another name.
    pub(crate) fn cut(&self, whole: &Path, name: &str, share: f64) -> PathBuf {
        let bytes = std::fs::read(whole).unwrap();
        let path = self.path(name);
        std::fs::write(&path, &bytes[..(bytes.len() as f64 * share) as usize]).unwrap();
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        drop(std::fs::remove_dir_all(&self.0));
    }
}

/// `frames` different frames of raw video; a different `width` makes for padded rows.
pub(crate) fn video(frames: u32, width: u32, format: &str) -> String {
    format!(
        "videotestsrc num-buffers={frames} pattern=ball ! video/x-raw,format={format},width={width},height={HEIGHT},framerate=30/1"
    )
}

/// Runs a pipeline to its end.
pub(crate) fn run(description: &str) {
    gst::init().unwrap();
    let pipeline = gst::parse::launch(description).unwrap();
    pipeline.set_state(gst::State::Playing).unwrap();
    let bus = pipeline.bus().unwrap();
    let message = bus.timed_pop_filtered(
        gst::ClockTime::from_seconds(30),
        &[gst::MessageType::Eos, gst::MessageType::Error],
    );
    pipeline.set_state(gst::State::Null).unwrap();
    match message.expect("the clip is not finished").view() {
        gst::MessageView::Eos(_) => {}
        other => panic!("{description}: {other:?}"),
    }
}

/// The luma planes of raw video, rows packed, as GStreamer makes them without our code.
pub(crate) fn raw_luma(
    scratch: &Scratch,
    pipeline: &str,
    width: u32,
    format: &str,
) -> Vec<Vec<u8>> {
    let gray = scratch.clip("raw", pipeline);
    let bytes = std::fs::read(gray).unwrap();
    let info = gstreamer_video::VideoInfo::builder(format.parse().unwrap(), width, HEIGHT)
        .build()
        .unwrap();
    let stride = info.stride()[0] as usize;
    let rows = |frame: &[u8]| {
        (0..HEIGHT as usize)
            .flat_map(|y| frame[y * stride..y * stride + width as usize].to_vec())
            .collect()
    };
    bytes.chunks_exact(info.size()).map(rows).collect()
}

/// A picture's luma with its rows packed.
pub(crate) fn packed(picture: &SourcePicture) -> Vec<u8> {
    (0..picture.height()).flat_map(|y| picture.row(y).to_vec()).collect()
}

pub(crate) fn parameters(flow: Flow) -> SourceParameters {
    SourceParameters { flow, ..SourceParameters::new(WIDTH, HEIGHT) }
}

pub(crate) fn open(path: &Path, params: SourceParameters) -> FrameSource {
    FrameSource::open(path.to_str().unwrap().parse().unwrap(), params).unwrap()
}

/// Plays a recording to its end.
pub(crate) fn play(source: &mut FrameSource, mut each: impl FnMut(&SourcePicture)) -> EndReason {
    loop {
        match source.next(Duration::from_secs(5)).unwrap() {
            Event::Frame(picture) => each(&picture),
            Event::End(reason) => return reason,
            Event::Idle => {}
            other => panic!("{other:?}"),
        }
    }
}
