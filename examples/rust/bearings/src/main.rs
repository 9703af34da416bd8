//! A fusion in place of Flockeye's own that only says in which direction neighbours are, in Rust.
//!
//!     cargo build --release -p my-bearings
//!     flockeye swap fusion --accept-worse -- target/release/my-bearings
//!
//! A neighbour is reported at one metre along the mean of its markers' rays, with a covariance that says that
//! only the direction is known. It keeps no track: every frame stands for itself. Plans sweep the whole
//! sphere.

mod bearing;

use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;

use flockeye_config::Resolved;
use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, FrameEnd, FrameEnds, FrameOrder, FrameStamp,
    MAX_PLANNED_VIEWS, NONE, PlanHeader, PlannedView, Plans, SearchMode, StopRule, TrackHeader,
    Tracks, ViewKind,
};
use flockeye_runtime::health::{Identity, SharedCounters};
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};
use nalgebra::Vector3;

use crate::bearing::track;

/// Tracks in one message at most.
const MAX_TRACKS: usize = 16;
/// Frames that may be open at once.
const MAX_FRAMES: usize = 16;
/// How often it looks for frames that are overdue.
const POLL_NS: i64 = 50_000_000;

/// What was said of one frame.
struct OpenFrame {
    stamp: FrameStamp,
    begun_ns: i64,
    views_issued: Option<u32>,
    answered: BTreeSet<u32>,
    /// Rays of each neighbour's markers, in the camera frame, by target number.
    rays: BTreeMap<usize, Vec<Vector3<f64>>>,
}

impl OpenFrame {
    fn is_complete(&self) -> bool {
        self.views_issued.is_some_and(|issued| {
            issued as usize <= MAX_PLANNED_VIEWS
                && (0..issued).all(|index| self.answered.contains(&index))
        })
    }
}

/// Collects what is said of each frame, and reports it when all is said.
struct MyBearings {
    identity: Identity,
    counters: SharedCounters,
    resolved: Resolved,
    answers: Subscriber<Detections>,
    frame_ends: Subscriber<FrameEnds>,
    tracks: Publisher<Tracks>,
    plans: Publisher<Plans>,
    frames: BTreeMap<FrameOrder, OpenFrame>,
    /// The newest frame that has ended.
    ended: Option<FrameOrder>,
    plan_id: u64,
    next_tile: usize,
}

impl Stage for MyBearings {
    const NAME: &'static str = "fusion";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        context.counters.set_detail("bearings alone");
        let mut opened = Self {
            identity: context.identity.clone(),
            counters: context.counters.clone(),
            resolved: context.resolved.clone(),
            answers: ports.subscriber()?,
            frame_ends: ports.subscriber()?,
            tracks: ports.publisher()?,
            plans: ports.publisher()?,
            frames: BTreeMap::new(),
            ended: None,
            plan_id: 0,
            next_tile: 0,
        };
        opened.send_plan(None)?;
        Ok(opened)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        // Whoever has joined since gets the last plan: a lossless run begins with it.
        self.plans.update_connections()?;
        while let Some(record) = self.answers.receive()? {
            self.on_record(&record.header, record.items());
        }
        while let Some(end) = self.frame_ends.receive()? {
            self.on_end(&end.header);
        }
        self.end_frames()?;
        self.counters.set_queued(self.frames.len());
        Ok(Step::WaitUntil(clock::monotonic_ns() + POLL_NS))
    }
}

impl MyBearings {
    /// The open frame of a stamp, which it opens; `None` if it has ended, or too many are open.
    fn open_frame(&mut self, stamp: &FrameStamp) -> Option<&mut OpenFrame> {
        let order = stamp.order();
        let is_full = self.frames.len() >= MAX_FRAMES && !self.frames.contains_key(&order);
        if is_full || self.ended.is_some_and(|ended| order <= ended) {
            return None;
        }
        Some(self.frames.entry(order).or_insert_with(|| OpenFrame {
            stamp: *stamp,
            begun_ns: clock::monotonic_ns(),
            views_issued: None,
            answered: BTreeSet::new(),
            rays: BTreeMap::new(),
        }))
    }

    fn on_record(&mut self, header: &DetectionHeader, markers: &[DetectedMarker]) {
        let decoded = markers.iter().filter(|marker| marker.doubtful == 0);
        let owned: Vec<_> = decoded
            .filter_map(|marker| Some((self.resolved.bodies.owner(marker.id)?, marker)))
            .collect();
        let index = header.view_index;
        let Some(frame) = self.open_frame(&header.stamp) else { return };
        // Of two records of one view the first counts.
        if index as usize >= MAX_PLANNED_VIEWS || !frame.answered.insert(index) {
            return;
        }
        for (target, marker) in owned {
            let rays = marker.rays_in_camera.map(Vector3::from);
            frame.rays.entry(target).or_default().extend(rays);
        }
    }

    fn on_end(&mut self, end: &FrameEnd) {
        if let Some(frame) = self.open_frame(&end.stamp) {
            frame.views_issued = Some(end.views_issued);
        }
    }

    /// Ends what is complete or overdue, and what is older: it was under way when this process began, or its
    /// worker died.
    fn end_frames(&mut self) -> anyhow::Result<()> {
        let deadline_ns = self.resolved.pipeline.frame_deadline().as_nanos() as i64;
        let overdue_ns = clock::monotonic_ns() - deadline_ns;
        let is_over = |frame: &OpenFrame| frame.is_complete() || frame.begun_ns < overdue_ns;
        let newest = self.frames.iter().rfind(|(_, frame)| is_over(frame)).map(|(order, _)| *order);
        while let Some(first) = self.frames.first_entry()
            && newest.is_some_and(|newest| *first.key() <= newest)
        {
            let (order, frame) = first.remove_entry();
            self.ended = Some(order);
            self.report(&frame)?;
            self.send_plan(Some(frame.stamp))?;
        }
        Ok(())
    }

    fn report(&self, frame: &OpenFrame) -> anyhow::Result<()> {
        let seen = frame.rays.iter().take(MAX_TRACKS);
        let tracks: Vec<_> = seen
            .filter_map(|(target, rays)| {
                let name = &self.resolved.bodies.get(*target)?.name;
                Some(track(*target as u32, name, &self.resolved.observer_from_camera, rays))
            })
            .collect();
        let generation = self.identity.generation;
        let header = TrackHeader { stamp: frame.stamp, generation, is_last: 1 };
        Ok(self.tracks.send(header, &tracks)?)
    }

    /// Where to look next: the tiles in turn.
    fn send_plan(&mut self, after: Option<FrameStamp>) -> anyhow::Result<()> {
        let tiles = self.resolved.partition_views.iter().zip(0..);
        let planned = tiles.map(|(view, tile)| PlannedView {
            camera_from_view: view.camera_from_view.coords.into(),
            focal_px: view.focal_px,
            size_px: view.size_px,
            kind: ViewKind::Partition.code(),
            tile,
            target: NONE,
            ..PlannedView::default()
        });
        let mut views: Vec<_> = planned.collect();
        let budget = self.resolved.pipeline.search.lossless_partitions.min(views.len() as u32);
        views.rotate_left(self.next_tile);
        self.next_tile = (self.next_tile + budget as usize) % views.len().max(1);
        self.plan_id += 1;
        let header = PlanHeader {
            after: after.unwrap_or_default(),
            plan_id: self.plan_id,
            made_ns: clock::monotonic_ns(),
            has_after: after.is_some().into(),
            generation: self.identity.generation,
            stop_rule: StopRule::Deadline.code(),
            mode: SearchMode::Gaze.code(),
            view_budget: budget,
            ..PlanHeader::default()
        };
        Ok(self.plans.send(header, &views)?)
    }
}

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<MyBearings>()
}
