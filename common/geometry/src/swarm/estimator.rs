//! Where all drones are from here, fed with sightings as they come.

use std::collections::BTreeMap;

use nalgebra::{Matrix6, Vector3, Vector6};

use crate::ego_rotation::EgoRotation;
use crate::filter::{MotionModel, Prediction};

use super::graph::{Edge, solve};
use super::honesty::contradicting;
use super::replay::{Measured, Replay};
use super::uncertain_pose::UncertainPose;

/// Most drones, oneself included.
pub const MOST_DRONES: usize = 64;
/// A pair that nobody has measured for this long says nothing any more, seconds.
const FORGOTTEN_S: f64 = 1.0;
/// Deviation of a velocity in a report that has no measurements, m/s and rad/s: how far the pose may have gone
/// since its exposure beyond what it says.
const REPORTED_VELOCITY_DEVIATION: f64 = 0.5;
/// An observer is left out after so many checks in which it contradicts the others, and comes back when as many
/// times [`FORGIVEN`] checks have found nothing.
const LEFT_OUT_AT: f64 = 5.0;
/// What a check that finds nothing takes off.
const FORGIVEN: f64 = 0.1;
/// Beyond these, sightings contradict each other: what calibrations of mounts and lenses leave, m and rad. It is
/// added for the comparison alone.
const CALIBRATION: (f64, f64) = (0.02, 0.02);

/// How drones move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SwarmModel {
    /// As seen by this drone, whose own rotation is known.
    pub own: MotionModel,
    /// As seen by others, whose rotation is not: what stands still seems to move when they turn.
    pub others: MotionModel,
}

impl Default for SwarmModel {
    /// For others 3 m/s^2 per root Hz: a drone that rolls by 12 degrees at 0.7 Hz moves a neighbour 1.5 m away
    /// by up to 6 m/s^2 in its own frame, which over a frame of 33 ms is as much.
    fn default() -> Self {
        let own = MotionModel::default();
        Self { own, others: MotionModel { acceleration: 3.0, ..own } }
    }
}

/// What one observer says of one target at one exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen<'n> {
    /// Who sees.
    pub observer: &'n str,
    /// Whom.
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

/// How a place is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// This drone sees it.
    Direct,
    /// Each of the two sees the other.
    Mutual,
    /// It sees this drone, and is not seen by it.
    Reported,
    /// Through others alone.
    Chained,
}

/// Where a drone is from here.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Whose place.
    pub name: String,
    /// Its pose in this drone's frame, and how certain it is.
    pub own_from_drone: UncertainPose,
    /// How it is known.
    pub way: Way,
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
    /// Of measurements, where the reports have them.
    replay: Replay,
    /// Of reports without measurements.
    reported: Option<Reported>,
}

#[derive(Debug, Clone, Copy)]
struct Reported {
    at_s: f64,
    pose: UncertainPose,
    velocity: Vector3<f64>,
    rate: Vector3<f64>,
}

impl Direction {
    fn newest_s(&self) -> Option<f64> {
        self.replay.newest_s().max_by(self.reported.map(|reported| reported.at_s))
    }
}

/// The later of two times that may be unknown.
trait Later {
    fn max_by(self, other: Self) -> Self;
}

impl Later for Option<f64> {
    fn max_by(self, other: Self) -> Self {
        match (self, other) {
            (Some(one), Some(other)) => Some(one.max(other)),
            (one, other) => one.or(other),
        }
    }
}

/// Where all drones are from here.
#[derive(Debug, Clone)]
pub struct SwarmEstimator {
    model: SwarmModel,
    /// Names by number; oneself is 0.
    names: Vec<String>,
    /// By observer and target.
    directions: BTreeMap<(usize, usize), Direction>,
    /// Both directions in one filter, by the lower and the higher number, in the frame of the lower one.
    pairs: BTreeMap<(usize, usize), Replay>,
    doubts: BTreeMap<usize, Doubt>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Doubt {
    level: f64,
    is_left_out: bool,
}

impl SwarmEstimator {
    /// From the drone `own`. Nothing is seen yet.
    pub fn new(own: &str, model: SwarmModel) -> Self {
        Self {
            model,
            names: vec![own.to_owned()],
            directions: BTreeMap::new(),
            pairs: BTreeMap::new(),
            doubts: BTreeMap::new(),
        }
    }

    /// Takes in a sighting. `ego` is how this drone turns. One of a drone beyond [`MOST_DRONES`], or with
    /// numbers that are none, is left out.
    pub fn see(&mut self, seen: &Seen<'_>, ego: &EgoRotation) {
        let is_usable = seen.filtered.is_usable() && seen.at_s.is_finite();
        let (Some(observer), Some(target)) = (self.number(seen.observer), self.number(seen.target))
        else {
            return;
        };
        if !is_usable || observer == target {
            return;
        }
        let motion = self.motion(observer);
        let direction = self
            .directions
            .entry((observer, target))
            .or_insert_with(|| Direction { replay: Replay::new(motion), reported: None });
        let nobody = EgoRotation::new(1.0);
        let Some(measured) = seen.measured.filter(UncertainPose::is_usable) else {
            direction.reported = Some(Reported {
                at_s: seen.at_s,
                pose: seen.filtered,
                velocity: seen.velocity,
                rate: seen.rate,
            });
            return;
        };
        // What is not known of the time is not known of the place, along the motion.
        let mut course = Vector6::zeros();
        course.fixed_rows_mut::<3>(0).copy_from(&seen.velocity);
        course.fixed_rows_mut::<3>(3).copy_from(&seen.rate);
        let course = course * seen.deviation_s;
        let pose = UncertainPose {
            covariance: measured.covariance + course * course.transpose(),
            ..measured
        };
        let measured = Measured { at_s: seen.at_s, pose };
        direction.replay.add(measured, if observer == 0 { ego } else { &nobody });
        if self.is_left_out(observer) {
            return;
        }
        let pair = (observer.min(target), observer.max(target));
        let pose = if observer < target { pose } else { pose.inverse() };
        let motion = self.motion(pair.0);
        let replay = self.pairs.entry(pair).or_insert_with(|| Replay::new(motion));
        replay.add(Measured { at_s: seen.at_s, pose }, if pair.0 == 0 { ego } else { &nobody });
    }

    /// A track of this drone, or of a peer, is lost: what was seen of it counts no more.
    pub fn lose(&mut self, observer: &str, target: &str) {
        let number = |name: &str| self.names.iter().position(|known| known == name);
        if let (Some(observer), Some(target)) = (number(observer), number(target)) {
            self.directions.remove(&(observer, target));
            if !self.directions.contains_key(&(target, observer)) {
                self.pairs.remove(&(observer.min(target), observer.max(target)));
            }
        }
    }

    /// Where all drones are at `at_s` (seconds, on this machine's clock), the certain ones first by name.
    pub fn places(&mut self, at_s: f64, ego: &EgoRotation) -> Vec<Place> {
        self.forget(at_s);
        self.judge(at_s, ego);
        let mut edges = Vec::new();
        let mut newest_s = BTreeMap::new();
        let pairs: std::collections::BTreeSet<(usize, usize)> =
            self.directions.keys().map(|&(a, b)| (a.min(b), a.max(b))).collect();
        for pair in pairs {
            if let Some((edge, seen_s)) = self.edge(pair, at_s, ego) {
                newest_s.insert(pair, seen_s);
                edges.push(edge);
            }
        }
        let solution = solve(self.names.len(), &edges);
        let places = solution.nodes.iter().enumerate().filter_map(|(drone, node)| {
            let node = (*node)?;
            let seen_s = newest_s.get(&(drone.min(node.through), drone.max(node.through)))?;
            let way = self.way(drone);
            let through = (way == Way::Chained).then(|| self.names[node.through].clone());
            Some(Place {
                name: self.names[drone].clone(),
                own_from_drone: node.pose,
                way,
                through,
                seen_s: *seen_s,
                pairs: edges.len(),
            })
        });
        places.collect()
    }

    /// The observers whose sightings contradict the others', and are left out.
    pub fn left_out(&self) -> impl Iterator<Item = &str> {
        let left_out = self.doubts.iter().filter(|(_, doubt)| doubt.is_left_out);
        left_out.filter_map(|(&observer, _)| self.names.get(observer).map(String::as_str))
    }

    /// The number of a drone, given where there is room.
    fn number(&mut self, name: &str) -> Option<usize> {
        if let Some(known) = self.names.iter().position(|known| known == name) {
            return Some(known);
        }
        if self.names.len() == MOST_DRONES {
            return None;
        }
        self.names.push(name.to_owned());
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
    }

    /// How a drone is known.
    fn way(&self, drone: usize) -> Way {
        let counts = |observer, target| {
            self.directions.contains_key(&(observer, target)) && !self.is_left_out(observer)
        };
        match (counts(0, drone), counts(drone, 0)) {
            (true, true) => Way::Mutual,
            (true, false) => Way::Direct,
            (false, true) => Way::Reported,
            (false, false) => Way::Chained,
        }
    }

    /// What is known of a pair, in the frame of the lower number, and when it was seen last.
    fn edge(&self, pair: (usize, usize), at_s: f64, ego: &EgoRotation) -> Option<(Edge, f64)> {
        let (from, to) = pair;
        let counting = |observer: usize, target: usize| {
            self.directions.get(&(observer, target)).filter(|_| !self.is_left_out(observer))
        };
        let (forth, back) = (counting(from, to), counting(to, from));
        let newest_s = |direction: Option<&Direction>| direction.and_then(Direction::newest_s);
        let seen_s = newest_s(forth).max_by(newest_s(back))?;
        let measured = |direction: Option<&Direction>| {
            direction.is_some_and(|direction| direction.replay.newest_s().is_some())
        };
        let pose = match (measured(forth), measured(back)) {
            (true, true) => {
                pose_of(&self.pairs.get(&pair)?.at(at_s, self.ego_of(from, ego).as_ref())?)
            }
            _ => {
                let forth = forth.and_then(|forth| self.directed(from, forth, at_s, ego));
                let back = back.and_then(|back| self.directed(to, back, at_s, ego));
                match (forth, back.map(|back| back.inverse())) {
                    (Some(forth), Some(back)) => forth.intersection(&back)?,
                    (forth, back) => forth.or(back)?,
                }
            }
        };
        Some((Edge { from, to, from_to: pose }, seen_s))
    }

    /// What one direction says alone.
    fn directed(
        &self,
        observer: usize,
        direction: &Direction,
        at_s: f64,
        ego: &EgoRotation,
    ) -> Option<UncertainPose> {
        if direction.replay.newest_s().is_some() {
            return Some(pose_of(&direction.replay.at(at_s, self.ego_of(observer, ego).as_ref())?));
        }
        let reported = direction.reported?;
        let step_s = at_s - reported.at_s;
        let mut course = Vector6::zeros();
        course.fixed_rows_mut::<3>(0).copy_from(&reported.velocity);
        course.fixed_rows_mut::<3>(3).copy_from(&reported.rate);
        let spread = (REPORTED_VELOCITY_DEVIATION * step_s).powi(2);
        let moved = reported.pose.moved(&(course * step_s));
        Some(UncertainPose { covariance: moved.covariance + Matrix6::identity() * spread, ..moved })
    }

    /// This drone's own rotation, or none for another observer.
    fn ego_of<'e>(
        &self,
        observer: usize,
        ego: &'e EgoRotation,
    ) -> std::borrow::Cow<'e, EgoRotation> {
        if observer == 0 {
            std::borrow::Cow::Borrowed(ego)
        } else {
            std::borrow::Cow::Owned(EgoRotation::new(1.0))
        }
    }

    /// Finds out whose sightings contradict the others'.
    fn judge(&mut self, at_s: f64, ego: &EgoRotation) {
        let edges: Vec<Edge> = self
            .directions
            .iter()
            .filter_map(|(&(from, to), direction)| {
                let mut from_to = self.directed(from, direction, at_s, ego)?;
                for axis in 0..3 {
                    from_to.covariance[(axis, axis)] += CALIBRATION.0.powi(2);
                    from_to.covariance[(axis + 3, axis + 3)] += CALIBRATION.1.powi(2);
                }
                Some(Edge { from, to, from_to })
            })
            .collect();
        let wrong = contradicting(self.names.len(), &edges);
        for &observer in &wrong {
            self.doubts.entry(observer).or_default();
        }
        let mut changed = Vec::new();
        for (&observer, doubt) in &mut self.doubts {
            let step = if wrong.contains(&observer) { 1.0 } else { -FORGIVEN };
            doubt.level = (doubt.level + step).clamp(0.0, LEFT_OUT_AT);
            let is_left_out =
                if doubt.is_left_out { doubt.level > 0.0 } else { doubt.level >= LEFT_OUT_AT };
            if is_left_out != doubt.is_left_out {
                doubt.is_left_out = is_left_out;
                changed.push(observer);
            }
        }
        self.doubts.retain(|_, doubt| doubt.level > 0.0);
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
