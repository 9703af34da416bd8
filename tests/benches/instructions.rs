//! Counts processor instructions of the cores on a recording: rectification, detection and fusion
//! in one thread. They run in lossless order, without supervisor, processes or shared memory. With
//! valgrind's callgrind the count is reproducible.
//!
//! ```sh
//! make instructions      # the first 30 frames of flight1
//! ```
//!
//! `decode VIDEO FRAMES FILE` writes decoded frames, `fly FILE VIDEO BODIES` processes them. Only
//! [`fly`] is counted, so decoding, configuration and the reading of frames are excluded. It prints
//! the number of poses and their hash, which are equal for builds with the same behaviour.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::rc::Rc;
use std::time::Duration;

use flockeye_capture::core::Core as Capture;
use flockeye_capture::{Event as SourceEvent, FrameSource, SourceParameters};
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{DetectionHeader, FrameHeader, PixelFormat, Track, ViewHeader};
use flockeye_convert::projection_of;
use flockeye_detection::core::Core as Detection;
use flockeye_fusion::{
    BackgroundRunner, Core as Fusion, Event as FusionEvent, Outputs, Record, Writer, configured,
};
use flockeye_rectification::core::{Action, Core as Rectification, CutOrder, Event};
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::cutting::Cutter;
use flockeye_runtime::health::SharedCounters;

fn main() {
    // `cargo bench` adds an argument of its own.
    let arguments: Vec<String> =
        std::env::args().skip(1).filter(|word| word != "--bench").collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["decode", video, count, file] => decode(video, count.parse().unwrap(), file),
        ["fly", file, video, bodies] => {
            let resolved = resolved(video, Some(bodies));
            let frames = read(file);
            let mut cores = Cores::new(&resolved);
            fly(&mut cores, frames);
            println!("poses {}, hash {:016x}", cores.poses, cores.hash);
        }
        _ => println!("usage: decode VIDEO FRAMES FILE | fly FILE VIDEO BODIES"),
    }
}

/// The default pipeline on a recording, as [`Cores`] runs it: one worker, one thread each, no other
/// stages.
fn resolved(video: &str, bodies: Option<&str>) -> Resolved {
    let mut overrides = vec![
        "profile=repeat".to_owned(),
        format!("source.input={video}"),
        "rectification.backend=cpu".to_owned(),
        "rectification.threads=1".to_owned(),
        "fusion.threads=1".to_owned(),
        "stages.detection.replicas=1".to_owned(),
        "egomotion.enabled=false".to_owned(),
        "gateway.enabled=false".to_owned(),
    ];
    overrides.extend(bodies.map(|bodies| format!("bodies.file={bodies}")));
    Resolved::of(Pipeline::parse("", &overrides, "instructions").unwrap()).unwrap()
}

type Decoded = (FrameHeader, Rc<Vec<u8>>);

/// Writes the first frames of a video, each as its header and its luma plane, as capture publishes
/// them.
fn decode(video: &str, count: u64, file: &str) {
    let resolved = resolved(video, None);
    let parameters = SourceParameters::of(&resolved.pipeline);
    let mut source = FrameSource::open(video.parse().unwrap(), parameters).unwrap();
    let mut capture = Capture::of(&resolved, 0);
    let mut out = BufWriter::new(File::create(file).unwrap());
    for _ in 0..count {
        let picture = loop {
            match source.next(Duration::from_secs(5)).unwrap() {
                SourceEvent::Frame(picture) => break picture,
                SourceEvent::End(reason) => panic!("{reason}"),
                _ => {}
            }
        };
        let stream_ns = picture.facts().stream_ns;
        let header = FrameHeader {
            stamp: capture.on_picture(&picture.facts(), stream_ns).0.stamp,
            width: picture.width(),
            height: picture.height(),
            stride: picture.width(),
            pixel_format: PixelFormat::Gray8.code(),
            transfer: resolved.transfer.0.code(),
            gamma: resolved.transfer.1,
            range: picture.range().code(),
            projection: projection_of(&resolved.camera).code(),
            ..FrameHeader::default()
        };
        out.write_all(bytemuck::bytes_of(&header)).unwrap();
        (0..picture.height()).for_each(|y| out.write_all(picture.row(y)).unwrap());
    }
    out.flush().unwrap();
}

fn read(file: &str) -> Vec<Decoded> {
    let mut input = File::open(file).unwrap();
    let mut frames = Vec::new();
    let mut header = [0; size_of::<FrameHeader>()];
    while input.read_exact(&mut header).is_ok() {
        let header: FrameHeader = bytemuck::pod_read_unaligned(&header);
        let mut luma = vec![0; header.stride as usize * header.height as usize];
        input.read_exact(&mut luma).unwrap();
        frames.push((header, Rc::new(luma)));
    }
    frames
}

/// The three cores, and the state between them.
struct Cores {
    rectification: Rectification<Rc<Vec<u8>>>,
    cutter: Cutter,
    detection: Detection,
    fusion: Fusion<Vec<u8>>,
    writer: Writer,
    background: Option<BackgroundRunner>,
    /// The time of the cores, which is the stream's time.
    now_ns: i64,
    poses: usize,
    hash: u64,
}

/// The counted part: callgrind collects inside of it alone, by its name.
#[inline(never)]
fn fly(cores: &mut Cores, frames: Vec<Decoded>) {
    let count = frames.len();
    cores.fuse();
    for (header, luma) in frames {
        cores.now_ns = header.stamp.stream_ns;
        cores.rectification.on(Event::Frame(header, luma), cores.now_ns);
        cores.rectify();
    }
    println!("frames {count}");
}

impl Cores {
    fn new(resolved: &Resolved) -> Self {
        let (cpu, counters) = (Box::new(CpuRectifier::new(1)), SharedCounters::default());
        let (fusion, writer, aligner) = configured(resolved, 0).unwrap();
        Self {
            rectification: Rectification::of(resolved, 0, 0).unwrap(),
            cutter: Cutter::new(cpu, 1, counters, resolved.camera),
            detection: Detection::new(resolved, 0, 0).unwrap(),
            fusion,
            writer,
            background: aligner.map(BackgroundRunner::inline),
            now_ns: 0,
            poses: 0,
            hash: 0xcbf2_9ce4_8422_2325,
        }
    }

    /// Runs rectification until it is idle.
    fn rectify(&mut self) {
        loop {
            match self.rectification.step(self.now_ns) {
                Action::TakeUp { frame, likely } => {
                    let (header, luma) = self.rectification.frame(frame).unwrap();
                    self.cutter.announce(header, luma, &likely).unwrap();
                }
                Action::Look { frame, search } => {
                    let (header, luma) = self.rectification.frame(frame).unwrap();
                    let found = self.cutter.look(header, luma, &search).unwrap();
                    let looked = Event::Looked { frame, found, took_ns: 0 };
                    self.rectification.on(looked, self.now_ns);
                }
                Action::Cut(order) => self.cut(&order),
                Action::End(end) => {
                    self.fusion.on(FusionEvent::FrameEnd(end), self.now_ns);
                    self.fuse();
                }
                Action::Wait(_) => return,
            }
        }
    }

    /// Cuts a view, searches it, and gives fusion both.
    fn cut(&mut self, order: &CutOrder) {
        let (frame, luma) = self.rectification.frame(order.frame()).unwrap();
        let mut pixels = vec![0; (order.header.size_px as usize).pow(2)];
        self.cutter.cut(frame, luma, order, &mut pixels).unwrap();
        let header = ViewHeader { issued_ns: self.now_ns, ..order.header };
        self.rectification.on(Event::Published { header, took_ns: 0 }, self.now_ns);
        let (found, markers) = self.detection.on_view(&header, &pixels).unwrap();
        let answer = DetectionHeader { received_ns: self.now_ns, sent_ns: self.now_ns, ..found };
        self.fusion.on(FusionEvent::View(header, pixels), self.now_ns);
        let record = Record { header: answer, markers: markers.unwrap() };
        self.fusion.on(FusionEvent::Searched(record), self.now_ns);
        self.rectification.on(Event::Answer(answer), self.now_ns);
        self.fuse();
    }

    /// Steps fusion until it is idle; its plans go to rectification.
    fn fuse(&mut self) {
        let mut answers = VecDeque::new();
        loop {
            if let Some(answer) = answers.pop_front() {
                self.fusion.on(FusionEvent::Background(answer), self.now_ns);
            }
            let Outputs { tracks, plan, job, is_idle, .. } = self.fusion.step(self.now_ns);
            for message in &tracks {
                let tracker = self.fusion.tracker();
                let (_, tracks) = self.writer.tracks(message, tracker, self.now_ns);
                tracks.iter().for_each(|track| self.note(track));
            }
            if let Some((next, after)) = &plan {
                let (header, views) = self.writer.plan(next, *after, self.now_ns);
                self.rectification.on(Event::Plan(header, views), self.now_ns);
            }
            if let (Some(job), Some(runner)) = (job, &mut self.background) {
                runner.run(job).unwrap();
                answers.extend(runner.answer().unwrap());
            }
            if is_idle && answers.is_empty() {
                return;
            }
        }
    }

    /// Counts a track, and adds its pose and covariance to the hash (FNV-1a).
    fn note(&mut self, track: &Track) {
        self.poses += 1;
        let pose = track.observer_from_target;
        for byte in bytemuck::bytes_of(&pose).iter().chain(bytemuck::bytes_of(&track.covariance)) {
            self.hash = (self.hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}
