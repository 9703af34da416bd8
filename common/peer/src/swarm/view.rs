//! Poses of all drones relative to one of them, estimated from sightings as they arrive.

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::{SwarmWay, TrackState};
use flockeye_geometry::ego_rotation::{CameraTurn, EgoRotation};
use flockeye_geometry::filter::{MotionEstimate, MotionModel};
use flockeye_network::monotonic_now_ns;
use nalgebra::{Matrix6, Vector6};

use super::graph::{PairPose, solve};
use super::honesty::contradicting;
use super::replay::Replay;
use crate::report::PeerReport;
use crate::uncertain_pose::UncertainPose;

/// Time for which this drone's rotation is kept, seconds: longer than reports are under way.
const ROTATION_KEPT_S: f64 = 2.0;
/// Maximum drones, this one included.
pub(crate) const MOST_DRONES: usize = 64;
/// Time without a sighting after which a pair is dropped, seconds.
const FORGOTTEN_S: f64 = 1.0;
/// Standard deviation of the velocity in a report without a measurement, m/s and rad/s. It widens
/// the covariance with the time since the exposure.
const REPORTED_VELOCITY_DEVIATION: f64 = 0.5;
/// Acceleration noise of motion that other drones observe, m/s^2 per root Hz. Their rotation is not
/// known, so a still drone seems to move when they turn. A roll of 12 degrees at 0.7 Hz makes a
/// neighbour 1.5 m away accelerate by up to 6 m/s^2. Over a frame of 33 ms this noise is as large.
const OTHERS_ACCELERATION: f64 = 3.0;
/// Time of contradiction after which an observer is left out, seconds.
const LEFT_OUT_AFTER_S: f64 = 0.5;
/// Factor by which the time without contradiction must exceed the time of contradiction.
const FORGIVENESS: f64 = 10.0;
/// Maximum time that one check counts for, seconds: a single check after a pause leaves no observer
/// out.
const LONGEST_CHECK_S: f64 = 0.25;
/// Standard deviation of the calibration of mounts and lenses, m and rad. It is added when
/// sightings are compared, so that it does not count as a contradiction.
const CALIBRATION: (f64, f64) = (0.02, 0.02);

/// A drone's pose relative to this drone.
#[derive(Debug, Clone, PartialEq)]
pub struct DronePlace {
    /// The drone's name.
    pub name: String,
    /// Its pose in this drone's frame, with the covariance.
    pub own_from_drone: UncertainPose,
    /// The kind of sightings that it is known by.
    pub way: SwarmWay,
    /// The drone before it on the best chain, if its way is `Chained`.
    pub through: Option<String>,
    /// Newest exposure of the pair through which it is known, CLOCK_MONOTONIC, seconds.
    pub seen_s: f64,
    /// Pairs of drones in the whole graph.
    pub pairs: usize,
}

/// One direction of a pair: one drone's sightings of another.
#[derive(Debug, Clone)]
struct Direction {
    /// Filter of the measurements, where the reports have them.
    replay: Replay,
    /// The last report without a measurement.
    reported: Option<PeerReport>,
}

impl Direction {
    fn newest_s(&self) -> Option<f64> {
        later(self.replay.newest_s(), self.reported.as_ref().map(exposure_s))
    }
}

/// The later of two times that may be unknown.
fn later(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    [one, other].into_iter().flatten().reduce(f64::max)
}

/// Mid-exposure on CLOCK_MONOTONIC, seconds.
fn exposure_s(report: &PeerReport) -> f64 {
    report.exposure_monotonic_ns as f64 * 1e-9
}

/// Velocity of a pose: linear (m/s), then angular (rad/s).
fn course(report: &PeerReport) -> Vector6<f64> {
    let PeerReport { velocity, rate, .. } = report;
    Vector6::new(velocity.x, velocity.y, velocity.z, rate.x, rate.y, rate.z)
}

/// The pose from each direction alone, by observer and target.
type Directed = BTreeMap<(usize, usize), UncertainPose>;

/// Combines reports into the poses of all drones relative to one of them.
#[derive(Debug)]
pub struct SwarmView {
    /// Rotation of the origin.
    ego: EgoRotation,
    /// Motion model for the origin's sightings, as its rotation is known.
    own_motion: MotionModel,
    /// Motion model for the other drones' sightings.
    others_motion: MotionModel,
    /// Names by number; this drone is 0. The number of a dropped drone is used again.
    names: Vec<Option<String>>,
    /// The directions, by observer and target.
    directions: BTreeMap<(usize, usize), Direction>,
    /// Both directions in one filter, by the lower and the higher number, in the frame of the lower
    /// one.
    pairs: BTreeMap<(usize, usize), Replay>,
    doubts: BTreeMap<usize, Doubt>,
    judged_s: Option<f64>,
    /// Stands for the unknown rotation of the other observers; it has no samples.
    unknown: EgoRotation,
}

#[derive(Debug, Clone, Copy, Default)]
struct Doubt {
    /// Time of contradiction less the time of agreement over [`FORGIVENESS`], seconds.
    contradicted_s: f64,
    is_left_out: bool,
}

impl SwarmView {
    /// A view from the drone `own`: its frame is the origin, and its sightings are always trusted.
    pub fn from(own: &str) -> Self {
        let own_motion = MotionModel::default();
        let others_motion = MotionModel { acceleration: OTHERS_ACCELERATION, ..own_motion };
        Self::with_motion(own, own_motion, others_motion)
    }

    pub(super) fn with_motion(
        own: &str,
        own_motion: MotionModel,
        others_motion: MotionModel,
    ) -> Self {
        Self {
            ego: EgoRotation::new(ROTATION_KEPT_S),
            own_motion,
            others_motion,
            names: vec![Some(own.to_owned())],
            directions: BTreeMap::new(),
            pairs: BTreeMap::new(),
            doubts: BTreeMap::new(),
            judged_s: None,
            unknown: EgoRotation::new(1.0),
        }
    }

    /// The drone whose frame is the origin.
    pub fn own(&self) -> &str {
        // The first name is never removed.
        self.names[0].as_deref().unwrap_or_default()
    }

    /// Adds a rotation of the origin, in its own frame. Without it the poses have wider
    /// covariances.
    pub fn turned(&mut self, turn: &CameraTurn) {
        self.ego.add(turn);
    }

    /// Adds a report of the origin's or a peer's sighting. A drone beyond the maximum of 64, and
    /// invalid numbers, are ignored.
    pub fn hear(&mut self, report: &PeerReport) {
        match report.state {
            TrackState::Lost => self.lose(&report.observer, &report.target),
            TrackState::Tentative => {}
            TrackState::Confirmed | TrackState::Coasting | TrackState::Measured => self.see(report),
        }
    }

    fn see(&mut self, seen: &PeerReport) {
        if !seen.observer_from_target.is_usable() || seen.observer == seen.target {
            return;
        }
        let deviation_s = seen.exposure_deviation_ns as f64 * 1e-9;
        let numbers = (self.number(&seen.observer), self.number(&seen.target));
        let (Some(observer), Some(target)) = numbers else { return };
        let motion = self.motion(observer);
        let direction = self
            .directions
            .entry((observer, target))
            .or_insert_with(|| Direction { replay: Replay::new(motion), reported: None });
        let Some(measured) = seen.measured.filter(UncertainPose::is_usable) else {
            direction.reported = Some(seen.clone());
            return;
        };
        // An uncertain time makes the pose uncertain along the motion.
        let shift = course(seen) * deviation_s;
        let covariance = measured.covariance + shift * shift.transpose();
        let pose = UncertainPose { covariance, ..measured };
        let rotation = |observer| if observer == 0 { &self.ego } else { &self.unknown };
        let at_s = exposure_s(seen);
        direction.replay.add(at_s, pose, rotation(observer));
        if self.is_left_out(observer) {
            return;
        }
        let pair = (observer.min(target), observer.max(target));
        let pose = if observer < target { pose } else { pose.inverse() };
        let motion = self.motion(pair.0);
        let replay = self.pairs.entry(pair).or_insert_with(|| Replay::new(motion));
        replay.add(at_s, pose, rotation(pair.0));
    }

    /// Handles a lost track of this drone or of a peer: its earlier sightings no longer count.
    fn lose(&mut self, observer: &str, target: &str) {
        if let (Some(observer), Some(target)) = (self.known(observer), self.known(target)) {
            self.directions.remove(&(observer, target));
            if !self.directions.contains_key(&(target, observer)) {
                self.pairs.remove(&(observer.min(target), observer.max(target)));
            }
        }
    }

    /// Poses of all drones now.
    pub fn places_now(&mut self) -> Vec<DronePlace> {
        self.places(monotonic_now_ns())
    }

    /// Poses of all drones at an instant of this machine's CLOCK_MONOTONIC, nanoseconds.
    pub fn places(&mut self, at_monotonic_ns: i64) -> Vec<DronePlace> {
        let at_s = at_monotonic_ns as f64 * 1e-9;
        self.forget(at_s);
        let directed = self.directed(at_s);
        self.judge(at_s, &directed);
        let pairs: BTreeSet<(usize, usize)> =
            self.directions.keys().map(|&(a, b)| (a.min(b), a.max(b))).collect();
        let mut edges = Vec::new();
        let mut newest_s = BTreeMap::new();
        for pair in pairs {
            if let Some((edge, seen_s)) = self.edge(pair, at_s, &directed) {
                newest_s.insert(pair, seen_s);
                edges.push(edge);
            }
        }
        let solution = solve(self.names.len(), &edges);
        let places = solution.nodes.iter().enumerate().filter_map(|(drone, node)| {
            let node = (*node)?;
            let seen_s = newest_s.get(&(drone.min(node.through), drone.max(node.through)))?;
            let way = self.way(drone);
            Some(DronePlace {
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

    /// The observers that are left out, because their reports contradict the others'.
    pub fn left_out(&self) -> Vec<String> {
        let left_out = self.doubts.iter().filter(|(_, doubt)| doubt.is_left_out);
        left_out.filter_map(|(&observer, _)| self.names[observer].clone()).collect()
    }

    fn known(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known.as_deref() == Some(name))
    }

    /// The number of a drone; a new one gets a number if there is room.
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
        if observer == 0 { self.own_motion } else { self.others_motion }
    }

    fn is_left_out(&self, observer: usize) -> bool {
        self.doubts.get(&observer).is_some_and(|doubt| doubt.is_left_out)
    }

    /// Drops pairs and names without recent sightings.
    fn forget(&mut self, at_s: f64) {
        let is_old = |newest_s: Option<f64>| newest_s.is_none_or(|s| s < at_s - FORGOTTEN_S);
        self.directions.retain(|_, direction| !is_old(direction.newest_s()));
        self.pairs.retain(|_, replay| !is_old(replay.newest_s()));
        let seen: BTreeSet<usize> = self.directions.keys().flat_map(|&(a, b)| [a, b]).collect();
        for (number, name) in self.names.iter_mut().enumerate().skip(1) {
            // Doubts outlast a pause, so that a silent observer is not trusted again at once.
            if !seen.contains(&number) && !self.doubts.contains_key(&number) {
                *name = None;
            }
        }
    }

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

    /// The pose of a pair, in the frame of the lower number, and the time of its newest sighting.
    fn edge(
        &self,
        (from, to): (usize, usize),
        at_s: f64,
        directed: &Directed,
    ) -> Option<(PairPose, f64)> {
        let counting = |observer: usize, target: usize| {
            self.directions.get(&(observer, target)).filter(|_| !self.is_left_out(observer))
        };
        let (forth, back) = (counting(from, to), counting(to, from));
        let newest_s = |direction: Option<&Direction>| direction.and_then(Direction::newest_s);
        let seen_s = later(newest_s(forth), newest_s(back))?;
        let is_measured = |direction: Option<&Direction>| {
            direction.is_some_and(|direction| direction.replay.newest_s().is_some())
        };
        // If both drones measure, the common filter has all measurements, unless it has just
        // restarted.
        let filtered = (is_measured(forth) && is_measured(back))
            .then(|| self.pairs.get(&(from, to))?.at(at_s, self.rotation(from)))
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
        Some((PairPose { from, to, from_to }, seen_s))
    }

    /// The pose from each direction alone at `at_s`.
    fn directed(&self, at_s: f64) -> Directed {
        let said = self.directions.iter().filter_map(|(&key, direction)| {
            if direction.replay.newest_s().is_some() {
                let prediction = direction.replay.at(at_s, self.rotation(key.0))?;
                return Some((key, pose_of(&prediction)));
            }
            let reported = direction.reported.as_ref()?;
            let step_s = at_s - exposure_s(reported);
            let mut moved = reported.observer_from_target.moved(&(course(reported) * step_s));
            moved.covariance +=
                Matrix6::identity() * (REPORTED_VELOCITY_DEVIATION * step_s).powi(2);
            Some((key, moved))
        });
        said.collect()
    }

    /// Rotation of an observer, which is known only for this drone.
    fn rotation(&self, observer: usize) -> &EgoRotation {
        if observer == 0 { &self.ego } else { &self.unknown }
    }

    /// Finds the observers whose sightings contradict the others'.
    fn judge(&mut self, at_s: f64, directed: &Directed) {
        let edges: Vec<PairPose> = directed
            .iter()
            .map(|(&(from, to), &said)| {
                let mut from_to = said;
                for axis in 0..3 {
                    from_to.covariance[(axis, axis)] += CALIBRATION.0.powi(2);
                    from_to.covariance[(axis + 3, axis + 3)] += CALIBRATION.1.powi(2);
                }
                PairPose { from, to, from_to }
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
        // These filters contain, or lack, the sightings of observers that have changed, so they
        // start anew.
        self.pairs.retain(|(one, other), _| !changed.contains(one) && !changed.contains(other));
    }
}

fn pose_of(prediction: &MotionEstimate) -> UncertainPose {
    UncertainPose {
        a_from_b: prediction.camera_from_markers,
        covariance: prediction.pose_covariance(),
    }
}
