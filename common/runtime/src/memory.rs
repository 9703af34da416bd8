//! How large each topic's shared memory is, and whether it fits.
//!
//! iceoryx2 takes, for each publisher, chunks for the worst case: subscribers * (buffer + borrowed)
//! + history + loaned. Its defaults would take 34 frames; these are Flockeye's own limits.

use std::fmt;
use std::time::Duration;

use flockeye_contract::{
    BodyTruth, DetectedMarker, Detections, FrameEnds, Frames, Healths, MAX_PLANNED_VIEWS,
    PlannedView, Plans, Topic, Track, Tracks, Truths, Views,
};
use flockeye_geometry::partition;

use crate::config::{Flow, Pipeline};

/// Limits of one topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// The topic's name.
    pub topic: &'static str,
    /// Services of this topic: one, or one for each detection worker.
    pub lanes: usize,
    /// Publishers at once: old, new, and dead ones not cleaned up yet.
    pub publishers: usize,
    /// Publishers in the usual course, over all lanes, for the memory budget.
    pub usual_publishers: usize,
    /// Subscribers at once, tools included.
    pub subscribers: usize,
    /// Messages that wait at a subscriber.
    pub buffer: usize,
    /// How long a publisher waits for a subscriber where so many wait. `None`: not at all, the oldest
    /// gives way.
    pub patience: Option<Duration>,
    /// Messages that a subscriber may hold.
    pub borrowed: usize,
    /// Messages that a late subscriber still gets.
    pub history: usize,
    /// Messages that a publisher may be writing.
    pub loaned: usize,
    /// Most items in a message.
    pub items: usize,
    /// Bytes of an item.
    pub item_bytes: usize,
    /// Bytes of the header.
    pub header_bytes: usize,
}

impl Limits {
    /// Whether the topic is split into lanes, which carry their number in their service's name.
    pub fn topic_has_lanes(&self) -> bool {
        self.topic == Views::NAME
    }

    /// Chunks of one publisher's data segment, by iceoryx2's formula.
    pub fn chunks(&self) -> usize {
        self.subscribers * (self.buffer + self.borrowed) + self.history + self.loaned
    }

    /// Bytes of one publisher's data segment.
    pub fn segment_bytes(&self) -> usize {
        // iceoryx2's own header before each chunk is 40 bytes; the chunk is aligned to 8.
        self.chunks() * (self.items * self.item_bytes + self.header_bytes + 48)
    }

    /// Bytes in the usual course.
    pub fn bytes(&self) -> usize {
        self.usual_publishers * self.segment_bytes()
    }
}

/// Nodes (processes) of one instance at once: stages, their successors, tools.
pub const MAX_NODES: usize = 40;

/// Listeners and notifiers of one topic's event at once.
pub const MAX_EVENT_PORTS: usize = 40;

/// Most markers in one detection record that Flockeye's own stages send.
const MARKERS: usize = 64;
/// Most tracks in one message.
pub const MAX_TRACKS: usize = 16;
/// Most bodies in one frame's truth.
const TRUTH_BODIES: usize = 32;

/// Limits of every topic, in the order of the dataflow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Budget {
    /// One for each topic.
    pub topics: Vec<Limits>,
    camera: (u32, u32),
    frame_bytes: usize,
    frames: usize,
}

/// The shared memory does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "camera {width}x{height} needs {frames} frames of shared memory ({frame_mb} MB), {needed_mb} MB \
     with all else; /dev/shm has {free_mb} MB free. Cure: mount -o remount,size={cure_mb}M /dev/shm"
)]
pub struct TooLittleMemory {
    width: u32,
    height: u32,
    frames: usize,
    frame_mb: usize,
    needed_mb: usize,
    free_mb: usize,
    cure_mb: usize,
}

/// Views of all lanes that fusion holds until their records are in.
pub fn held_views_waiting(pipeline: &Pipeline) -> usize {
    // Rectification has so many in flight; one more may come before its predecessor's answer.
    pipeline.detection_workers() as usize * pipeline.rectification.window as usize + 1
}

/// Views that fusion holds because they show a neighbour best: one for each body, and some of the
/// frame that comes behind.
pub fn held_views_best(pipeline: &Pipeline) -> usize {
    // A file is not read for this; with more bodies in it, those of the highest numbers are measured
    // by their corners alone when all are seen at once.
    let bodies = if pipeline.bodies.file.is_some() { 8 } else { pipeline.bodies.list.len() };
    bodies.clamp(1, MAX_TRACKS) + 2
}

/// Frames that rectification has in flight: one that waits for answers, and one that is being cut.
const FRAMES_IN_FLIGHT: usize = 2;

/// Detection records of one worker that may wait for a subscriber, so that none is lost while fusion
/// sleeps over the answers to all frames in flight. Each worker has a buffer of its own.
///
/// At worst one worker answers all views of those frames, because the others are stalled. A stalled worker
/// that wakes up also answers its window of views that others have answered meanwhile.
fn records_in_flight(pipeline: &Pipeline) -> usize {
    let has_high_resolution =
        pipeline.gazes() && pipeline.search.far_magnification > pipeline.partition_magnification();
    let high_resolution_tiles = if has_high_resolution { *partition::STORED.end() } else { 0 };
    // A configuration without a partition is refused elsewhere.
    let tiles = pipeline.partition_count().unwrap_or(pipeline.partition.count.most());
    let planned = (tiles + high_resolution_tiles + MAX_TRACKS).min(MAX_PLANNED_VIEWS);
    FRAMES_IN_FLIGHT * planned + pipeline.rectification.window as usize
}

impl Budget {
    /// The limits that a configuration needs.
    pub fn of(pipeline: &Pipeline, largest_view_px: u32) -> Self {
        let workers = pipeline.detection_workers() as usize;
        let frame_bytes = pipeline.camera.width as usize * pipeline.camera.height as usize;
        let view_bytes = (largest_view_px as usize).pow(2);
        let window = pipeline.rectification.window as usize;
        let stages = 5 + workers;
        let topics = vec![
            // Rectification holds the frame that waits for answers, the one it cuts, the next one, and
            // for a moment one newer than that; a tool may look on.
            limits::<Frames>(
                Ports {
                    publishers: 1,
                    subscribers: 2,
                    buffer: 1,
                    borrowed: 4,
                    history: 0,
                    loaned: 2,
                },
                frame_bytes,
            ),
            limits::<Plans>(
                Ports {
                    publishers: 1,
                    subscribers: 4,
                    buffer: 2,
                    borrowed: 2,
                    history: 1,
                    loaned: 1,
                },
                flockeye_contract::MAX_PLANNED_VIEWS,
            ),
            // One lane for each worker, so that a slow one costs no other its views: the worker, its
            // successor, fusion and a tool listen to it. A lossless run waits for fusion: what it sees
            // must not depend on how soon it looks.
            Limits {
                lanes: workers,
                usual_publishers: workers,
                patience: match pipeline.flow {
                    Flow::Lossless => Some(pipeline.view_overdue()),
                    Flow::Latest => None,
                },
                ..limits::<Views>(
                    Ports {
                        publishers: 1,
                        subscribers: 4,
                        buffer: window + 2,
                        // What fusion holds, all of it in one lane at worst, and one that it reads.
                        borrowed: held_views_waiting(pipeline) + held_views_best(pipeline) + 1,
                        history: 0,
                        loaned: 1,
                    },
                    view_bytes,
                )
            },
            limits::<Detections>(
                Ports {
                    publishers: workers,
                    subscribers: 4,
                    buffer: records_in_flight(pipeline),
                    borrowed: 2,
                    history: 0,
                    loaned: 1,
                },
                MARKERS,
            ),
            limits::<FrameEnds>(
                Ports {
                    publishers: 1,
                    subscribers: 4,
                    buffer: 16,
                    borrowed: 2,
                    history: 0,
                    loaned: 1,
                },
                0,
            ),
            limits::<Tracks>(
                Ports {
                    publishers: 1,
                    subscribers: 8,
                    buffer: 64,
                    borrowed: 2,
                    history: 0,
                    loaned: 1,
                },
                MAX_TRACKS,
            ),
            limits::<Truths>(
                Ports {
                    publishers: 1,
                    subscribers: 4,
                    buffer: 64,
                    borrowed: 2,
                    history: 0,
                    loaned: 1,
                },
                TRUTH_BODIES,
            ),
            limits::<Healths>(
                Ports {
                    publishers: stages,
                    subscribers: 8,
                    buffer: 64,
                    borrowed: 2,
                    history: 0,
                    loaned: 1,
                },
                0,
            ),
        ];
        let frames = topics[0].chunks();
        Self {
            topics,
            camera: (pipeline.camera.width, pipeline.camera.height),
            frame_bytes,
            frames,
        }
    }

    /// Limits of one topic.
    #[expect(clippy::expect_used, reason = "a topic without limits is a mistake in this file")]
    pub fn topic<T: Topic>(&self) -> &Limits {
        let found = self.topics.iter().find(|limits| limits.topic == T::NAME);
        found.expect("limits of each topic") // a test counts that the list above has them all
    }

    /// Bytes of all topics.
    pub fn bytes(&self) -> usize {
        self.topics.iter().map(Limits::bytes).sum()
    }

    /// Refuses a budget that free memory does not hold: running out later would be a SIGBUS.
    ///
    /// # Errors
    /// [`TooLittleMemory`], with both numbers and the cure.
    pub fn check(&self, free_bytes: u64, total_bytes: u64) -> Result<(), TooLittleMemory> {
        let needed = self.bytes() as u64;
        if needed <= free_bytes {
            return Ok(());
        }
        let mb = |bytes: u64| bytes.div_ceil(1_000_000) as usize;
        Err(TooLittleMemory {
            width: self.camera.0,
            height: self.camera.1,
            frames: self.frames,
            frame_mb: mb((self.frames * self.frame_bytes) as u64),
            needed_mb: mb(needed),
            free_mb: (free_bytes / 1_000_000) as usize,
            cure_mb: mb((total_bytes - free_bytes.min(total_bytes)) + needed * 5 / 4),
        })
    }
}

/// Free and total bytes of /dev/shm.
///
/// # Errors
/// The system's reason where there is none.
pub fn shared_memory_space() -> std::io::Result<(u64, u64)> {
    let space = rustix::fs::statvfs("/dev/shm")?;
    Ok((space.f_bavail * space.f_frsize, space.f_blocks * space.f_frsize))
}

impl fmt::Display for Budget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<20} {:>6} {:>10} {:>9}", "shared memory", "chunks", "of bytes", "MB")?;
        for topic in &self.topics {
            writeln!(
                f,
                "  {:<18} {:>6} {:>10} {:>9.1}",
                topic.topic.trim_start_matches("flockeye/"),
                topic.chunks() * topic.usual_publishers,
                topic.items * topic.item_bytes + topic.header_bytes,
                topic.bytes() as f64 / 1e6
            )?;
        }
        write!(f, "  {:<18} {:>6} {:>10} {:>9.1}", "all", "", "", self.bytes() as f64 / 1e6)
    }
}

struct Ports {
    publishers: usize,
    subscribers: usize,
    buffer: usize,
    borrowed: usize,
    history: usize,
    loaned: usize,
}

fn limits<T: Topic>(ports: Ports, items: usize) -> Limits {
    Limits {
        topic: T::NAME,
        lanes: 1,
        // Twice as many as there usually are: a successor starts while the old one still runs.
        publishers: 2 * ports.publishers + 1,
        usual_publishers: ports.publishers,
        subscribers: ports.subscribers,
        buffer: ports.buffer,
        patience: None,
        borrowed: ports.borrowed,
        history: ports.history,
        loaned: ports.loaned,
        items,
        item_bytes: size_of::<T::Item>(),
        header_bytes: size_of::<T::Header>(),
    }
}

// The sizes that `items` above count in.
const _: () = assert!(size_of::<DetectedMarker>() * MARKERS < 16_384);
const _: () = assert!(size_of::<Track>() * MAX_TRACKS < 16_384);
const _: () = assert!(size_of::<BodyTruth>() * TRUTH_BODIES < 8_192);
const _: () = assert!(size_of::<PlannedView>() < 256);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn every_topic_has_limits() {
        let budget = Budget::of(&Pipeline::default(), 936);
        let names: Vec<_> = budget.topics.iter().map(|topic| topic.topic).collect();
        for name in flockeye_contract::ALL_TOPICS {
            assert!(names.contains(name), "{name}");
        }
        assert_eq!(names.len(), flockeye_contract::ALL_TOPICS.len());
    }

    #[test]
    fn the_answers_to_all_frames_in_flight_wait_whole() {
        for overrides in [
            vec![],
            vec!["partition.count=128"],
            vec!["search.mode=exhaustive"],
            vec!["search.far_magnification=1", "rectification.window=16"],
        ] {
            let overrides: Vec<String> = overrides.into_iter().map(String::from).collect();
            let pipeline = Pipeline::parse("", &overrides, "x").unwrap();
            let budget = Budget::of(&pipeline, pipeline.largest_view_px(0.05).unwrap());
            let tiles = pipeline.partition_views(0.05).unwrap().len();
            let planned = tiles + pipeline.far_views().unwrap().len() + MAX_TRACKS;
            assert!(planned <= MAX_PLANNED_VIEWS);
            let late = pipeline.rectification.window as usize;
            assert_eq!(budget.topic::<Detections>().buffer, 2 * planned + late, "{overrides:?}");
        }
    }

    #[test]
    fn too_little_memory_names_numbers_and_cure() {
        let budget = Budget::of(&Pipeline::default(), 936);
        assert_eq!(budget.check(10_000_000_000, 20_000_000_000), Ok(()));
        let error = budget.check(12_000_000, 64_000_000).expect_err("12 MB do not do").to_string();
        assert!(
            error.starts_with("camera 3840x1920 needs 12 frames of shared memory (89 MB)"),
            "{error}"
        );
        assert!(error.contains("has 12 MB free. Cure: mount -o remount,size="), "{error}");
    }
}
