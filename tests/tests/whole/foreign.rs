//! Stages that somebody else wrote: those that lie, one that works, and one of another version.

use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{
    BodyTruth, CONTRACT_VERSION, DetectedMarker, DetectionHeader, Detections, FrameEnd, FrameEnds,
    FrameHeader, Frames, Health, Healths, MeasuredBy, NONE, PixelFormat, PlanHeader, PlannedView,
    Plans, Pose, StopReason, Topic, Track, TrackHeader, Tracks, Transfer, TruthHeader, Truths,
    VERSION_ATTRIBUTE, ViewHeader, ViewKind, Views,
};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, Subscriber};
use flockeye_tables::{PoseRow, TruthRow, read};
use flockeye_tests::onlooker::{Tape, join, subscribe};
use flockeye_tests::{Flight, Scratch, WATCHDOG, flockeye, small_flight, unique};
use iceoryx2::node::Node;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::{AttributeSpecifier, NodeBuilder, ServiceName, SignalHandlingMode, ipc};
use rustix::process::Signal;

/// A publisher on a topic that says whatever it likes: iceoryx2's own, so that nothing of the
/// runtime stands between a lie and its reader.
struct Liar<T: Topic> {
    publisher: Publisher<ipc::Service, [T::Item], T::Header>,
    bell: Notifier<ipc::Service>,
}

/// Items in a liar's longest message.
const MAX_ITEMS: usize = 1_000;

impl<T: Topic> Liar<T>
where
    T::Item: Copy,
{
    fn on(node: &Node<ipc::Service>, name: &str) -> Self {
        let name: ServiceName = name.try_into().expect("a service's name");
        let publisher = node
            .service_builder(&name)
            .publish_subscribe::<[T::Item]>()
            .user_header::<T::Header>()
            .open()
            .expect("the launcher has created it")
            .publisher_builder()
            .initial_max_slice_len(MAX_ITEMS)
            .create()
            .expect("there is room for one more");
        let events = node.service_builder(&name).event().open().expect("the same");
        let bell = events.notifier_builder().create().expect("the same");
        Self { publisher, bell }
    }

    fn say(&self, header: T::Header, items: &[T::Item]) {
        let mut sample = self.publisher.loan_slice_uninit(items.len()).expect("memory of its own");
        *sample.user_header_mut() = header;
        sample.write_from_slice(items).send().expect("somebody listens");
        self.bell.notify().expect("somebody listens");
    }
}

/// Counts the messages that stages report as refused.
struct Refusals<'a> {
    healths: Subscriber<Healths>,
    flight: &'a Flight,
}

impl Refusals<'_> {
    /// The count of failures in the next report of a stage.
    fn of(&mut self, stage: &str) -> u64 {
        let start = Instant::now();
        // Waiting messages are older, so they are dropped.
        while self.healths.receive().expect("health can be read").is_some() {}
        loop {
            while let Some(message) = self.healths.receive().expect("health can be read") {
                if message.header.stage.to_string() == stage {
                    return message.header.failed;
                }
            }
            let output = self.flight.output();
            assert!(start.elapsed() < WATCHDOG, "{stage} is silent:\n{output}");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Tells a lie until each of its readers counts it as refused. A stage takes only the newest
    /// waiting message, and an honest one may have come since.
    fn after(&mut self, what: &str, readers: &[&str], lie: impl Fn()) {
        let before: Vec<_> = readers.iter().map(|reader| self.of(reader)).collect();
        lie();
        for (reader, before) in readers.iter().zip(before) {
            let start = Instant::now();
            while self.of(reader) == before {
                assert!(
                    start.elapsed() < WATCHDOG,
                    "{reader} takes {what} for true:\n{}",
                    self.flight.output()
                );
                lie();
            }
        }
    }
}

fn lie_with_frames(node: &Node<ipc::Service>, refusals: &mut Refusals<'_>) {
    let liar = Liar::<Frames>::on(node, Frames::NAME);
    let honest = FrameHeader { width: 1024, height: 512, stride: 1024, ..FrameHeader::default() };
    let lies = [
        ("a frame whose pixels are not there", honest),
        ("a frame of no size", FrameHeader { width: 0, height: 0, stride: 0, ..honest }),
        ("a frame of overlapping rows", FrameHeader { width: 32, stride: 1, height: 16, ..honest }),
        ("rows without end", FrameHeader { height: u32::MAX, stride: u32::MAX, ..honest }),
        (
            "chroma that is not there",
            FrameHeader {
                width: 32,
                height: 31,
                stride: 32,
                pixel_format: PixelFormat::Nv12.code(),
                ..honest
            },
        ),
        (
            "a curve without a gamma",
            FrameHeader {
                width: 32,
                height: 16,
                stride: 32,
                transfer: Transfer::Gamma.code(),
                gamma: f32::NAN,
                ..honest
            },
        ),
        // This one is true, but of another camera.
        ("a frame of another size", FrameHeader { width: 32, height: 16, stride: 32, ..honest }),
    ];
    for (what, header) in lies {
        refusals.after(what, &["rectification"], || liar.say(header, &[7; MAX_ITEMS]));
    }
}

fn lie_with_views(node: &Node<ipc::Service>, refusals: &mut Refusals<'_>) {
    let liar = Liar::<Views>::on(node, "flockeye/view/0");
    let honest = ViewHeader {
        camera_from_view: [0.0, 0.0, 0.0, 1.0],
        focal_px: 300.0,
        size_px: 30,
        stride: 30,
        kind: ViewKind::Partition.code(),
        target: NONE,
        ..ViewHeader::default()
    };
    let nowhere = Pose { position: [f64::NAN; 3], ..Pose::default() };
    let lies = [
        ("a view whose pixels are not there", ViewHeader { stride: 900, size_px: 900, ..honest }),
        ("rows that run out of the view", ViewHeader { stride: 60, ..honest }),
        ("a view of no size", ViewHeader { size_px: 0, stride: 0, ..honest }),
        ("a view that is not turned", ViewHeader { camera_from_view: [f64::NAN; 4], ..honest }),
        ("the thousandth view of a frame", ViewHeader { view_index: 1_000, ..honest }),
        ("a view cut for nothing known", ViewHeader { kind: 77, ..honest }),
        ("a view to be searched in no known way", ViewHeader { search: 77, ..honest }),
        (
            "a neighbour predicted nowhere",
            ViewHeader { has_prediction: 1, predicted_camera_from_markers: nowhere, ..honest },
        ),
    ];
    for (what, header) in lies {
        refusals.after(what, &["detection", "fusion"], || liar.say(header, &[7; MAX_ITEMS]));
    }
}

fn lie_with_plans(node: &Node<ipc::Service>, refusals: &mut Refusals<'_>) {
    let liar = Liar::<Plans>::on(node, Plans::NAME);
    let view = PlannedView {
        camera_from_view: [0.0, 0.0, 0.0, 1.0],
        focal_px: 300.0,
        size_px: 300,
        target: NONE,
        ..PlannedView::default()
    };
    let lies = [
        ("a view turned by NaN", PlannedView { camera_from_view: [f64::NAN; 4], ..view }),
        ("a view of 0 pixels", PlannedView { size_px: 0, ..view }),
        ("a view of 16000 pixels", PlannedView { size_px: 16_000, ..view }),
        ("a view at infinity", PlannedView { focal_px: f64::INFINITY, ..view }),
        ("a view that spins", PlannedView { rate_in_camera: [f64::NAN; 3], ..view }),
        ("a search in no known way", PlannedView { search: 77, ..view }),
        ("a region of interest of nobody", PlannedView { kind: ViewKind::Roi.code(), ..view }),
    ];
    for (what, view) in lies {
        let plan = PlanHeader { plan_id: 1, ..PlanHeader::default() };
        refusals.after(what, &["rectification"], || liar.say(plan, &[view]));
    }
    refusals.after("a thousand views", &["rectification"], || {
        liar.say(PlanHeader::default(), &[view; 1_000]);
    });
    let lawless = PlanHeader { stop_rule: 77, ..PlanHeader::default() };
    refusals.after("a rule nobody knows", &["rectification"], || liar.say(lawless, &[view]));
}

fn lie_with_detections(node: &Node<ipc::Service>, refusals: &mut Refusals<'_>) {
    let liar = Liar::<Detections>::on(node, Detections::NAME);
    let marker = DetectedMarker {
        rays_in_camera: [[1.0, 0.0, 0.0]; 4],
        deviations: [1e-3; 4],
        ..DetectedMarker::default()
    };
    let lies = [
        ("rays of length 2", DetectedMarker { rays_in_camera: [[2.0, 0.0, 0.0]; 4], ..marker }),
        ("rays of NaN", DetectedMarker { rays_in_camera: [[f64::NAN; 3]; 4], ..marker }),
        ("corners without a deviation", DetectedMarker { deviations: [0.0; 4], ..marker }),
    ];
    let readers = ["rectification", "fusion"];
    for (what, marker) in lies {
        let header = DetectionHeader { hits: 1, ..DetectionHeader::default() };
        refusals.after(what, &readers, || liar.say(header, &[marker]));
    }
    let boasting = DetectionHeader { hits: 9, ..DetectionHeader::default() };
    refusals.after("nine hits among one marker", &readers, || liar.say(boasting, &[marker]));
    refusals.after("a thousand markers", &readers, || {
        liar.say(DetectionHeader::default(), &[marker; 1_000]);
    });
}

fn lie_with_frame_ends(node: &Node<ipc::Service>, refusals: &mut Refusals<'_>) {
    let liar = Liar::<FrameEnds>::on(node, FrameEnds::NAME);
    let end = FrameEnd { reason: 77, ..FrameEnd::default() };
    refusals.after("a frame that ended for no reason", &["fusion"], || liar.say(end, &[]));
}

/// Topics that only the launcher reads, which counts nothing, but says what it refuses.
///
/// Messages of a publisher end with it, so this one stays until its message was received.
fn lie_to_the_launcher(node: &Node<ipc::Service>, flight: &Flight) {
    let nowhere = Pose { position: [f64::NAN; 3], ..Pose::default() };
    let tracks = Liar::<Tracks>::on(node, Tracks::NAME);
    let track = Track { observer_from_target: nowhere, ..bytemuck::Zeroable::zeroed() };
    tracks.say(TrackHeader::default(), &[track]);
    wait_for_refusal(flight, Tracks::NAME, "position is not a finite number");
    let healths = Liar::<Healths>::on(node, Healths::NAME);
    healths.say(Health { stage: "fusion".into(), state: 99, ..Health::default() }, &[]);
    wait_for_refusal(flight, Healths::NAME, "unknown stage state code 99");
    let truths = Liar::<Truths>::on(node, Truths::NAME);
    let body = BodyTruth { observer_from_target: nowhere, ..BodyTruth::default() };
    truths.say(TruthHeader::default(), &[body]);
    wait_for_refusal(flight, Truths::NAME, "position is not a finite number");
}

/// Waits for the words on a refused message: they are the same from every stage.
fn wait_for_refusal(flight: &Flight, topic: &str, reason: &str) {
    let start = Instant::now();
    let parts = ["message refused", reason, &format!("topic=\"{topic}\"")];
    let is_there =
        || flight.output().lines().any(|line| parts.iter().all(|part| line.contains(part)));
    while !is_there() {
        let output = flight.output();
        assert!(start.elapsed() < WATCHDOG, "no line with {parts:?} in:\n{output}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_foreign_publisher_that_lies_on_every_topic_is_refused_and_poses_stay_right() {
    let scratch = Scratch::new("liar");
    let (poses, truth) = (scratch.path("poses.csv"), scratch.path("truth.csv"));
    let paths = [&poses, &truth].map(|path| path.to_str().expect("a plain path"));
    let arguments = ["--poses", paths[0], "--truth", paths[1]];
    let mut flight = Flight::with_poses("liar", &arguments, &small_flight(&[]));
    let mut ports = join(&mut flight);
    let healths = subscribe::<Healths>(&mut flight, &mut ports);
    let mut tracks = subscribe::<Tracks>(&mut flight, &mut ports);
    let node = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&flight.instance.iceoryx2().expect("its folder is known"))
        .create::<ipc::Service>()
        .expect("there is room for one more");
    let mut refusals = Refusals { healths, flight: &flight };
    lie_with_frames(&node, &mut refusals);
    lie_with_views(&node, &mut refusals);
    lie_with_plans(&node, &mut refusals);
    lie_with_detections(&node, &mut refusals);
    lie_with_frame_ends(&node, &mut refusals);
    drop(refusals);
    lie_to_the_launcher(&node, &flight);

    let reasons = [
        (Frames::NAME, "524288 bytes of payload, 1000 are there"),
        (Views::NAME, "810000 bytes of payload, 1000 are there"),
        (Plans::NAME, "quaternion has length NaN"),
        (Detections::NAME, "a ray of length 2"),
        (FrameEnds::NAME, "unknown stop reason code 77"),
    ];
    for (topic, reason) in reasons {
        wait_for_refusal(&flight, topic, reason);
    }

    // And poses come as if nothing had been said.
    while tracks.receive().expect("tracks can be read").is_some() {}
    let mut after = Vec::new();
    let start = Instant::now();
    while after.len() < 20 {
        assert!(start.elapsed() < WATCHDOG, "no pose any more:\n{}", flight.output());
        while let Some(message) = tracks.receive().expect("tracks can be read") {
            let is_measured =
                message.items().iter().any(|track| track.measured_by != MeasuredBy::Nothing.code());
            after.extend(is_measured.then_some(message.header.stamp.sequence));
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    drop((tracks, ports, node));
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    let output = flight.output();
    assert!(!output.contains("started again"), "a stage did not survive a lie:\n{output}");
    assert_poses_are_right(&read(&poses).expect("poses"), &read(&truth).expect("truth"));
    flight.assert_nothing_left();
}

fn assert_poses_are_right(poses: &[PoseRow], truths: &[TruthRow]) {
    let measured: Vec<_> = poses.iter().filter(|row| row.is_measured()).collect();
    assert!(measured.len() > 20, "{} poses", measured.len());
    measured.into_iter().for_each(|row| assert_is_true(row, truths));
}

/// A measured pose is where the truth of its frame has the body.
pub(crate) fn assert_is_true(row: &PoseRow, truths: &[TruthRow]) {
    let truth = truths.iter().find(|truth| (truth.frame, &truth.body) == (row.frame, &row.target));
    let truth = truth.expect("each frame has its truth");
    let off = (row.position - truth.position()).norm();
    assert!(off < 0.1, "frame {} is off by {off:.3} m", row.frame);
}

#[test]
fn a_detector_that_somebody_else_wrote_takes_the_place_of_ours() {
    let scratch = Scratch::new("swapped");
    let poses = scratch.path("poses.csv");
    let arguments = ["--profile", "repeat", "--poses", poses.to_str().expect("a plain path")];
    let command =
        format!(r#"stages.detection.command=["{}"]"#, env!("CARGO_BIN_EXE_silent-detector"));
    let set = small_flight(&["simulator.frames=20", "stages.detection.replicas=2", &command]);
    let tape = Tape::record("swapped", &arguments, &set);
    tape.assert_every_frame_ended_once(20);
    for end in &tape.ends {
        let is_whole =
            [StopReason::Complete, StopReason::Budget].iter().any(|it| it.code() == end.reason);
        assert!(is_whole && end.views_issued > 0, "{end:?}\n{}", tape.output);
    }
    assert!(tape.tracks.iter().all(|(_, tracks)| tracks.is_empty()), "{}", tape.output);
    let rows: Vec<PoseRow> = read(&poses).expect("the file is there");
    assert_eq!(rows, [], "a detector that finds nothing gave poses");
    assert!(tape.output.contains("20 frames searched, 0 skipped"), "{}", tape.output);
}

#[test]
fn a_stage_of_another_contract_version_is_refused_and_told_the_versions() {
    let instance = Instance::named(&unique("version"));
    let ownership = instance.take().expect("nobody else has the name");
    let pipeline = Pipeline::default();
    let resolved = Resolved::of(pipeline.clone()).expect("it is what is shipped");
    instance.write_configuration(&resolved).expect("the folder is there");
    let node = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&instance.iceoryx2().expect("its folder is known"))
        .create::<ipc::Service>()
        .expect("shared memory can be had");
    // Health is what every stage opens first.
    let name: ServiceName = Healths::NAME.try_into().expect("a service's name");
    let version = AttributeSpecifier::new()
        .define(&VERSION_ATTRIBUTE.try_into().expect("a key"), &"0".try_into().expect("a value"))
        .expect("there is room for an attribute");
    let data = node
        .service_builder(&name)
        .publish_subscribe::<[u8]>()
        .user_header::<Health>()
        .create_with_attributes(&version)
        .expect("it is not there yet");
    let bell = node.service_builder(&name).event().create().expect("it is not there yet");

    let resolved = Resolved::of(pipeline).expect("a configuration");
    let budget = Budget::of(&resolved);
    let mut ports = Ports::new(std::rc::Rc::new(node), budget, SharedCounters::default());
    let refused = ports.subscriber::<Healths>().err().expect("it is another version");
    let text = refused.to_string();
    let ours = format!("contract version {CONTRACT_VERSION}");
    for part in [Healths::NAME, &ours] {
        assert!(text.contains(part), "{part:?} is missing in: {text}");
    }

    let stage = Command::new(flockeye().with_file_name("flockeye-fusion"))
        .env("FLOCKEYE_INSTANCE_DIR", instance.folder())
        .output()
        .expect("the stage can be started");
    let said = String::from_utf8_lossy(&stage.stderr);
    assert_eq!(stage.status.code(), Some(2), "{said}");
    for part in ["cannot start", Healths::NAME, &ours] {
        assert!(said.contains(part), "{part:?} is missing in: {said}");
    }
    drop((ports, data, bell, ownership));
    assert_eq!(instance.shared_memory(), Vec::<std::path::PathBuf>::new());
}
