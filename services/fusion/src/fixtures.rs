//! What tests of fusion share: bodies, poses, records, and trackers that have seen them.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs, reason = "of the drawings")]

use std::collections::BTreeMap;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, OnceLock};

use flockeye_contract::{
    DetectedMarker, DetectionHeader, FrameEnd, FrameStamp, Transfer, ViewHeader, ViewKind,
};
use flockeye_geometry::body::{Bodies, Body, squares};
use flockeye_geometry::filter::{MotionModel, TrackPolicy};
use flockeye_geometry::partition::Partition;
use flockeye_geometry::search::{GazeOptions, Plan, Planner, Purpose, SearchMode};
use flockeye_geometry::view::View;
use flockeye_imaging::align::{Alignment, Evidence, Picture, is_precise};
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Isometry3, Matrix2, Matrix6, Point3, Translation3, UnitQuaternion};

use crate::drawn_body::{Drawing, draw, prints};
use crate::frame::parts::Parts;
use crate::hypothesis::{Aligner, BestView};
use crate::measure::{AnsweredView, BestViews};
use crate::measurement::{MeasuredBy, Measurement, PoseEstimate};
use crate::planning::Planning;
use crate::policy::TimeBudget;
use crate::record::Record;
use crate::target::Update;
use crate::tracker::{FilterChoice, FrameTime, Tracker};

pub const PIXELS_PER_RADIAN: f64 = 611.0;
pub const INTERVAL_S: f64 = 1.0 / 30.0;

pub fn alpha() -> Body {
    squares("alpha", 0.0625, 0.05, 0)
}

pub fn bravo() -> Body {
    squares("bravo", 0.0625, 0.05, 17)
}

/// `camera_from_markers`, turned by this angle in radians.
pub fn pose(turn: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(0.7, 0.5, 0.3),
        UnitQuaternion::from_euler_angles(0.3, -0.2, turn),
    )
}

pub fn aligner(bodies: &Bodies) -> Aligner {
    let prints = prints();
    Aligner::new(bodies, |id| prints.get(&id), PIXELS_PER_RADIAN).unwrap()
}

pub fn tracker_of(bodies: Vec<Body>, threads: usize) -> Tracker {
    let bodies = Bodies::new("DICT_5X5_250".into(), bodies).unwrap();
    // Targets jump here from one frame to the next, farther than real ones do.
    let motion = MotionModel { acceleration: 1.5, ..MotionModel::default() };
    let policy = TrackPolicy { motion, confirm_hits: 3, ..TrackPolicy::default() };
    Tracker::new(&bodies, FilterChoice::Tracks(policy), Arc::new(aligner(&bodies)), threads)
}

pub fn planner() -> Planner {
    let partition = Partition::icosahedron();
    let views = partition.views(0.1, PIXELS_PER_RADIAN).unwrap();
    let gaze = GazeOptions::new(PIXELS_PER_RADIAN);
    Planner::new(SearchMode::Gaze, partition, views, gaze).unwrap()
}

/// The first plan of a process.
pub fn plan() -> Plan {
    Planning::new(planner()).next(&tracker_of(vec![alpha()], 1)).plan
}

/// A tracker, with the parts of its targets in frames that have not ended.
pub struct Tracking {
    tracker: Tracker,
    parts: BTreeMap<u64, Parts>,
}

impl Tracking {
    pub fn of(tracker: Tracker) -> Self {
        Self { tracker, parts: BTreeMap::new() }
    }

    pub fn with_background(self) -> Self {
        Self { tracker: self.tracker.with_background(), ..self }
    }

    /// The tracker, with the parts of its targets in a frame.
    pub fn at(&mut self, sequence: u64) -> (&mut Tracker, &mut Parts) {
        let targets = self.tracker.targets().len();
        let parts = self.parts.entry(sequence).or_insert_with(|| Parts::new(targets, |_| false));
        (&mut self.tracker, parts)
    }

    /// The parts of a frame, if it has not ended.
    pub fn open_parts(&mut self, sequence: u64) -> (&mut Tracker, Option<&mut Parts>) {
        (&mut self.tracker, self.parts.get_mut(&sequence))
    }

    pub fn take_in(
        &mut self,
        time: FrameTime,
        target: usize,
        measurement: &Measurement,
    ) -> Option<Update> {
        let (tracker, parts) = self.at(time.order.2);
        tracker.take_in(time, target, parts.get_mut(target), measurement)
    }
}

impl Deref for Tracking {
    type Target = Tracker;

    fn deref(&self) -> &Tracker {
        &self.tracker
    }
}

impl DerefMut for Tracking {
    fn deref_mut(&mut self) -> &mut Tracker {
        &mut self.tracker
    }
}

pub fn stamp(sequence: u64) -> FrameStamp {
    FrameStamp { sequence, exposure_ns: (at_s(sequence) * 1e9) as i64, ..FrameStamp::default() }
}

pub fn at_s(sequence: u64) -> f64 {
    10.0 + sequence as f64 * INTERVAL_S
}

pub fn time(sequence: u64) -> FrameTime {
    FrameTime { order: stamp(sequence).order(), at_s: at_s(sequence), number: sequence }
}

/// The first of a body's markers that face the camera, at most `most` of them.
pub fn facing_markers(body: &Body, pose: &Isometry3<f64>, most: usize) -> Vec<DetectedMarker> {
    let eye = pose.inverse_transform_point(&Point3::origin());
    let facing = body
        .markers
        .iter()
        .filter(|marker| marker.normal().dot(&(eye - marker.centre()).normalize()) > 0.5);
    facing
        .take(most)
        .map(|marker| DetectedMarker {
            rays_in_camera: marker.corners.map(|corner| (pose * corner).coords.normalize().into()),
            deviations: [2e-4; 4],
            id: marker.id,
            ..DetectedMarker::default()
        })
        .collect()
}

/// What detection finds in a view of alpha at `pose`.
pub fn record(sequence: u64, pose: &Isometry3<f64>) -> Record {
    Record { markers: facing_markers(&alpha(), pose, usize::MAX), ..empty_record(sequence) }
}

/// A view in which no marker was found.
pub fn empty_record(sequence: u64) -> Record {
    let header = DetectionHeader { stamp: stamp(sequence), ..DetectionHeader::default() };
    Record { header, markers: Vec::new() }
}

/// Alpha at `pose(0.9)`. It is drawn once, because drawing takes longer than all else here.
pub fn shown() -> &'static (View, Vec<u8>) {
    static SHOWN: OnceLock<(View, Vec<u8>)> = OnceLock::new();
    SHOWN.get_or_init(|| {
        let drawing = drawing(&pose(0.9));
        let image = drawing.image();
        let pixels = (0..image.height()).flat_map(|y| image.row(y).to_vec()).collect();
        (drawing.view, pixels)
    })
}

/// View 0 of the plan `plan_id`: the region of alpha, as in [`shown`].
pub fn region_view(sequence: u64, plan_id: u64) -> ViewHeader {
    let (view, _) = shown();
    ViewHeader {
        stamp: stamp(sequence),
        plan_id,
        view_index: 0,
        kind: ViewKind::Gaze.code(),
        target: 0,
        camera_from_view: view.camera_from_view.coords.into(),
        focal_px: view.focal_px,
        size_px: view.size_px,
        stride: view.size_px,
        transfer: Transfer::Srgb.code(),
        ..ViewHeader::default()
    }
}

/// Its record, with alpha's markers at a pose.
pub fn region_record(sequence: u64, plan_id: u64, camera_from_markers: &Isometry3<f64>) -> Record {
    let mut record = record(sequence, camera_from_markers);
    let view = shown().0;
    for marker in &mut record.markers {
        marker.corners_in_view = marker.rays_in_camera.map(|ray| {
            let ray = nalgebra::Unit::new_normalize(nalgebra::Vector3::from(ray));
            let pixel = view.project(&ray).expect("it is in the view").0;
            [pixel.x as f32, pixel.y as f32]
        });
    }
    let header = DetectionHeader { plan_id, hits: record.markers.len() as u32, ..record.header };
    Record { header, ..record }
}

/// The end of a frame in which so many views were cut.
pub fn region_end(sequence: u64, plan_id: u64, views_issued: u32) -> FrameEnd {
    FrameEnd { stamp: stamp(sequence), plan_id, views_issued, ..FrameEnd::default() }
}

/// A record of alpha's region of interest.
pub fn of_region(record: &Record) -> AnsweredView<'_> {
    AnsweredView { record, purpose: Some(Purpose::Gaze(0)), view: None }
}

/// A record of a tile.
pub fn of_tile(record: &Record) -> AnsweredView<'_> {
    AnsweredView { record, purpose: Some(Purpose::Partition(0)), view: None }
}

/// The corner pass over alpha's region, in which its markers were found at `pose`.
pub fn see(tracker: &mut Tracking, sequence: u64, pose: &Isometry3<f64>) -> Vec<Update> {
    let record = record(sequence, pose);
    let (answered, views) = ([of_region(&record)], BestViews::new());
    let (tracker, parts) = tracker.at(sequence);
    tracker.region_pass(time(sequence), parts, &answered, &views, TimeBudget::Unlimited)
}

/// Ends a frame of which nothing more is known.
pub fn end(tracking: &mut Tracking, sequence: u64) -> Vec<Update> {
    let (time, views) = (time(sequence), BestViews::new());
    let (tracker, parts) = tracking.at(sequence);
    let updates = tracker.final_pass(time, parts, &[], &views, TimeBudget::Unlimited);
    tracker.end_frame(time.order, time.at_s, parts);
    tracking.parts.remove(&sequence);
    updates
}

/// A tracker that has measured alpha in frames 0 to 2.
pub fn following(pose: &Isometry3<f64>) -> Tracking {
    let mut tracker = Tracking::of(tracker_of(vec![alpha()], 1));
    for sequence in 0..3 {
        assert_eq!(see(&mut tracker, sequence, pose).len(), 1);
        assert!(end(&mut tracker, sequence).is_empty(), "its pose has left already");
    }
    tracker
}

/// What alignment has led to: a pose with these log odds, and this deviation along and about each
/// axis, metres and radians.
pub fn alignment(camera_from_markers: Isometry3<f64>, log_odds: f64, sigma: f64) -> Alignment {
    let covariance = Matrix6::from_diagonal_element(sigma * sigma);
    Alignment {
        camera_from_markers,
        covariance,
        is_precise: is_precise(&covariance),
        blur_px2: Matrix2::identity(),
        stretch_px2: None,
        evidence: Evidence { log_odds, ..Evidence::default() },
        visible_share: 1.0,
        samples: 900,
        iterations: 5,
    }
}

/// A certain measurement.
pub fn measurement(camera_from_markers: &Isometry3<f64>) -> Measurement {
    let covariance = Matrix6::identity() * 1e-6;
    let pose = PoseEstimate { camera_from_markers: *camera_from_markers, covariance };
    Measurement { pose, measured_by: MeasuredBy::Decoded, markers: 2, is_precise: true }
}

/// A drawing of alpha at `pose`.
pub fn drawing(pose: &Isometry3<f64>) -> Drawing {
    draw(&alpha(), pose, PIXELS_PER_RADIAN, 0.9, 0.004)
}

/// Gives `by` a view that shows alpha at `pose`.
pub fn with_view<T>(pose: &Isometry3<f64>, by: impl FnOnce(&BestView<'_>) -> T) -> T {
    let drawing = drawing(pose);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let (image, view) = (drawing.image(), drawing.view);
    let picture = Picture::still(image, view, &light, PIXELS_PER_RADIAN);
    by(&BestView { picture, view_index: 0, agreeing: 0, rays_m: f64::INFINITY })
}

/// How far a pose is off, metres.
pub fn error_m(found: &Isometry3<f64>, truth: &Isometry3<f64>) -> f64 {
    (found.translation.vector - truth.translation.vector).norm()
}
