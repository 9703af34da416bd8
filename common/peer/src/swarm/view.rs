//! Where all drones are, as one of them would have it, estimated from sightings as they come.

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

/// How long a drone's own rotation is kept, seconds: longer than reports are under way.
const ROTATION_KEPT_S: f64 = 2.0;
/// Maximum drones, this one included.
pub(crate) const MOST_DRONES: usize = 64;
/// A pair that nobody has measured for this long is forgotten, seconds.
const FORGOTTEN_S: f64 = 1.0;
/// Deviation of a velocity in a report that has no measurements, m/s and rad/s: how far the pose
/// may have gone since its exposure beyond what it says.
const REPORTED_VELOCITY_DEVIATION: f64 = 0.5;
/// Motion as others see it, m/s^2 per root Hz; their rotation is not known, so what stands still
/// seems to move when they turn. A drone that rolls by 12 degrees at 0.7 Hz sees a neighbour 1.5 m
/// away accelerate by up to 6 m/s^2. Over a frame of 33 ms that is as much.
const OTHERS_ACCELERATION: f64 = 3.0;
/// An observer that contradicts the others for so long is left out, seconds.
const LEFT_OUT_AFTER_S: f64 = 0.5;
/// It comes back after so many times as long without contradiction.
const FORGIVENESS: f64 = 10.0;
/// A check stands for no longer than this, seconds: after a pause one check alone leaves nobody
/// out.
const LONGEST_CHECK_S: f64 = 0.25;
/// What calibrations of mounts and lenses leave, m and rad. When sightings are compared, it is
/// added to their deviations, so that it is not taken for a lie.
const CALIBRATION: (f64, f64) = (0.02, 0.02);

/// Where a drone is from here.
#[derive(Debug, Clone, PartialEq)]
pub struct DronePlace {
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
fn course(report: &PeerReport) -> Vector6<f64> {
    let PeerReport { velocity, rate, .. } = report;
    Vector6::new(velocity.x, velocity.y, velocity.z, rate.x, rate.y, rate.z)
}

/// What each direction says alone, by observer and target.
type Directed = BTreeMap<(usize, usize), UncertainPose>;

/// Combines reports into where all drones are from one of them.
#[derive(Debug)]
pub struct SwarmView {
    /// How the origin turns.
    ego: EgoRotation,
    /// Motion as the origin sees it, whose own rotation is known.
    own_motion: MotionModel,
    /// Motion as others see it.
    others_motion: MotionModel,
    /// Names by number; oneself is 0. A number whose drone is forgotten is given to the next.
    names: Vec<Option<String>>,
    /// By observer and target.
    directions: BTreeMap<(usize, usize), Direction>,
    /// Both directions in one filter, by the lower and the higher number, in the frame of the lower
    /// one.
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

impl SwarmView {
    /// A view from the drone `own`: its frame is the origin, and its sightings are believed before
    /// others'.
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
        // The first name is never taken away.
        self.names[0].as_deref().unwrap_or_default()
    }

    /// Takes in how the origin has turned, in its own frame. Without it poses rest on wider
    /// assumptions.
    pub fn turned(&mut self, turn: &CameraTurn) {
        self.ego.add(turn);
    }

    /// Takes in a report, of the origin's own or of a peer's sighting. One of a drone beyond the 64
    /// that are known at once, or with numbers that are none, is left out.
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
        let at_s = seen.exposure_monotonic_ns as f64 * 1e-9;
        let deviation_s = seen.exposure_deviation_ns as f64 * 1e-9;
        let numbers = (self.number(&seen.observer), self.number(&seen.target));
        let (Some(observer), Some(target)) = numbers else { return };
        let motion = self.motion(observer);
        let direction = self
            .directions
            .entry((observer, target))
            .or_insert_with(|| Direction { replay: Replay::new(motion), reported: None });
        let Some(measured) = seen.measured.filter(UncertainPose::is_usable) else {
            let pose = seen.observer_from_target;
            direction.reported = Some(Reported { at_s, pose, course: course(seen) });
            return;
        };
        // What is not known of the time is not known of the place, along the motion.
        let shift = course(seen) * deviation_s;
        let covariance = measured.covariance + shift * shift.transpose();
        let pose = UncertainPose { covariance, ..measured };
        let rotation = |observer| if observer == 0 { &self.ego } else { &self.unknown };
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

    /// A track of this drone, or of a peer, is lost: what was seen of it counts no more.
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

    /// The observers whose reports contradict the others', and are left out.
    pub fn left_out(&self) -> Vec<String> {
        let left_out = self.doubts.iter().filter(|(_, doubt)| doubt.is_left_out);
        left_out.filter_map(|(&observer, _)| self.names[observer].clone()).collect()
    }

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
        if observer == 0 { self.own_motion } else { self.others_motion }
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
        // Both measure: one filter has it all, unless it has just begun anew.
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

    /// What each direction says alone at `at_s`.
    fn directed(&self, at_s: f64) -> Directed {
        let said = self.directions.iter().filter_map(|(&key, direction)| {
            if direction.replay.newest_s().is_some() {
                let prediction = direction.replay.at(at_s, self.rotation(key.0))?;
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
    fn rotation(&self, observer: usize) -> &EgoRotation {
        if observer == 0 { &self.ego } else { &self.unknown }
    }

    /// Finds out whose sightings contradict the others'.
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
        // What it said is part of these filters, or not yet: they begin anew.
        self.pairs.retain(|(one, other), _| !changed.contains(one) && !changed.contains(other));
    }
}

fn pose_of(prediction: &MotionEstimate) -> UncertainPose {
    UncertainPose {
        a_from_b: prediction.camera_from_markers,
        covariance: prediction.pose_covariance(),
    }
}
