//! All neighbours, and the plan for the next frame.

mod looks;
mod peeks;
mod records;
mod trust;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::Arc;

use flockeye_contract::ViewHeader;
use flockeye_geometry::body::Bodies;
use flockeye_geometry::filter::{Prediction, TrackPolicy};
use flockeye_geometry::search::{
    Plan, Planner, PredictedNeighbour, Purpose, Search, Searched, StopRule,
};
use nalgebra::Isometry3;

use crate::alignment::{Aligner, BestView, Pace};
use crate::assembly::{Frame, Record};
use crate::gallery::{FrameOrder, Rank};
use crate::neighbour::{Known, Neighbour};
use crate::parallax::Parallax;
use crate::second_look::SecondLooks;
use crate::sighting::{Basis, MARKERS_ALONE, Peek};
pub use peeks::Glimpse;
use records::{distinct_ids, records_that_count};
use trust::Trust;

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

/// The best view of each neighbour in a frame, by its number.
pub type BestViews<'p> = BTreeMap<usize, BestView<'p>>;

/// A record with what its view was cut for and, if it was seen passing, the view.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'s> {
    /// What was found.
    pub record: &'s Record,
    /// What for.
    pub purpose: Option<Purpose>,
    /// The view.
    pub view: Option<&'s ViewHeader>,
}

/// All neighbours, and what was searched.
pub struct Swarm {
    neighbours: Vec<Neighbour>,
    filter: FilterChoice,
    planner: Planner,
    parallax: Option<Parallax>,
    searched: Searched,
    frames: u64,
    aligner: Arc<Aligner>,
    threads: usize,
    second_looks: Option<SecondLooks>,
    trust: Trust,
    /// What was looked at of the open frames.
    looked: BTreeMap<FrameOrder, Looked>,
    /// The last frame that has ended.
    ended: Option<FrameOrder>,
    last_s: Option<f64>,
    interval_s: f64,
    pace: Pace,
}

/// What was looked at of an open frame.
#[derive(Debug, Clone, Default)]
struct Looked {
    /// Neighbours whose pose is out already.
    settled: BTreeSet<usize>,
    /// Those whose gaze view was looked at already.
    glanced: BTreeSet<usize>,
    /// Those whose pose came before their gaze view was searched, with the pose.
    peeked: BTreeMap<usize, Isometry3<f64>>,
    /// What peeks at others led to, which was not beyond doubt.
    peeks: BTreeMap<usize, Peek>,
    /// What looks for neighbours last began from that led to nothing.
    fruitless: BTreeMap<usize, Basis>,
    /// The same of second looks, whatever they lead to.
    seconds: BTreeMap<usize, Basis>,
}

/// A neighbour that is lost from sight is searched for round its prediction in every so manyth frame.
const SEARCH_EVERY_FRAMES: u64 = 3;

/// The longest time between two frames that is believed in when planning for the next, seconds.
const LONGEST_INTERVAL_S: f64 = 0.25;

impl Swarm {
    /// Nobody seen yet. Neighbours of a frame are aligned on `threads` threads.
    pub fn new(
        bodies: &Bodies,
        filter: FilterChoice,
        planner: Planner,
        aligner: Aligner,
        threads: usize,
    ) -> Self {
        let policy = match filter {
            FilterChoice::Tracks(policy) => policy,
            FilterChoice::None => TrackPolicy::default(),
        };
        let searched = planner.nothing_searched();
        Self {
            neighbours: bodies.iter().map(|body| Neighbour::new(body.clone(), policy)).collect(),
            filter,
            planner,
            parallax: None,
            searched,
            frames: 0,
            aligner: Arc::new(aligner),
            threads,
            second_looks: None,
            trust: Trust::default(),
            looked: BTreeMap::new(),
            ended: None,
            last_s: None,
            interval_s: 1.0 / 30.0,
            pace: Pace::default(),
        }
    }

    /// Brings rays and poses to their distances, for a camera with lenses beside its middle.
    pub fn with_parallax(self, parallax: Option<Parallax>) -> Self {
        Self { parallax, ..self }
    }

    /// Leaves to a thread of its own what takes several times as long as a look usually does.
    ///
    /// # Errors
    /// The system starts no thread.
    pub fn with_second_looks(mut self) -> io::Result<Self> {
        self.second_looks = Some(SecondLooks::start(Arc::clone(&self.aligner))?);
        Ok(self)
    }

    /// The bodies' names and geometry.
    pub fn neighbours(&self) -> &[Neighbour] {
        &self.neighbours
    }

    /// How many threads neighbours are aligned on.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// The sphere image's resolution.
    pub fn pixels_per_radian(&self) -> f64 {
        self.aligner.pixels_per_radian()
    }

    /// The distance that a view's rays are right for, metres; infinite where it does not matter.
    pub fn rays_m(&self, view: &ViewHeader) -> f64 {
        let parallax = self.parallax.as_ref();
        parallax.map_or(f64::INFINITY, |parallax| parallax.distance_m(Some(view)))
    }

    /// The neighbours that a view was cut for, or shows markers of, and how well it shows them. Nobody
    /// needs a view of who is measured already.
    pub fn shown(
        &self,
        record: &Record,
        purpose: Option<Purpose>,
        view: Option<&ViewHeader>,
        stop_rule: StopRule,
    ) -> Vec<(usize, Rank)> {
        let Some(view) = view else { return Vec::new() };
        self.unsettled(record.header.stamp.order())
            .filter_map(|target| {
                let is_own = purpose == Some(Purpose::Gaze(target));
                let body = &self.neighbours[target].body;
                Some((target, Rank::of(record, view, body, is_own, stop_rule)?))
            })
            .collect()
    }

    /// What gaze views' records of a frame say of their neighbours, as soon as they are in: a pose need
    /// wait neither for the frame's partitions nor for those of the frame before. Frames may come in any
    /// order; the tracks put each where it belongs.
    pub fn glance(
        &mut self,
        order: FrameOrder,
        at_s: f64,
        seen: &[Seen<'_>],
        best_views: &BestViews<'_>,
    ) -> Vec<Update> {
        self.check_peeked(order, seen);
        let mut looks: Vec<(usize, Vec<Seen<'_>>)> = Vec::new();
        for record in seen {
            let Some(Purpose::Gaze(target)) = record.purpose else { continue };
            // What a record's rays are right for is not known without its view: `finish` knows.
            let is_known = self.parallax.is_none() || record.view.is_some();
            let looked = self.looked.entry(order).or_default();
            if is_known && !looked.settled.contains(&target) && looked.glanced.insert(target) {
                looks.push((target, vec![*record]));
            }
        }
        self.settle(order, at_s, &looks, best_views, MARKERS_ALONE)
    }

    /// Everything that is left to say of a frame: its remaining neighbours, and those that it does
    /// not show.
    pub fn finish(
        &mut self,
        at_s: f64,
        frame: &Frame,
        purposes: &Purposes,
        stop_rule: StopRule,
        best_views: &BestViews<'_>,
    ) -> Vec<Update> {
        let counted = records_that_count(frame, stop_rule);
        let best_views: BestViews<'_> = best_views
            .iter()
            .filter(|(_, best)| {
                counted.iter().any(|record| record.header.view_index == best.view_index)
            })
            .map(|(target, best)| (*target, *best))
            .collect();
        let seen: Vec<Seen<'_>> = counted
            .iter()
            .map(|record| Seen {
                record,
                purpose: purposes.get(&record.header.view_index).copied(),
                view: frame.views.get(&record.header.view_index),
            })
            .collect();
        // The same order as if each gaze record had come in time for `glance`: what a frame says
        // must not depend on when its parts came.
        let order = frame.stamp.order();
        let mut updates = self.glance(order, at_s, &seen, &best_views);
        let looks: Vec<(usize, Vec<Seen<'_>>)> =
            self.unsettled(order).map(|target| (target, seen.clone())).collect();
        updates.extend(self.settle(order, at_s, &looks, &best_views, 1));
        let unsettled: Vec<usize> = self.unsettled(order).collect();
        for target in unsettled {
            let decoded = counted.iter().flat_map(|record| &record.markers);
            let decoded = distinct_ids(decoded, &self.neighbours[target]);
            let known = match self.filter {
                FilterChoice::Tracks(_) => self.neighbours[target].unseen(at_s, decoded),
                FilterChoice::None => None,
            };
            updates.extend(known.map(|known| (target, known)));
        }
        self.remember(at_s, frame, &counted, purposes);
        updates
    }

    /// Whether a neighbour's pose in a frame is out already.
    fn is_settled(&self, order: FrameOrder, target: usize) -> bool {
        self.looked.get(&order).is_some_and(|looked| looked.settled.contains(&target))
    }

    /// Neighbours whose pose in a frame is not out yet.
    fn unsettled(&self, order: FrameOrder) -> impl Iterator<Item = usize> {
        (0..self.neighbours.len()).filter(move |target| !self.is_settled(order, *target))
    }

    /// How much time there is from now on. Where newer frames wait, each neighbour gets one look of each
    /// kind, and only newcomers a second one: poses that come a second late are of use to nobody.
    pub fn hurry(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// A view was cut: it will be searched, and so need not be asked for in a plan that is made meanwhile.
    pub fn note_cut(&mut self, purpose: Purpose, search: Search) {
        self.searched.record(self.frames, purpose);
        self.searched.record_window(purpose, search);
    }

    /// Notes what was searched and hit, and starts afresh for the next frame.
    fn remember(&mut self, at_s: f64, frame: &Frame, counted: &[&Record], purposes: &Purposes) {
        // Views that came were noted then.
        for index in frame.records.keys().filter(|index| !frame.views.contains_key(index)) {
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
        let looked = self.looked.get(&frame.stamp.order());
        let peeked = looked.map(|looked| looked.peeked.keys().copied().collect());
        self.trust.end_frame(&peeked.unwrap_or_default());
        // Frames end in order.
        self.ended = Some(frame.stamp.order());
        self.looked.retain(|order, _| *order > frame.stamp.order());
    }

    /// Whether a neighbour's gaze view in the next frame need not be searched for markers: its pixels
    /// alone told its pose in the last ones.
    pub fn needs_no_markers(&self, target: usize) -> bool {
        self.trust.needs_no_markers(target)
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

#[cfg(test)]
mod tests;
