//! Size of each topic's shared memory, and the check against free memory.
//!
//! For each publisher, iceoryx2 reserves chunks for the worst case: subscribers * (buffer +
//! borrowed) + history + loaned. Its default limits would reserve 34 frames, so Flockeye sets its
//! own.

use std::fmt;
use std::time::Duration;

use anyhow::ensure;
use flockeye_config::{Flow, Pipeline, RecordedFrames, Resolved};
use flockeye_contract::{
    BodyTruth, DetectedMarker, Frames, JournalEntry, MAX_IMU_SAMPLES, MAX_JOURNAL_ENTRIES,
    MAX_PACKET_BYTES, MAX_PLANNED_VIEWS, PlannedView, StageName, TOPICS, Topic, TopicId, TopicInfo,
    Track,
};

/// Limits of one topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// The topic's name.
    pub topic: &'static str,
    /// Whether the topic is split into lanes, whose services have the lane's number in their names.
    pub has_lanes: bool,
    /// Services of this topic: one, or one for each detection worker.
    pub lanes: usize,
    /// Publishers at once: old, new, and dead ones not cleaned up yet.
    pub publishers: usize,
    /// Publishers in normal operation, over all lanes, for the memory budget.
    pub usual_publishers: usize,
    /// Subscribers at once, tools included.
    pub subscribers: usize,
    /// Maximum number of messages that wait at a subscriber.
    pub buffer: usize,
    /// Maximum number of messages that wait at a subscriber that must not be late.
    pub usual_buffer: usize,
    /// Maximum wait of a publisher for a subscriber whose buffer is full. `None`: it does not wait,
    /// and the oldest message is dropped.
    pub patience: Option<Duration>,
    /// Maximum number of messages that a subscriber may keep.
    pub borrowed: usize,
    /// Number of past messages that a late subscriber still receives.
    pub history: usize,
    /// Maximum number of messages that a publisher may write at once.
    pub loaned: usize,
    /// Maximum number of items in a message. For a topic that grows: the items of usual messages.
    pub items: usize,
    /// Maximum number of items, for a topic whose memory grows when a message exceeds `items`.
    pub grows_to: Option<usize>,
    /// Bytes of an item.
    pub item_bytes: usize,
    /// Bytes of the header.
    pub header_bytes: usize,
}

impl Limits {
    /// Chunks of one publisher's data segment, by iceoryx2's formula.
    pub fn chunks(&self) -> usize {
        self.subscribers * (self.buffer + self.borrowed) + self.history + self.loaned
    }

    /// Bytes of one publisher's data segment.
    pub(crate) fn segment_bytes(&self) -> usize {
        // iceoryx2's own header before each chunk is 40 bytes; the chunk is aligned to 8.
        self.chunks() * (self.items * self.item_bytes + self.header_bytes + 48)
    }

    /// Bytes in normal operation.
    pub fn bytes(&self) -> usize {
        self.usual_publishers * self.segment_bytes()
    }
}

/// Maximum number of nodes (processes) in one instance: stages, their successors, tools.
pub(crate) const MAX_NODES: usize = 40;

/// Maximum number of listeners and notifiers of one topic's event.
pub(crate) const MAX_EVENT_PORTS: usize = 40;

/// Maximum number of markers in one detection record of Flockeye's own stages.
const MARKERS: usize = 64;
/// Ratio of a frame's bytes to a usual packet's: half a bit for each pixel.
const PACKET_SHARE: usize = 16;
/// Maximum number of tracks in one message.
pub const MAX_TRACKS: usize = 16;
/// Maximum number of sightings in one message of `peer`.
pub(crate) const MAX_PEER_SIGHTINGS: usize = 16;
/// Maximum number of poses in one message of `swarm`: the maximum number of observers.
pub(crate) const MAX_SWARM_POSES: usize = 64;
/// Maximum number of bodies in one frame's truth.
const TRUTH_BODIES: usize = 32;

/// Limits of every topic, in the order of the dataflow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Budget {
    /// The limits of each topic.
    pub topics: Vec<Limits>,
    camera: (u32, u32),
    frame_bytes: usize,
    frames: usize,
}

/// Number of views, over all lanes, that fusion keeps until their records arrive.
pub fn held_views_waiting(pipeline: &Pipeline) -> usize {
    // Rectification has this many in flight. One more may arrive before the answer to the previous
    // one.
    pipeline.detection_workers() as usize * pipeline.rectification.window as usize + 1
}

/// Views that fusion keeps because they show a neighbour best: one for each body, and some of the
/// next frame.
pub fn held_views_best(resolved: &Resolved) -> usize {
    resolved.bodies.len().clamp(1, MAX_TRACKS) + 2
}

/// Limits of a topic: numbers and sizes of its messages, which the table of topics does not
/// contain.
fn limits(topic: &TopicInfo, resolved: &Resolved, largest_view_px: u32) -> Limits {
    let pipeline = &resolved.pipeline;
    let lanes = if topic.has_lanes() { pipeline.detection_workers() as usize } else { 1 };
    // Number of publishers of each lane.
    let publishers = usual_publishers(topic, pipeline);
    let usual = Limits {
        topic: topic.name,
        has_lanes: topic.has_lanes(),
        lanes,
        // Twice as many as in normal operation: a successor starts while the old process still
        // runs.
        publishers: 2 * publishers + 1,
        usual_publishers: lanes * publishers,
        subscribers: 4,
        buffer: 64,
        usual_buffer: 64,
        // A lossless run waits for fusion: its input must not depend on time.
        patience: match pipeline.flow() {
            Flow::Lossless if topic.has_lanes() => Some(pipeline.view_overdue()),
            Flow::Lossless | Flow::Latest => None,
        },
        borrowed: 2,
        history: 0,
        loaned: 1,
        items: 0,
        grows_to: (topic.id == TopicId::Packets).then_some(MAX_PACKET_BYTES),
        item_bytes: topic.item_bytes,
        header_bytes: topic.header_bytes,
    };
    let sized = sized(topic.id, usual, resolved, largest_view_px);
    let buffer = sized.buffer + late_views(topic.id, pipeline);
    Limits { buffer, usual_buffer: sized.buffer, ..sized }
}

/// Limits of a topic whose numbers of messages and items differ from the usual ones.
fn sized(topic: TopicId, usual: Limits, resolved: &Resolved, largest_view_px: u32) -> Limits {
    let pipeline = &resolved.pipeline;
    match topic {
        // Rectification keeps up to four frames: one awaiting answers, one being cut, the next, and
        // briefly a newer one. Egomotion keeps one. A successor and a tool may also read.
        TopicId::Frames => {
            let items = frame_bytes(pipeline);
            Limits { buffer: 1, borrowed: 4, loaned: 2, items, ..usual }
        }
        // A camera's packets are far smaller than its frames, and their size is unknown in advance.
        // At 30 frames/s a recorder that sleeps for half a second misses none.
        TopicId::Packets => {
            let items = frame_bytes(pipeline) / PACKET_SHARE;
            Limits { subscribers: 2, buffer: 16, borrowed: 1, items, ..usual }
        }
        TopicId::Imus => Limits { items: MAX_IMU_SAMPLES, ..usual },
        TopicId::Rotations => Limits { subscribers: 6, buffer: 16, ..usual },
        // At 30 frames/s a recorder that sleeps for a quarter of a second misses none.
        TopicId::Plans => Limits { buffer: 8, history: 1, items: MAX_PLANNED_VIEWS, ..usual },
        // Subscribers of each lane: its worker, fusion, the successor of one of them, and a tool.
        TopicId::Views => Limits {
            buffer: usual_views(pipeline),
            // In the worst case all views that fusion keeps are of one lane, and it reads one more.
            borrowed: held_views_waiting(pipeline) + held_views_best(resolved) + 1,
            items: (largest_view_px as usize).pow(2),
            ..usual
        },
        TopicId::Detections => {
            // Rectification, fusion, a successor, and the launcher for up to three purposes.
            Limits { subscribers: 6, buffer: records_in_flight(resolved), items: MARKERS, ..usual }
        }
        TopicId::FrameEnds => Limits { buffer: 16, ..usual },
        // Gateway, ROS 2, autopilot, the successor of one of them, the launcher, recorder, viewer,
        // and tools.
        TopicId::Tracks => Limits { subscribers: 10, items: MAX_TRACKS, ..usual },
        // Fusion publishes a message whenever it has no work left: at worst some hundred each
        // second.
        TopicId::Journals => {
            Limits { subscribers: 3, buffer: 128, items: MAX_JOURNAL_ENTRIES, ..usual }
        }
        TopicId::Odometries => usual,
        // A report with more sightings is split into several messages.
        TopicId::Peers => Limits { subscribers: 6, buffer: 32, items: MAX_PEER_SIGHTINGS, ..usual },
        TopicId::Swarms => Limits { subscribers: 5, buffer: 4, items: MAX_SWARM_POSES, ..usual },
        TopicId::Healths => Limits { subscribers: 8, ..usual },
        TopicId::Truths => Limits { items: TRUTH_BODIES, ..usual },
        // Every process reads this topic, including those that start later.
        TopicId::HandOvers => Limits { subscribers: MAX_NODES, buffer: 4, history: 1, ..usual },
        TopicId::Complaints => usual,
    }
}

/// Frames that rectification has in flight: one that waits for answers, and one that is being cut.
const FRAMES_IN_FLIGHT: usize = 2;

/// Maximum number of a lane's views that wait for its worker and for other stages.
fn usual_views(pipeline: &Pipeline) -> usize {
    pipeline.rectification.window as usize + 2
}

/// Additional waiting views of a lane for a recorder, so that it misses few or none under full
/// load. Their memory is reserved, and touched only then. A worker receives some ten views of a
/// frame. In a lossless run publishers wait for the recorder.
fn late_views(topic: TopicId, pipeline: &Pipeline) -> usize {
    /// Additional views where pixels are recorded: a single missing view ends a replay.
    const OF_RECORDED_VIEWS: usize = 32;
    /// Total number of waiting views where at most their headers are recorded.
    const OF_HEADERS: usize = 16;
    if topic != TopicId::Views || pipeline.flow() == Flow::Lossless {
        return 0;
    }
    let recording = &pipeline.recording;
    match recording.folder.is_some() && recording.frames == RecordedFrames::Views {
        true => OF_RECORDED_VIEWS,
        false => OF_HEADERS.saturating_sub(usual_views(pipeline)),
    }
}

/// Maximum number of detection records of one worker that wait for a subscriber. None is lost while
/// fusion waits for the answers to all frames in flight.
///
/// At worst one worker answers all views of those frames, because the others are stalled. A stalled
/// worker that wakes up also answers its window of views that others have answered meanwhile.
fn records_in_flight(resolved: &Resolved) -> usize {
    let tiles = resolved.partition_views.len() + resolved.high_resolution_tiles.len();
    let proposals = resolved.pipeline.proposals();
    let planned = (tiles + MAX_TRACKS + proposals).min(MAX_PLANNED_VIEWS);
    FRAMES_IN_FLIGHT * planned + resolved.pipeline.rectification.window as usize
}

/// Bytes of a frame's luma plane.
fn frame_bytes(pipeline: &Pipeline) -> usize {
    pipeline.camera.width as usize * pipeline.camera.height as usize
}

/// Number of processes that publish a topic in normal operation. Only one of the sources runs.
fn usual_publishers(topic: &TopicInfo, pipeline: &Pipeline) -> usize {
    let (sources, others): (Vec<_>, Vec<_>) =
        topic.publishers.iter().partition(|stage| stage.is_source());
    let others: u32 = others.into_iter().map(|&stage| pipeline.replicas(stage)).sum();
    usize::from(!sources.is_empty()) + others as usize
}

impl Budget {
    /// The limits that a configuration needs, for each topic of the contract.
    pub fn of(resolved: &Resolved) -> Self {
        Self::for_views_of(resolved, resolved.largest_view_px())
    }

    /// The budget where the largest view has sides of `largest_view_px` pixels.
    pub fn for_views_of(resolved: &Resolved, largest_view_px: u32) -> Self {
        let pipeline = &resolved.pipeline;
        let topics: Vec<Limits> =
            TOPICS.iter().map(|topic| limits(topic, resolved, largest_view_px)).collect();
        let frames = topics.iter().find(|limits| limits.topic == Frames::NAME);
        Self {
            camera: (pipeline.camera.width, pipeline.camera.height),
            frame_bytes: frame_bytes(pipeline),
            frames: frames.map_or(0, Limits::chunks),
            topics,
        }
    }

    /// Limits of one topic.
    #[expect(clippy::expect_used, reason = "the budget has a row for each row of the table")]
    pub fn topic<T: Topic>(&self) -> &Limits {
        let found = self.topics.iter().find(|limits| limits.topic == T::NAME);
        found.expect("limits of each topic") // `topics` has each topic of `TOPICS`.
    }

    /// Bytes that one more process of a stage needs.
    pub fn bytes_of(&self, stage: StageName) -> usize {
        let published =
            TOPICS.iter().zip(&self.topics).filter(|(topic, _)| topic.publishers.contains(&stage));
        published.map(|(_, limits)| limits.lanes * limits.segment_bytes()).sum()
    }

    /// Bytes of all topics.
    pub fn bytes(&self) -> usize {
        self.topics.iter().map(Limits::bytes).sum()
    }

    /// Refuses a budget that exceeds free memory: running out later would end a process by SIGBUS.
    ///
    /// # Errors
    /// Too little memory is free; the message has both numbers and the cure.
    pub fn check(&self, free_bytes: u64, total_bytes: u64) -> anyhow::Result<()> {
        let needed = self.bytes() as u64;
        let mb = |bytes: u64| bytes.div_ceil(1_000_000);
        let (width, height) = self.camera;
        ensure!(
            needed <= free_bytes,
            "camera {width}x{height} needs {} frames of shared memory ({} MB), {} MB with all else; /dev/shm \
             has {} MB free. Cure: mount -o remount,size={}M /dev/shm",
            self.frames,
            mb((self.frames * self.frame_bytes) as u64),
            mb(needed),
            free_bytes / 1_000_000,
            mb((total_bytes - free_bytes.min(total_bytes)) + needed * 5 / 4)
        );
        Ok(())
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

// Sizes of the largest messages, on which the numbers of items above rely.
const _: () = assert!(size_of::<DetectedMarker>() * MARKERS < 16_384);
const _: () = assert!(size_of::<Track>() * MAX_TRACKS < 25_600);
const _: () = assert!(size_of::<JournalEntry>() * MAX_JOURNAL_ENTRIES < 4_096);
const _: () = assert!(size_of::<BodyTruth>() * TRUTH_BODIES < 8_192);
const _: () = assert!(size_of::<PlannedView>() < 256);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_contract::{Detections, Healths, Views};

    #[test]
    fn limits_follow_the_table_of_topics() {
        let budget = Budget::of(&Resolved::of(Pipeline::default()).unwrap());
        let names: Vec<_> = budget.topics.iter().map(|topic| topic.topic).collect();
        assert_eq!(names, TOPICS.iter().map(|topic| topic.name).collect::<Vec<_>>());
        assert_eq!(budget.topic::<Frames>().usual_publishers, 1, "one of the sources runs");
        assert_eq!(budget.topic::<Detections>().usual_publishers, 2);
        assert_eq!(budget.topic::<Healths>().usual_publishers, 10);
        let views = budget.topic::<Views>();
        assert_eq!((views.lanes, views.usual_publishers, views.publishers), (2, 2, 3));
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
            let resolved = Resolved::of(Pipeline::parse("", &overrides, "x").unwrap()).unwrap();
            let tiles = resolved.partition_views.len() + resolved.high_resolution_tiles.len();
            let planned = tiles + MAX_TRACKS + resolved.pipeline.proposals();
            let planned = planned.min(MAX_PLANNED_VIEWS);
            assert!(planned <= MAX_PLANNED_VIEWS);
            let late = resolved.pipeline.rectification.window as usize;
            let buffer = Budget::of(&resolved).topic::<Detections>().buffer;
            assert_eq!(buffer, 2 * planned + late, "{overrides:?}");
        }
    }

    #[test]
    fn views_have_more_room_where_they_are_recorded_in_flight() {
        let buffers = |overrides: &[&str]| {
            let overrides: Vec<String> = overrides.iter().copied().map(String::from).collect();
            let resolved = Resolved::of(Pipeline::parse("", &overrides, "x").unwrap()).unwrap();
            let budget = Budget::of(&resolved);
            let views = budget.topic::<Views>();
            (views.buffer, views.usual_buffer)
        };
        let recorded = ["recording.folder=flights", "recording.frames=views"];
        assert_eq!(buffers(&[]), (16, 4), "somebody may record headers");
        assert_eq!(buffers(&recorded), (36, 4));
        assert_eq!(buffers(&recorded[1..]), (16, 4), "nothing is recorded");
        assert_eq!(buffers(&["profile=repeat"]), (4, 4), "who reads is waited for");
        assert_eq!(buffers(&[recorded[0], recorded[1], "profile=repeat"]), (4, 4));
    }

    #[test]
    fn too_little_memory_names_numbers_and_cure() {
        let budget = Budget::of(&Resolved::of(Pipeline::default()).unwrap());
        assert!(budget.check(10_000_000_000, 20_000_000_000).is_ok());
        let error = budget.check(12_000_000, 64_000_000).expect_err("12 MB do not do").to_string();
        assert!(
            error.starts_with("camera 3840x1920 needs 22 frames of shared memory (163 MB)"),
            "{error}"
        );
        assert!(error.contains("has 12 MB free. Cure: mount -o remount,size="), "{error}");
    }
}
