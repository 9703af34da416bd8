//! Poses of all drones from here, estimated from sightings as they come.

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::SwarmWay;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{MotionModel, Prediction};
use nalgebra::{Matrix6, Vector3, Vector6};

use super::graph::{Edge, solve};
use super::honesty::contradicting;
use super::replay::{Replay, TimedPose};
use super::uncertain_pose::UncertainPose;

/// Maximum drones, this one included.
pub(crate) const MOST_DRONES: usize = 64;
/// A pair that nobody has measured for this long is forgotten, seconds.
const FORGOTTEN_S: f64 = 1.0;
/// Deviation of a velocity in a report that has no measurements, m/s and rad/s: how far the pose may have gone
/// since its exposure beyond what it says.
const REPORTED_VELOCITY_DEVIATION: f64 = 0.5;
/// An observer that contradicts the others for so long is left out, seconds.
const LEFT_OUT_AFTER_S: f64 = 0.5;
/// It comes back after so many times as long without contradiction.
const FORGIVENESS: f64 = 10.0;
/// A check stands for no longer than this, seconds: after a pause one check alone leaves nobody out.
const LONGEST_CHECK_S: f64 = 0.25;
/// What calibrations of mounts and lenses leave, m and rad. When sightings are compared, it is added to their
/// deviations, so that it is not taken for a lie.
const CALIBRATION: (f64, f64) = (0.02, 0.02);

/// How drones move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SwarmModel {
    /// Motion as this drone sees it, whose own rotation is known.
    pub own: MotionModel,
    /// Motion as others see it, whose rotation is not known: what stands still seems to move when they turn.
    pub others: MotionModel,
}

impl Default for SwarmModel {
    /// For others 3 m/s^2 per root Hz. A drone that rolls by 12 degrees at 0.7 Hz sees a neighbour 1.5 m away
    /// accelerate by up to 6 m/s^2. Over a frame of 33 ms that is as much.
    fn default() -> Self {
        let own = MotionModel::default();
        Self { own, others: MotionModel { acceleration: 3.0, ..own } }
    }
}

/// One observer's sighting of one target at one exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation<'n> {
    /// The drone that sees.
    pub observer: &'n str,
    /// The drone that is seen.
    pub target: &'n str,
    /// The exposure on this machine's clock, seconds.
    pub at_s: f64,
    /// Its standard deviation, seconds: what is not known of the observer's clock.
    pub deviation_s: f64,
    /// The filtered pose, observer from target.
    pub filtered: UncertainPose,
    /// Velocity relative to the observer, along its axes, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity, the same, rad/s.
    pub rate: Vector3<f64>,
    /// This frame's own measurement, where the report has one.
    pub measured: Option<UncertainPose>,
}

/// Where a drone is from here.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// The drone's name.
    pub name: String,
    /// Its pose in this drone's frame, and how certain it is.
    pub own_from_drone: UncertainPose,
    /// How it is known.
    pub way: SwarmWay,
    /// The drone before it on the best chain, where it is chained.
    pub through: Option<String>,
    /// The newest exposure of the pairs that it rests on, seconds.
    pub seen_s: f64,
    /// Pairs of drones in the whole graph.
    pub pairs: usize,
}

/// One direction: what one drone sees of another.
#[derive(Debug, Clone)]
struct Direction {
    /// Filter of the measurements, where the reports have them.
    replay: Replay,
    /// The last report without a measurement.
    reported: Option<Reported>,
}

#[derive(Debug, Clone, Copy)]
struct Reported {
    at_s: f64,
    pose: UncertainPose,
    course: Vector6<f64>,
}

impl Direction {
    fn newest_s(&self) -> Option<f64> {
        later(self.replay.newest_s(), self.reported.map(|reported| reported.at_s))
    }
}

/// The later of two times that may be unknown.
fn later(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    [one, other].into_iter().flatten().reduce(f64::max)
}

/// How far a pose goes in each second.
fn course(velocity: &Vector3<f64>, rate: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(velocity.x, velocity.y, velocity.z, rate.x, rate.y, rate.z)
}

/// What each direction says alone, by observer and target.
type Directed = BTreeMap<(usize, usize), UncertainPose>;

/// Estimates the poses of all drones from here.
#[derive(Debug, Clone)]
pub struct SwarmEstimator {
    model: SwarmModel,
    /// Names by number; oneself is 0. A number whose drone is forgotten is given to the next.
    names: Vec<Option<String>>,
    /// By observer and target.
    directions: BTreeMap<(usize, usize), Direction>,
    /// Both directions in one filter, by the lower and the higher number, in the frame of the lower one.
    pairs: BTreeMap<(usize, usize), Replay>,
    doubts: BTreeMap<usize, Doubt>,
    judged_s: Option<f64>,
    /// The rotation of observers whose own is not known: none.
    unknown: EgoRotation,
}

#[derive(Debug, Clone, Copy, Default)]
struct Doubt {
    /// For how long it has contradicted the others, less what is forgiven, seconds.
    contradicted_s: f64,
    is_left_out: bool,
}

impl SwarmEstimator {
    /// From the drone `own`. Nothing is seen yet.
    pub fn new(own: &str, model: SwarmModel) -> Self {
        Self {
            model,
            names: vec![Some(own.to_owned())],
            directions: BTreeMap::new(),
            pairs: BTreeMap::new(),
            doubts: BTreeMap::new(),
            judged_s: None,
            unknown: EgoRotation::new(1.0),
        }
    }

    /// Takes in a sighting. `ego` is how this drone turns. One of a drone beyond [`MOST_DRONES`], or with
    /// numbers that are none, is left out.
    pub fn see(&mut self, seen: &Observation<'_>, ego: &EgoRotation) {
        if !seen.filtered.is_usable() || !seen.at_s.is_finite() || seen.observer == seen.target {
            return;
        }
        let (Some(observer), Some(target)) = (self.number(seen.observer), self.number(seen.target))
        else {
            return;
        };
        let motion = self.motion(observer);
        let direction = self
            .directions
            .entry((observer, target))
            .or_insert_with(|| Direction { replay: Replay::new(motion), reported: None });
        let Some(measured) = seen.measured.filter(UncertainPose::is_usable) else {
            direction.reported = Some(Reported {
                at_s: seen.at_s,
                pose: seen.filtered,
                course: course(&seen.velocity, &seen.rate),
            });
            return;
        };
        // What is not known of the time is not known of the place, along the motion.
        let shift = course(&seen.velocity, &seen.rate) * seen.deviation_s;
        let covariance = measured.covariance + shift * shift.transpose();
        let pose = UncertainPose { covariance, ..measured };
        let rotation = |observer| if observer == 0 { ego } else { &self.unknown };
        direction.replay.add(TimedPose { at_s: seen.at_s, pose }, rotation(observer));
        if self.doubts.get(&observer).is_some_and(|doubt| doubt.is_left_out) {
            return;
        }
        let pair = (observer.min(target), observer.max(target));
        let pose = if observer < target { pose } else { pose.inverse() };
        let motion = if pair.0 == 0 { self.model.own } else { self.model.others };
        let replay = self.pairs.entry(pair).or_insert_with(|| Replay::new(motion));
        replay.add(TimedPose { at_s: seen.at_s, pose }, rotation(pair.0));
    }

    /// A track of this drone, or of a peer, is lost: what was seen of it counts no more.
    pub fn lose(&mut self, observer: &str, target: &str) {
        if let (Some(observer), Some(target)) = (self.known(observer), self.known(target)) {
            self.directions.remove(&(observer, target));
            if !self.directions.contains_key(&(target, observer)) {
                self.pairs.remove(&(observer.min(target), observer.max(target)));
            }
        }
    }

    /// Where all drones are at `at_s`, seconds on this machine's clock.
    pub fn places(&mut self, at_s: f64, ego: &EgoRotation) -> Vec<Place> {
        self.forget(at_s);
        let directed = self.directed(at_s, ego);
        self.judge(at_s, &directed);
        let pairs: BTreeSet<(usize, usize)> =
            self.directions.keys().map(|&(a, b)| (a.min(b), a.max(b))).collect();
        let mut edges = Vec::new();
        let mut newest_s = BTreeMap::new();
        for pair in pairs {
            if let Some((edge, seen_s)) = self.edge(pair, at_s, ego, &directed) {
                newest_s.insert(pair, seen_s);
                edges.push(edge);
            }
        }
        let solution = solve(self.names.len(), &edges);
        let places = solution.nodes.iter().enumerate().filter_map(|(drone, node)| {
            let node = (*node)?;
            let seen_s = newest_s.get(&(drone.min(node.through), drone.max(node.through)))?;
            let way = self.way(drone);
            Some(Place {
                name: self.names[drone].clone()?,
                own_from_drone: node.pose,
                way,
                through: self.names[node.through].clone().filter(|_| way == SwarmWay::Chained),
                seen_s: *seen_s,
                pairs: edges.len(),
            })
        });
        places.collect()
    }

    /// The observers whose sightings contradict the others', and are left out.
    pub fn left_out(&self) -> impl Iterator<Item = &str> {
        let left_out = self.doubts.iter().filter(|(_, doubt)| doubt.is_left_out);
        left_out.filter_map(|(&observer, _)| self.names[observer].as_deref())
    }

    /// The number of a drone.
    fn known(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known.as_deref() == Some(name))
    }

    /// The number of a drone, given where there is room.
    fn number(&mut self, name: &str) -> Option<usize> {
        if let Some(number) = self.known(name) {
            return Some(number);
        }
        if let Some(free) = self.names.iter().position(Option::is_none) {
            self.names[free] = Some(name.to_owned());
            return Some(free);
        }
        if self.names.len() == MOST_DRONES {
            return None;
        }
        self.names.push(Some(name.to_owned()));
        Some(self.names.len() - 1)
    }

    fn motion(&self, observer: usize) -> MotionModel {
        if observer == 0 { self.model.own } else { self.model.others }
    }

    fn is_left_out(&self, observer: usize) -> bool {
        self.doubts.get(&observer).is_some_and(|doubt| doubt.is_left_out)
    }

    /// Forgets what nobody has seen for long.
    fn forget(&mut self, at_s: f64) {
        let is_old = |newest_s: Option<f64>| newest_s.is_none_or(|s| s < at_s - FORGOTTEN_S);
        self.directions.retain(|_, direction| !is_old(direction.newest_s()));
        self.pairs.retain(|_, replay| !is_old(replay.newest_s()));
        let seen: BTreeSet<usize> = self.directions.keys().flat_map(|&(a, b)| [a, b]).collect();
        for (number, name) in self.names.iter_mut().enumerate().skip(1) {
            // Whoever is in doubt is remembered, or a pause would be an excuse.
            if !seen.contains(&number) && !self.doubts.contains_key(&number) {
                *name = None;
            }
        }
    }

    /// How a drone is known.
    fn way(&self, drone: usize) -> SwarmWay {
        let counts = |observer, target| {
            self.directions.contains_key(&(observer, target)) && !self.is_left_out(observer)
        };
        match (counts(0, drone), counts(drone, 0)) {
            (true, true) => SwarmWay::Mutual,
            (true, false) => SwarmWay::Direct,
            (false, true) => SwarmWay::Reported,
            (false, false) => SwarmWay::Chained,
        }
    }

    /// What is known of a pair, in the frame of the lower number, and when it was seen last.
    fn edge(
        &self,
        (from, to): (usize, usize),
        at_s: f64,
        ego: &EgoRotation,
        directed: &Directed,
    ) -> Option<(Edge, f64)> {
        let counting = |observer: usize, target: usize| {
            self.directions.get(&(observer, target)).filter(|_| !self.is_left_out(observer))
        };
        let (forth, back) = (counting(from, to), counting(to, from));
        let newest_s = |direction: Option<&Direction>| direction.and_then(Direction::newest_s);
        let seen_s = later(newest_s(forth), newest_s(back))?;
        let is_measured = |direction: Option<&Direction>| {
            direction.is_some_and(|direction| direction.replay.newest_s().is_some())
        };
        // Both measure: one filter has it all, unless it has just begun anew.
        let filtered = (is_measured(forth) && is_measured(back))
            .then(|| self.pairs.get(&(from, to))?.at(at_s, self.rotation(from, ego)))
            .flatten();
        let from_to = match filtered {
            Some(prediction) => pose_of(&prediction),
            None => {
                let said = |direction: Option<&Direction>, key| {
                    direction.and_then(|_| directed.get(&key)).copied()
                };
                let back = said(back, (to, from)).map(|back| back.inverse());
                match (said(forth, (from, to)), back) {
                    (Some(forth), Some(back)) => forth.intersection(&back)?,
                    (forth, back) => forth.or(back)?,
                }
            }
        };
        Some((Edge { from, to, from_to }, seen_s))
    }

    /// What each direction says alone at `at_s`.
    fn directed(&self, at_s: f64, ego: &EgoRotation) -> Directed {
        let said = self.directions.iter().filter_map(|(&key, direction)| {
            if direction.replay.newest_s().is_some() {
                let prediction = direction.replay.at(at_s, self.rotation(key.0, ego))?;
                return Some((key, pose_of(&prediction)));
            }
            let reported = direction.reported?;
            let step_s = at_s - reported.at_s;
            let mut moved = reported.pose.moved(&(reported.course * step_s));
            moved.covariance +=
                Matrix6::identity() * (REPORTED_VELOCITY_DEVIATION * step_s).powi(2);
            Some((key, moved))
        });
        said.collect()
    }

    /// How an observer turns: this drone's own rotation is known.
    fn rotation<'e>(&'e self, observer: usize, ego: &'e EgoRotation) -> &'e EgoRotation {
        if observer == 0 { ego } else { &self.unknown }
    }

    /// Finds out whose sightings contradict the others'.
    fn judge(&mut self, at_s: f64, directed: &Directed) {
        let edges: Vec<Edge> = directed
            .iter()
            .map(|(&(from, to), &said)| {
                let mut from_to = said;
                for axis in 0..3 {
                    from_to.covariance[(axis, axis)] += CALIBRATION.0.powi(2);
                    from_to.covariance[(axis + 3, axis + 3)] += CALIBRATION.1.powi(2);
                }
                Edge { from, to, from_to }
            })
            .collect();
        let since_s = self.judged_s.map_or(0.0, |judged_s| at_s - judged_s);
        let since_s = since_s.clamp(0.0, LONGEST_CHECK_S);
        self.judged_s = Some(at_s);
        let wrong = contradicting(self.names.len(), &edges);
        for &observer in &wrong {
            self.doubts.entry(observer).or_default();
        }
        let mut changed = Vec::new();
        for (&observer, doubt) in &mut self.doubts {
            let step_s = if wrong.contains(&observer) { since_s } else { -since_s / FORGIVENESS };
            doubt.contradicted_s = (doubt.contradicted_s + step_s).clamp(0.0, LEFT_OUT_AFTER_S);
            let is_left_out = match doubt.is_left_out {
                true => doubt.contradicted_s > 0.0,
                false => doubt.contradicted_s >= LEFT_OUT_AFTER_S,
            };
            if is_left_out != doubt.is_left_out {
                doubt.is_left_out = is_left_out;
                changed.push(observer);
            }
        }
        self.doubts
            .retain(|observer, doubt| doubt.contradicted_s > 0.0 || wrong.contains(observer));
        // What it said is part of these filters, or not yet: they begin anew.
        self.pairs.retain(|(one, other), _| !changed.contains(one) && !changed.contains(other));
    }
}

fn pose_of(prediction: &Prediction) -> UncertainPose {
    UncertainPose {
        a_from_b: prediction.camera_from_markers,
        covariance: prediction.pose_covariance(),
    }
}
