//! All neighbours, and the plan for the next frame.

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::{DetectedMarker, ViewHeader};
use flockeye_geometry::body::Bodies;
use flockeye_geometry::filter::{Prediction, TrackPolicy};
use flockeye_geometry::search::{Plan, Planner, PredictedNeighbour, Purpose, Searched, StopRule};

use crate::assembly::{Frame, Record};
use crate::neighbour::{Known, Neighbour};
use crate::parallax::Parallax;
use crate::sighting::{MARKERS_ALONE, rays_of, sight};

/// How poses are carried from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FilterChoice {
    /// A track for each neighbour.
    Tracks(TrackPolicy),
    /// Each frame for itself.
    None,
}

/// A body's number, and what is known of it after a frame.
pub type Update = (usize, Known);

/// What a view of a frame was cut for, by its place in the plan.
pub type Purposes = BTreeMap<u32, Purpose>;

/// All neighbours, and what was searched.
pub struct Swarm {
    neighbours: Vec<Neighbour>,
    filter: FilterChoice,
    planner: Planner,
    parallax: Option<Parallax>,
    searched: Searched,
    frames: u64,
    /// Neighbours of the oldest open frame whose pose is out already.
    settled: BTreeSet<usize>,
    last_s: Option<f64>,
    interval_s: f64,
}

/// The longest time between two frames that is believed in when planning for the next, seconds.
const LONGEST_INTERVAL_S: f64 = 0.25;

impl Swarm {
    /// Nobody seen yet.
    pub fn new(bodies: &Bodies, filter: FilterChoice, planner: Planner) -> Self {
        let policy = match filter {
            FilterChoice::Tracks(policy) => policy,
            FilterChoice::None => TrackPolicy::default(),
        };
        let searched = Searched::new(planner.partition().len());
        Self {
            neighbours: bodies.iter().map(|body| Neighbour::new(body.clone(), policy)).collect(),
            filter,
            planner,
            parallax: None,
            searched,
            frames: 0,
            settled: BTreeSet::new(),
            last_s: None,
            interval_s: 1.0 / 30.0,
        }
    }

    /// Brings rays and poses to their distances, for a camera with lenses beside its middle.
    pub fn with_parallax(self, parallax: Option<Parallax>) -> Self {
        Self { parallax, ..self }
    }

    /// The bodies' names and geometry.
    pub fn neighbours(&self) -> &[Neighbour] {
        &self.neighbours
    }

    /// What a gaze view's record says of its neighbour, as soon as it is in: a pose need not wait
    /// for the partitions. Called for records of the oldest open frame, with the view if it was
    /// seen passing.
    pub fn glance(
        &mut self,
        at_s: f64,
        purpose: Option<Purpose>,
        record: &Record,
        view: Option<&ViewHeader>,
    ) -> Option<Update> {
        let Some(Purpose::Gaze(target)) = purpose else { return None };
        if self.parallax.is_some() && view.is_none() {
            // What its rays are right for is not known yet: `finish` knows.
            return None;
        }
        let known = self.settle(at_s, target, &[(record, view)], MARKERS_ALONE)?;
        Some((target, known))
    }

    /// Everything that is left to say of a frame: its remaining neighbours, and those that it does
    /// not show.
    pub fn finish(
        &mut self,
        at_s: f64,
        frame: &Frame,
        purposes: &Purposes,
        stop_rule: StopRule,
    ) -> Vec<Update> {
        let counted = records_that_count(frame, stop_rule);
        let mut updates = Vec::new();
        // The same order as if each gaze record had come in time for `glance`: what a frame says
        // must not depend on when its parts came.
        for record in &counted {
            let purpose = purposes.get(&record.header.view_index).copied();
            let view = frame.views.get(&record.header.view_index);
            updates.extend(self.glance(at_s, purpose, record, view));
        }
        let viewed: Vec<(&Record, Option<&ViewHeader>)> = counted
            .iter()
            .map(|record| (*record, frame.views.get(&record.header.view_index)))
            .collect();
        for target in 0..self.neighbours.len() {
            if self.settled.contains(&target) {
                continue;
            }
            match self.settle(at_s, target, &viewed, 1) {
                Some(known) => updates.push((target, known)),
                None => {
                    let decoded = counted.iter().flat_map(|record| &record.markers);
                    let decoded = distinct_ids(decoded, &self.neighbours[target]);
                    let known = match self.filter {
                        FilterChoice::Tracks(_) => self.neighbours[target].unseen(at_s, decoded),
                        FilterChoice::None => None,
                    };
                    updates.extend(known.map(|known| (target, known)));
                }
            }
        }
        self.remember(at_s, frame, &counted, purposes);
        updates
    }

    /// Solves for a neighbour from some of a frame's records, each with its view as far as that was
    /// seen passing, if they are enough, and takes it in.
    fn settle(
        &mut self,
        at_s: f64,
        target: usize,
        viewed: &[(&Record, Option<&ViewHeader>)],
        needed: usize,
    ) -> Option<Known> {
        if self.settled.contains(&target) {
            return None;
        }
        let neighbour = self.neighbours.get_mut(target)?;
        let prior = match self.filter {
            FilterChoice::Tracks(_) => neighbour.prior(at_s),
            FilterChoice::None => None,
        };
        // All rays are brought to the distance that is known best before the pose is.
        let rays_m = self.parallax.as_ref().map(|parallax| {
            let predicted = prior.as_ref().map(|prior| &prior.camera_from_markers.translation);
            predicted.map_or(parallax.assumed_m(), |position| position.vector.norm())
        });
        let mut rays = Vec::new();
        for (record, view) in viewed {
            let first = rays.len();
            rays.extend(rays_of(&neighbour.body, &record.markers));
            if let (Some(parallax), Some(rays_m)) = (&self.parallax, rays_m) {
                let from_m = parallax.distance_m(*view);
                for ray in &mut rays[first..] {
                    ray.ray_in_camera = parallax.brought(&ray.ray_in_camera, from_m, rays_m);
                }
            }
        }
        if rays.is_empty() {
            return None;
        }
        let mut sighting = sight(&neighbour.body, &rays, prior.as_ref())?;
        if let (Some(parallax), Some(rays_m)) = (&self.parallax, rays_m) {
            sighting.pose = parallax.corrected(&sighting.pose, rays_m);
        }
        if sighting.solution.inlier_markers.len() < needed {
            return None;
        }
        let known = match self.filter {
            FilterChoice::Tracks(_) => neighbour.seen(at_s, &sighting)?,
            FilterChoice::None => Known::of_frame(&sighting),
        };
        self.settled.insert(target);
        Some(known)
    }

    /// Notes what was searched and hit, and starts afresh for the next frame.
    fn remember(&mut self, at_s: f64, frame: &Frame, counted: &[&Record], purposes: &Purposes) {
        for index in frame.records.keys() {
            if let Some(&purpose) = purposes.get(index) {
                self.searched.record(self.frames, purpose);
            }
        }
        let first_hit = counted.iter().find(|record| record.header.hits > 0);
        if let Some(&purpose) = first_hit.and_then(|record| purposes.get(&record.header.view_index))
        {
            self.searched.hit(purpose);
        }
        if let Some(interval_s) = self.last_s.map(|last_s| at_s - last_s)
            && (0.0..LONGEST_INTERVAL_S).contains(&interval_s)
        {
            self.interval_s = interval_s;
        }
        self.last_s = Some(at_s);
        self.frames += 1;
        self.settled.clear();
    }

    /// Where to look in the next frame, and each gaze view's prediction.
    pub fn plan(&self) -> (Plan, BTreeMap<usize, Prediction>) {
        let next_s = self.last_s.map_or(0.0, |last_s| last_s + self.interval_s);
        let predictions: BTreeMap<usize, Prediction> = match self.filter {
            FilterChoice::None => BTreeMap::new(),
            FilterChoice::Tracks(_) => self
                .neighbours
                .iter()
                .enumerate()
                .filter_map(|(target, neighbour)| Some((target, neighbour.predict(next_s)?)))
                .collect(),
        };
        let predicted: Vec<PredictedNeighbour> = predictions
            .iter()
            .filter_map(|(&target, prediction)| {
                PredictedNeighbour::from_pose(
                    target,
                    &self.neighbours[target].body,
                    &prediction.observer_from_target,
                    &prediction.pose_covariance().fixed_view::<3, 3>(0, 0).into_owned(),
                    &prediction.velocity,
                )
            })
            .collect();
        (self.planner.plan(&self.searched, &predicted), predictions)
    }
}

/// A frame's records in plan order; with the rule `first_hit` those up to the first hit, because
/// what several workers searched beyond it depends on time.
fn records_that_count(frame: &Frame, stop_rule: StopRule) -> Vec<&Record> {
    let mut counted = Vec::new();
    for record in frame.records.values() {
        counted.push(record);
        if stop_rule == StopRule::FirstHit && record.header.hits > 0 {
            break;
        }
    }
    counted
}

fn distinct_ids<'m>(
    markers: impl Iterator<Item = &'m DetectedMarker>,
    neighbour: &Neighbour,
) -> u32 {
    let decoded = markers.filter(|marker| marker.is_decoded());
    let ids: BTreeSet<u32> = decoded.map(|marker| marker.id).collect();
    ids.iter().filter(|&&id| neighbour.body.marker(id).is_some()).count() as u32
}
