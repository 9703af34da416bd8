//! What tests of fusion share: bodies, poses, records, and trackers that have seen them.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs, reason = "of the drawings")]

use std::collections::BTreeMap;
use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use flockeye_geometry::body::{Bodies, Body};
use flockeye_geometry::filter::{MotionModel, TrackPolicy};
use flockeye_geometry::partition::Partition;
use flockeye_geometry::search::{Plan, Planner, Purpose, RoiOptions, SearchMode};
use flockeye_imaging::align::Picture;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::Isometry3;

use crate::aligner::{Aligner, BestView};
use crate::drawn_body::prints;
use crate::frame::parts::Parts;
use crate::measure::{AnsweredView, BestViews};
use crate::measurement::{MeasuredBy, Measurement, PoseEstimate};
use crate::planning::Planning;
use crate::policy::TimeBudget;
use crate::record::Record;
use crate::target::Update;
use crate::tracker::{FilterChoice, FrameTime, Tracker};

pub use self::scene::*;

#[path = "../tests/scene/mod.rs"]
mod scene;

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
    let roi = RoiOptions::new(PIXELS_PER_RADIAN);
    Planner::new(SearchMode::Roi, partition, views, roi).unwrap()
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
        tracker.take_in(time, target, parts.get_mut(target), *measurement).0
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

pub fn time(sequence: u64) -> FrameTime {
    FrameTime { order: stamp(sequence).order(), at_s: at_s(sequence), number: sequence }
}

/// A record of alpha's region of interest.
pub fn of_region(record: &Record) -> AnsweredView<'_> {
    AnsweredView { record, purpose: Some(Purpose::Roi(0)), view: None }
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
