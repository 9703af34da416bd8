//! Swarms drawn at random: what is estimated, and how certain it claims to be, beside the truth.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_contract::{MeasuredBy, SwarmWay, TrackState};
use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;

use super::graph::{PairPose, solve};
use super::honesty::contradicting;
use super::view::{MOST_DRONES, SwarmView};
use crate::report::PeerReport;
use crate::uncertain_pose::UncertainPose;
use flockeye_geometry::filter::{MotionModel, chi_square_quantile};
use flockeye_geometry::pose::{moved as disturbed, pose_difference};

/// The error that `pose` has if `truth` is right.
fn difference(truth: &Isometry3<f64>, pose: &Isometry3<f64>) -> Vector6<f64> {
    pose_difference(pose, truth)
}

fn normal(random: &mut StdRng) -> f64 {
    random.sample(StandardNormal)
}

fn vector(random: &mut StdRng, deviation: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| deviation * normal(random))
}

fn any_pose(random: &mut StdRng, spread_m: f64) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(vector(random, 1.0));
    Isometry3::from_parts(Translation3::from(vector(random, spread_m)), turn)
}

/// Like that of a camera: far worse along the line of sight than across it, and turned somehow.
fn any_covariance(random: &mut StdRng) -> Matrix6<f64> {
    let mut deviations = Vector6::zeros();
    for k in 0..6 {
        deviations[k] = if k < 3 { 0.004 } else { 0.008 } * (0.7 * normal(random)).exp();
    }
    let mix = Matrix6::from_fn(|row, column| f64::from(row == column) + 0.2 * normal(random));
    mix * Matrix6::from_diagonal(&deviations.component_mul(&deviations)) * mix.transpose()
}

/// An error of this covariance.
fn error(covariance: &Matrix6<f64>, random: &mut StdRng) -> Vector6<f64> {
    covariance.cholesky().unwrap().l() * Vector6::from_fn(|_, _| normal(random))
}

/// What `first` measures of `second`, with this covariance.
fn measured(
    first: &Isometry3<f64>,
    second: &Isometry3<f64>,
    covariance: Matrix6<f64>,
    random: &mut StdRng,
) -> UncertainPose {
    let truth = first.inverse() * second;
    UncertainPose { a_from_b: disturbed(&truth, &error(&covariance, random)), covariance }
}

/// Squared Mahalanobis distance of an estimate from the truth.
fn nees(estimate: &UncertainPose, truth: &Isometry3<f64>) -> f64 {
    let error = difference(truth, &estimate.a_from_b);
    error.dot(&estimate.covariance.cholesky().unwrap().solve(&error))
}

/// The mean of `count` values of 6 degrees of freedom lies within its 95 % bounds.
fn is_consistent(sum: f64, count: usize) -> bool {
    let degrees = 6.0 * count as f64;
    let (low, high) = (chi_square_quantile(degrees, 0.025), chi_square_quantile(degrees, 0.975));
    println!(
        "NEES {:.3} of {count}: {:.3} to {:.3}",
        sum / count as f64,
        low / count as f64,
        high / count as f64
    );
    (low..high).contains(&sum)
}

proptest! {
    #[test]
    fn the_inverse_of_the_inverse_is_the_same(seed in any::<u64>()) {
        let mut random = StdRng::seed_from_u64(seed);
        let pose = UncertainPose { a_from_b: any_pose(&mut random, 2.0), covariance: any_covariance(&mut random) };
        let back = pose.inverse().inverse();
        prop_assert!(difference(&pose.a_from_b, &back.a_from_b).norm() < 1e-12);
        prop_assert!((pose.covariance - back.covariance).norm() < 1e-12);
    }

    /// A covariance describes an error to first order: a small error goes the way that the
    /// Jacobians say.
    #[test]
    fn errors_of_inverses_and_chains_are_what_their_covariances_say(seed in any::<u64>()) {
        let mut random = StdRng::seed_from_u64(seed);
        let (one, two) = (any_pose(&mut random, 2.0), any_pose(&mut random, 2.0));
        let small = Matrix6::identity() * 1e-12;
        let (e, f) = (error(&small, &mut random), error(&small, &mut random));
        // Of an error alone, the covariance is its outer product.
        let of = |pose: &Isometry3<f64>, e: &Vector6<f64>| UncertainPose { a_from_b: *pose, covariance: e * e.transpose() };
        let (one_true, two_true) = (disturbed(&one, &e), disturbed(&two, &f));
        let inverse_error = difference(&one.inverse(), &one_true.inverse());
        let said = of(&one, &e).inverse().covariance;
        prop_assert!((said - inverse_error * inverse_error.transpose()).norm() < 1e-4 * said.norm());
        let chain_error = difference(&(one * two), &(one_true * two_true));
        // The two errors add up, so the sum of what each alone makes is the whole.
        let first = difference(&(one * two), &(one_true * two));
        let second = difference(&(one * two), &(one * two_true));
        prop_assert!((chain_error - first - second).norm() < 1e-9);
        let said = of(&one, &e).then(&of(&two, &f)).covariance;
        prop_assert!((said - first * first.transpose() - second * second.transpose()).norm() < 1e-4 * said.norm());
    }

    /// Julier and Uhlmann's promise: never too small, whatever the correlation. With the same
    /// covariance there is nothing to gain.
    #[test]
    fn an_intersection_claims_no_more_than_the_better_one(seed in any::<u64>()) {
        let mut random = StdRng::seed_from_u64(seed);
        let pose = any_pose(&mut random, 2.0);
        let one = UncertainPose { a_from_b: pose, covariance: any_covariance(&mut random) };
        let two = UncertainPose { a_from_b: pose, covariance: any_covariance(&mut random) };
        let same = one.intersection(&one).unwrap();
        prop_assert!((same.covariance - one.covariance).norm() < 1e-9);
        let both = one.intersection(&two).unwrap();
        let least = one.covariance.determinant().min(two.covariance.determinant());
        prop_assert!(both.covariance.determinant() <= least * 1.001);
        // If both errors are the same, as they may be, the result still covers it.
        let e = error(&one.covariance, &mut random);
        let shifted = one.moved(&e).intersection(&two.moved(&e)).unwrap();
        prop_assert!((difference(&pose, &shifted.a_from_b) - e).norm() < 1e-3);
    }
}

/// Chains grow, and loops shrink, as they must: the mean squared error is what the covariance says.
#[test]
fn covariances_of_graphs_are_those_of_their_errors() {
    let mut random = StdRng::seed_from_u64(8);
    let (mut sums, runs) = ([0.0; 4], 2_000);
    for _ in 0..runs {
        let drones: Vec<_> = (0..5)
            .map(|k| if k == 0 { Isometry3::identity() } else { any_pose(&mut random, 1.5) })
            .collect();
        // A chain 0-1-2-3, closed by 3-0, and 4 seen by 2 alone.
        let edges: Vec<PairPose> = [(0, 1), (1, 2), (2, 3), (3, 0), (2, 4)]
            .into_iter()
            .map(|(from, to)| {
                let covariance = any_covariance(&mut random) * 0.01;
                let from_to = measured(&drones[from], &drones[to], covariance, &mut random);
                PairPose { from, to, from_to }
            })
            .collect();
        let solution = solve(5, &edges);
        assert_eq!(solution.degrees, 6);
        for drone in 1..5 {
            sums[drone - 1] += nees(&solution.nodes[drone].unwrap().pose, &drones[drone]);
        }
    }
    assert!(sums.iter().all(|&sum| is_consistent(sum, runs)), "{sums:?}");
}

#[test]
fn what_no_edge_leads_to_is_not_known() {
    let pose = UncertainPose {
        a_from_b: Isometry3::translation(1.0, 0.0, 0.0),
        covariance: Matrix6::identity() * 1e-4,
    };
    let solution = solve(
        4,
        &[PairPose { from: 2, to: 3, from_to: pose }, PairPose { from: 1, to: 0, from_to: pose }],
    );
    assert!(solution.nodes[2].is_none() && solution.nodes[3].is_none());
    let one = solution.nodes[1].unwrap();
    assert!((one.pose.a_from_b.translation.x + 1.0).abs() < 1e-9);
    assert_eq!((one.through, solution.degrees), (0, 0));
    assert_eq!(solve(1, &[]).degrees, 0);
}

#[test]
fn of_five_observers_the_one_that_lies_is_found() {
    let mut random = StdRng::seed_from_u64(11);
    for run in 0..40 {
        let drones: Vec<_> = (0..5)
            .map(|k| if k == 0 { Isometry3::identity() } else { any_pose(&mut random, 1.5) })
            .collect();
        let liar = (run % 5 != 0).then_some(run % 5);
        let mut edges = Vec::new();
        for from in 0..5 {
            for to in (0..5).filter(|&to| to != from) {
                let covariance = any_covariance(&mut random);
                let mut from_to = measured(&drones[from], &drones[to], covariance, &mut random);
                if Some(from) == liar {
                    from_to.a_from_b.translation.vector.x += 1.0;
                }
                edges.push(PairPose { from, to, from_to });
            }
        }
        assert_eq!(contradicting(5, &edges), Vec::from_iter(liar));
    }
}

/// Drones that move as the filters assume, and a clock for them.
struct Flight {
    random: StdRng,
    motion: MotionModel,
    now_s: f64,
    drones: Vec<(Isometry3<f64>, Vector3<f64>, Vector3<f64>)>,
}

const NAMES: [&str; 4] = ["own", "wren", "kite", "swift"];
const STEP_S: f64 = 1.0 / 30.0;

impl Flight {
    fn new(seed: u64, drones: usize) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        // Hardly any rotation: the drones' own is not known to each other here.
        let motion =
            MotionModel { acceleration: 0.5, angular_acceleration: 0.02, ..MotionModel::default() };
        let place = |random: &mut StdRng| {
            (any_pose(random, 1.0), vector(random, 0.1), vector(random, 0.005))
        };
        let drones = (0..drones).map(|_| place(&mut random)).collect();
        Self { random, motion, now_s: 100.0, drones }
    }

    /// What one drone knows. Relative motion has the power of both drones' accelerations.
    fn view(&self) -> SwarmView {
        let motion = MotionModel {
            acceleration: self.motion.acceleration * 2f64.sqrt(),
            angular_acceleration: self.motion.angular_acceleration * 2f64.sqrt(),
            ..self.motion
        };
        SwarmView::with_motion("own", motion, motion)
    }

    /// Moves by a piece of a step: white noise in small pieces.
    fn step(&mut self) {
        let (pieces, root) = (8, (STEP_S / 8.0).sqrt());
        for _ in 0..pieces {
            let piece_s = STEP_S / f64::from(pieces);
            for (pose, velocity, rate) in &mut self.drones {
                *velocity += vector(&mut self.random, self.motion.acceleration * root);
                *rate += vector(&mut self.random, self.motion.angular_acceleration * root);
                pose.translation.vector += *velocity * piece_s;
                pose.rotation = UnitQuaternion::from_scaled_axis(*rate * piece_s) * pose.rotation;
            }
            self.now_s += piece_s;
        }
    }

    fn now_ns(&self) -> i64 {
        (self.now_s * 1e9) as i64
    }

    fn truth(&self, drone: usize) -> Isometry3<f64> {
        self.drones[0].0.inverse() * self.drones[drone].0
    }

    /// `observer` sees `target` now. A camera knows the range worst, and a facet's tilt.
    fn see(&mut self, view: &mut SwarmView, observer: usize, target: usize, lie: f64) {
        let truth = self.drones[observer].0.inverse() * self.drones[target].0;
        let sight = truth.translation.vector.normalize();
        let along = sight * sight.transpose();
        let mut covariance = Matrix6::identity() * 1e-6;
        let position = along * 0.006f64.powi(2) + nalgebra::Matrix3::identity() * 0.0005f64.powi(2);
        let rotation = nalgebra::Matrix3::identity() * 0.012f64.powi(2);
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&position);
        covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
        let mut pose = UncertainPose {
            a_from_b: disturbed(&truth, &error(&covariance, &mut self.random)),
            covariance,
        };
        pose.a_from_b.translation.vector.y += lie;
        view.hear(&report(NAMES[observer], NAMES[target], self.now_ns(), pose, Some(pose)));
    }
}

/// What `observer` reports of `target`.
fn report(
    observer: &str,
    target: &str,
    exposure_monotonic_ns: i64,
    pose: UncertainPose,
    measured: Option<UncertainPose>,
) -> PeerReport {
    PeerReport {
        observer: observer.into(),
        target: target.into(),
        frame: (0, 0),
        state: TrackState::Confirmed,
        measured_by: MeasuredBy::Decoded,
        observer_from_target: pose,
        measured,
        velocity: Vector3::zeros(),
        rate: Vector3::zeros(),
        rival: None,
        degenerate: None,
        exposure_monotonic_ns,
        exposure_deviation_ns: 0,
    }
}

fn place<'p>(places: &'p [super::DronePlace], name: &str) -> Option<&'p super::DronePlace> {
    places.iter().find(|place| place.name == name)
}

/// Mutual and chained poses over 50 simulated swarms: own and wren see each other, wren and kite
/// see each other, swift sees own and is not seen.
#[test]
fn mutual_and_chained_poses_are_as_certain_as_they_say() {
    let (mut sums, mut errors, runs) = ([0.0; 3], [[0.0; 2]; 2], 50);
    for run in 0..runs {
        let mut flight = Flight::new(run as u64, 4);
        let mut both = flight.view();
        let mut alone = flight.view();
        for _ in 0..60 {
            flight.step();
            for (observer, target) in [(0, 1), (1, 0), (1, 2), (2, 1), (3, 0)] {
                flight.see(&mut both, observer, target, 0.0);
            }
            flight.see(&mut alone, 0, 1, 0.0);
        }
        let places = both.places(flight.now_ns());
        for (k, (name, way)) in
            [("wren", SwarmWay::Mutual), ("kite", SwarmWay::Chained), ("swift", SwarmWay::Reported)]
                .iter()
                .enumerate()
        {
            let place = place(&places, name).unwrap();
            assert_eq!(place.way, *way, "{name}");
            sums[k] += nees(&place.own_from_drone, &flight.truth(k + 1));
        }
        assert_eq!(place(&places, "kite").unwrap().through.as_deref(), Some("wren"));
        let single = alone.places(flight.now_ns());
        for (k, places) in [&places, &single].into_iter().enumerate() {
            let error = difference(
                &flight.truth(1),
                &place(places, "wren").unwrap().own_from_drone.a_from_b,
            );
            errors[k][0] += error.fixed_rows::<3>(0).norm_squared();
            errors[k][1] += error.fixed_rows::<3>(3).norm_squared();
        }
    }
    assert!(sums.iter().all(|&sum| is_consistent(sum, runs)), "{sums:?}");
    // Rotation gains most: where the other sees me tells how it is turned.
    let ratio = |part: usize| (errors[0][part] / errors[1][part]).sqrt();
    println!("mutual over direct: position {:.2}, rotation {:.2}", ratio(0), ratio(1));
    assert!(ratio(0) <= 0.75 && ratio(1) <= 0.75, "{} {}", ratio(0), ratio(1));
}

/// Reports come late, in any order, and some never: the estimate is that of those that came.
#[test]
fn late_reports_count_as_if_they_had_come_in_time() {
    let mut flight = Flight::new(3, 2);
    let mut in_time = flight.view();
    let mut late = flight.view();
    let mut held = Vec::new();
    for frame in 0..60 {
        flight.step();
        let truth = flight.truth(1);
        let pose = UncertainPose { a_from_b: truth, covariance: Matrix6::identity() * 1e-5 };
        let seen =
            |observer, target, pose| report(observer, target, flight.now_ns(), pose, Some(pose));
        let (own, theirs) = (seen("own", "wren", pose), seen("wren", "own", pose.inverse()));
        in_time.hear(&own);
        in_time.hear(&theirs);
        late.hear(&own);
        // Up to six frames on the way.
        held.push((frame + (frame * 7) % 6, theirs));
        held.retain(|(due, theirs)| {
            let is_due = *due <= frame;
            if is_due {
                late.hear(theirs);
            }
            !is_due
        });
    }
    held.iter().for_each(|(_, theirs)| late.hear(theirs));
    let (one, two) = (in_time.places(flight.now_ns()), late.places(flight.now_ns()));
    let between = difference(&one[0].own_from_drone.a_from_b, &two[0].own_from_drone.a_from_b);
    assert!(between.norm() < 1e-9, "{between}");
    assert!((one[0].own_from_drone.covariance - two[0].own_from_drone.covariance).norm() < 1e-9);
}

/// With one liar among four observers the others' poses are as if it were not there, and it comes
/// back when it has told the truth for long enough.
#[test]
fn a_liar_is_left_out_and_forgiven() {
    let mut flight = Flight::new(5, 4);
    let mut view = flight.view();
    let mut fly = |view: &mut SwarmView, frames: usize, lie: f64| {
        let mut places = Vec::new();
        for _ in 0..frames {
            flight.step();
            for observer in 0..4 {
                for target in (0..4).filter(|&target| target != observer) {
                    let lie = if observer == 2 { lie } else { 0.0 };
                    flight.see(view, observer, target, lie);
                }
            }
            places = view.places(flight.now_ns());
        }
        let error = |drone: usize| {
            let place = place(&places, NAMES[drone]).unwrap();
            difference(&flight.truth(drone), &place.own_from_drone.a_from_b)
                .fixed_rows::<3>(0)
                .norm()
        };
        [error(1), error(2), error(3)]
    };
    assert!(fly(&mut view, 30, 0.0).iter().all(|error| *error < 0.01));
    assert_eq!(view.left_out().len(), 0);
    let errors = fly(&mut view, 30, 1.0);
    assert_eq!(view.left_out(), ["kite"]);
    assert!(errors.iter().all(|error| *error < 0.02), "{errors:?}");
    // Five seconds, and what it took to find nothing wrong any more.
    fly(&mut view, 60, 0.0);
    assert_eq!(view.left_out().len(), 1, "not forgiven yet");
    fly(&mut view, 120, 0.0);
    assert_eq!(view.left_out().len(), 0);
}

#[test]
fn names_and_numbers_that_are_none_do_no_harm() {
    const SECOND: i64 = 1_000_000_000;
    let mut view = SwarmView::from("own");
    let good = UncertainPose {
        a_from_b: Isometry3::translation(1.0, 0.0, 0.0),
        covariance: Matrix6::identity() * 1e-4,
    };
    let hear = |observer: &str, target: &str, pose: UncertainPose, view: &mut SwarmView| {
        view.hear(&report(observer, target, SECOND, pose, None));
    };
    hear("wren", "wren", good, &mut view);
    hear("wren", "own", UncertainPose { covariance: Matrix6::zeros(), ..good }, &mut view);
    assert!(view.places(SECOND).is_empty());
    (0..200).for_each(|k| hear(&format!("drone-{k}"), "own", good, &mut view));
    assert_eq!(view.places(SECOND).len(), MOST_DRONES - 1);
    let lost = report("drone-1", "own", SECOND, good, None);
    view.hear(&PeerReport { state: TrackState::Lost, ..lost });
    assert!(place(&view.places(SECOND), "drone-1").is_none());
    assert!(view.places(3 * SECOND).is_empty(), "forgotten");
    // There is room for others then.
    view.hear(&report("robin", "own", 3 * SECOND, good, None));
    assert!(place(&view.places(3 * SECOND), "robin").is_some());
}
