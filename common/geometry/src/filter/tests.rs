#![allow(clippy::unwrap_used, clippy::expect_used)]

mod belief;
mod life;

use nalgebra::{Unit, Vector6};
use proptest::prelude::*;

use super::*;
use crate::ego_rotation::CameraTurn;
use crate::fixtures::{Chance, distance_squared, error};

const GATE: f64 = 22.46;

/// Measurements of 1 cm and 2 degrees.
fn covariance() -> Matrix6<f64> {
    let (position, rotation) = (0.01f64.powi(2), 2f64.to_radians().powi(2));
    Matrix6::from_diagonal(&Vector6::new(
        position, position, position, rotation, rotation, rotation,
    ))
}

fn measure(truth: &Isometry3<f64>, chance: &mut Chance) -> Isometry3<f64> {
    let noise = Vector6::from(chance.normals::<6>())
        .component_mul(&Vector6::new(0.01, 0.01, 0.01, 0.0349, 0.0349, 0.0349));
    moved(truth, &noise)
}

fn moved(pose: &Isometry3<f64>, by: &Vector6<f64>) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(by.fixed_rows::<3>(3).into_owned());
    Isometry3::from_parts(
        (pose.translation.vector + by.fixed_rows::<3>(0)).into(),
        turn * pose.rotation,
    )
}

/// A camera that does not turn, as far as is known.
fn still() -> EgoRotation {
    EgoRotation::new(2.0)
}

/// A pose measured with [`covariance`].
fn found(camera_from_markers: Isometry3<f64>) -> PoseEstimate {
    PoseEstimate { camera_from_markers, covariance: covariance() }
}

fn motion() -> MotionModel {
    MotionModel::default()
}

fn start(pose: Isometry3<f64>) -> MotionEstimate {
    MotionEstimate::start(10.0, &found(pose), &MotionModel::default()).unwrap()
}

#[test]
fn the_gate_is_the_chi_square_quantile() {
    for (probability, quantile) in [(0.5, 5.348), (0.95, 12.592), (0.99, 16.812), (0.999, 22.458)] {
        assert!((chi_square_gate(probability) - quantile).abs() < 1e-3);
    }
    assert!(chi_square_gate(1.0).is_finite() && chi_square_gate(f64::NAN) < 1e-2);
}

#[test]
fn the_left_jacobian_is_the_derivative_of_the_exponential() {
    let mut chance = Chance::new(1);
    for length in [0.0, 1e-6, 1e-3, 0.3, 2.0] {
        let vector = chance.direction().into_inner() * length;
        let small = Vector3::from(chance.normals::<3>()) * 1e-6;
        let turned = UnitQuaternion::from_scaled_axis(vector + small)
            * UnitQuaternion::from_scaled_axis(vector).inverse();
        assert!((turned.scaled_axis() - left_jacobian(&vector) * small).norm() < 1e-10);
    }
}

/// A target that moves just as the model says, so that the covariance must be right.
struct Wanderer {
    truth: Isometry3<f64>,
    velocity: Vector3<f64>,
    rate: Vector3<f64>,
}

impl Wanderer {
    fn new(motion: &MotionModel, chance: &mut Chance) -> Self {
        Self {
            truth: chance.pose(1.5),
            velocity: Vector3::from(chance.normals::<3>()) * motion.initial_speed,
            rate: Vector3::from(chance.normals::<3>()) * motion.initial_rate,
        }
    }

    fn fly(&mut self, step: f64, motion: &MotionModel, chance: &mut Chance) {
        // White noise over a step: one half of it acts on the mean velocity, and the part
        // across it, sqrt(1/12), makes up the rest of the position's variance.
        let mut drive = |density: f64| {
            let change = Vector3::from(chance.normals::<3>()) * density * step.sqrt();
            let across = Vector3::from(chance.normals::<3>()) * density * step.sqrt();
            (change, (change / 2.0 + across / 12f64.sqrt()) * step)
        };
        let (faster, shift) = drive(motion.acceleration);
        let (turning, turn) = drive(motion.angular_acceleration);
        let way = self.velocity * step + shift;
        let around = self.rate * step + turn;
        let by = Vector6::from_iterator(way.iter().chain(around.iter()).copied());
        self.truth = moved(&self.truth, &by);
        self.velocity += faster;
        self.rate += turning;
    }

    /// What a track's state is off by: position, rotation, both velocities.
    fn error(&self, now: &MotionEstimate) -> SVector<f64, 12> {
        let mut off = SVector::<f64, 12>::zeros();
        off.fixed_rows_mut::<6>(0).copy_from(&error(&self.truth, &now.camera_from_markers));
        off.fixed_rows_mut::<3>(6).copy_from(&(self.velocity - now.velocity));
        off.fixed_rows_mut::<3>(9).copy_from(&(self.rate - now.rate));
        off
    }
}

/// The squared error of some rows, normalised by what the covariance says of them.
fn normalised<const N: usize>(off: &SVector<f64, 12>, now: &MotionEstimate, first: usize) -> f64 {
    let covariance = now.covariance.fixed_view::<N, N>(first, first).into_owned();
    let off = off.fixed_rows::<N>(first).into_owned();
    off.dot(&covariance.cholesky().expect("a covariance").solve(&off))
}

/// Consistency over independent runs (Bar-Shalom, Li, Kirubarajan, section 5.4.2): at each time the
/// mean of the normalised squared error over the runs is chi-square, divided by the runs.
#[test]
fn estimates_are_as_good_as_they_say() {
    const RUNS: usize = 200;
    const FRAMES: usize = 40;
    let (mut chance, motion) = (Chance::new(2), MotionModel::default());
    let step: f64 = 1.0 / 30.0;
    // Squared errors of all twelve, of the position, of the rotation; summed over the runs.
    let mut sums = [[0.0; 3]; FRAMES];
    let (mut innovations, mut gated) = (0.0, 0);
    for _ in 0..RUNS {
        let mut target = Wanderer::new(&motion, &mut chance);
        let mut track = start(measure(&target.truth, &mut chance));
        for (frame, sums) in (1..).zip(&mut sums) {
            target.fly(step, &motion, &mut chance);
            let stamp_s = 10.0 + f64::from(frame) * step;
            let measured = measure(&target.truth, &mut chance);
            let predicted = track.predict(stamp_s, &motion, &still()).unwrap();
            match track.update(stamp_s, &found(measured), GATE, &motion, &still()) {
                Ok(_) => {
                    let off = error(&measured, &predicted.camera_from_markers);
                    innovations +=
                        distance_squared(&off, &(predicted.pose_covariance() + covariance()));
                }
                Err(FilterError::Gated { .. }) => gated += 1,
                Err(other) => panic!("{other}"),
            }
            let now = track.predict(stamp_s, &motion, &still()).unwrap();
            let off = target.error(&now);
            sums[0] += normalised::<12>(&off, &now, 0);
            sums[1] += normalised::<3>(&off, &now, 0);
            sums[2] += normalised::<3>(&off, &now, 3);
        }
    }
    for (which, degrees) in [(0, 12.0), (1, 3.0), (2, 3.0)] {
        let all = degrees * RUNS as f64;
        let (low, high) = (chi_square_quantile(all, 0.025), chi_square_quantile(all, 0.975));
        let inside = sums.iter().filter(|sums| (low..high).contains(&sums[which])).count();
        // 95 % of the frames should be inside. Neighbouring ones go together, so that 40 are worth
        // some ten: more than two of ten outside would be chance once in a hundred times.
        assert!(inside >= FRAMES * 4 / 5, "{which}: {inside} of {FRAMES} frames are inside");
        let last = sums[FRAMES - 1][which];
        assert!((low..high).contains(&last), "{which}: {last} at the end, not {low} to {high}");
    }
    // What was expected before each measurement is independent from frame to frame.
    let count = (RUNS * FRAMES) as f64;
    assert!((5.8..6.2).contains(&(innovations / count)), "{}", innovations / count);
    assert!(f64::from(gated) < 0.003 * count, "{gated}");
}

#[test]
fn a_moving_neighbour_is_predicted_where_it_will_be() {
    let (velocity, rate) = (Vector3::new(0.2, 1.5, -0.3), Vector3::new(0.0, 0.3, 1.0));
    let at = |time: f64| {
        let by =
            Vector6::from_iterator((velocity * time).iter().chain((rate * time).iter()).copied());
        moved(&Isometry3::translation(2.0, -0.5, 0.3), &by)
    };
    let mut track = start(at(0.0));
    for frame in 1..=30 {
        let time = f64::from(frame) / 30.0;
        track.update(10.0 + time, &found(at(time)), GATE, &motion(), &still()).unwrap();
    }
    let predicted = track.predict(11.1, &motion(), &still()).unwrap();
    let truth = at(1.1);
    let direction = |pose: &Isometry3<f64>| Unit::new_normalize(pose.translation.vector);
    // Standing still it would be 4 degrees off.
    let off = direction(&predicted.camera_from_markers).angle(&direction(&truth));
    assert!(off < 0.3f64.to_radians(), "{off}");
    assert!(predicted.camera_from_markers.rotation.angle_to(&truth.rotation) < 0.02);
    assert!((predicted.velocity - velocity).norm() < 0.03, "{}", predicted.velocity);
    assert!((predicted.rate - rate).norm() < 0.05, "{}", predicted.rate);
    // Farther ahead it is less sure.
    let later = track.predict(11.3, &motion(), &still()).unwrap().pose_covariance();
    assert!((0..6).all(|k| later[(k, k)] > predicted.pose_covariance()[(k, k)]));
    assert_eq!(track.predict(track.stamp_s, &motion(), &still()).unwrap(), track);
}

#[test]
fn outliers_leave_the_track_as_it_was() {
    let mut track = start(Isometry3::translation(1.0, 0.0, 0.0));
    for frame in 1..=10 {
        let stamp_s = 10.0 + f64::from(frame) / 30.0;
        track
            .update(
                stamp_s,
                &found(Isometry3::translation(1.0, 0.0, 0.0)),
                GATE,
                &motion(),
                &still(),
            )
            .unwrap();
    }
    let before = track.clone();
    let stamp_s = 10.0 + 11.0 / 30.0;
    let mirrored = Isometry3::from_parts(
        Vector3::new(1.0, 0.0, 0.0).into(),
        UnitQuaternion::from_euler_angles(0.0, 0.9, 0.0),
    );
    for wrong in [mirrored, Isometry3::translation(1.5, 0.0, 0.0)] {
        let refused = track.update(stamp_s, &found(wrong), GATE, &motion(), &still()).unwrap_err();
        assert!(matches!(refused, FilterError::Gated { distance_squared, .. }
            if distance_squared > GATE));
        assert_eq!(track, before);
    }
    let right = measure(&Isometry3::translation(1.0, 0.0, 0.0), &mut Chance::new(3));
    assert!(track.update(stamp_s, &found(right), GATE, &motion(), &still()).is_ok());
}

#[test]
fn time_may_jump_without_harm() {
    let pose = Isometry3::translation(1.0, 0.0, 0.0);
    let mut track = start(pose);
    let before = track.clone();
    assert!(matches!(track.predict(9.9, &motion(), &still()), Err(FilterError::Past { .. })));
    assert!(matches!(track.predict(1e9, &motion(), &still()), Err(FilterError::Gap { .. })));
    assert!(matches!(
        track.predict(f64::NAN, &motion(), &still()),
        Err(FilterError::Unusable { .. })
    ));
    assert!(track.update(9.0, &found(pose), GATE, &motion(), &still()).is_err());
    assert!(track.update(f64::INFINITY, &found(pose), GATE, &motion(), &still()).is_err());
    let broken = Isometry3::translation(f64::NAN, 0.0, 0.0);
    assert!(track.update(10.1, &found(broken), GATE, &motion(), &still()).is_err());
    let exact = PoseEstimate { camera_from_markers: pose, covariance: Matrix6::zeros() };
    assert!(track.update(10.1, &exact, GATE, &motion(), &still()).is_err());
    assert_eq!(track, before);
    // Twice in one frame is once more knowledge, not more time.
    track.update(10.0, &found(pose), GATE, &motion(), &still()).unwrap();
    assert!(track.covariance[(0, 0)] < 0.6 * before.covariance[(0, 0)]);
}

fn life() -> LifeCycle {
    LifeCycle::new(TrackPolicy { confirm_hits: 3, ..TrackPolicy::default() })
}

/// A camera that yaws unevenly: how it turns from frame to frame of a flight at 30 frames/s.
fn yawing(frames: u32) -> Vec<CameraTurn> {
    let yaw = |at_s: f64| 1.2 * at_s + 0.3 * (4.0 * at_s).sin();
    let camera_from_world =
        |at_s: f64| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -yaw(at_s));
    (1..=frames)
        .map(|k| {
            let (earlier_s, later_s) = (10.0 + f64::from(k - 1) / 30.0, 10.0 + f64::from(k) / 30.0);
            CameraTurn {
                earlier_s,
                later_s,
                later_from_earlier: camera_from_world(later_s)
                    * camera_from_world(earlier_s).inverse(),
                covariance: Matrix3::from_diagonal_element(1e-8),
                rate_in_camera: Vector3::z() * (1.2 + 1.2 * (4.0 * later_s).cos()),
                ahead: None,
                rate_covariance: Matrix3::from_diagonal_element(1e-6),
            }
        })
        .collect()
}

/// What a camera that turned like this since the first turn sees of what stands still in the world.
fn seen_at(turns: &[CameraTurn], pose: &Isometry3<f64>) -> Isometry3<f64> {
    turns.iter().fold(*pose, |seen, turn| turn.later_from_earlier * seen)
}

#[test]
fn a_yaw_is_no_movement_of_the_neighbour() {
    let world = Isometry3::translation(1.5, 0.5, -0.2);
    let turns = yawing(40);
    let (mut ego, mut track) = (still(), start(world));
    for (k, turn) in turns.iter().enumerate() {
        ego.add(turn);
        let seen = seen_at(&turns[..=k], &world);
        track.update(turn.later_s, &found(seen), GATE, &motion(), &ego).unwrap();
    }
    let now = track.predict(turns[39].later_s, &motion(), &ego).unwrap();
    assert!(now.velocity.norm() < 1e-3 && now.rate.norm() < 1e-3, "{now:?}");
    // To the camera it moves past at the yaw rate times the distance.
    let expected = turns[39].rate_in_camera.norm() * 1.58;
    assert!((now.apparent_velocity().norm() - expected).abs() < 0.02 * expected);
    // The covariance of what the camera knows less well than it thinks grows across the line of
    // sight.
    let mut doubtful = turns[39];
    doubtful.covariance *= 1e4;
    let mut doubting = still();
    turns[..39].iter().chain([&doubtful]).for_each(|turn| doubting.add(turn));
    let earlier = turns[38].later_s;
    let mut before = start(world);
    for (k, turn) in turns[..39].iter().enumerate() {
        let seen = seen_at(&turns[..=k], &world);
        before.update(turn.later_s, &found(seen), GATE, &motion(), &ego).unwrap();
    }
    assert_eq!(before.stamp_s, earlier);
    let [sure, unsure] =
        [&ego, &doubting].map(|ego| before.predict(turns[39].later_s, &motion(), ego).unwrap());
    let sight = sure.camera_from_markers.translation.vector.normalize();
    let grown = (unsure.covariance - sure.covariance).fixed_view::<3, 3>(0, 0).into_owned();
    assert!((sight.transpose() * grown * sight)[0] < 1e-9, "a turn changes no distance");
    assert!((grown.trace() - 2.0 * 1e-4 * 1.58f64.powi(2)).abs() < 0.2 * grown.trace());
}

#[test]
fn a_turn_that_is_known_late_counts_as_if_known_in_time() {
    let world = Isometry3::translation(1.5, 0.5, -0.2);
    let turns = yawing(12);
    let (mut in_time, mut late) = (life(), life());
    let (mut ego, mut late_ego) = (still(), still());
    for (k, turn) in turns.iter().enumerate() {
        let seen = seen_at(&turns[..=k], &world);
        ego.add(turn);
        let measured =
            FrameMeasurement { pose: found(seen), rival: None, is_proven: false, jump: None };
        in_time.measured(turn.later_s, &measured, &ego).unwrap();
        late.measured(turn.later_s, &measured, &late_ego).unwrap();
        late_ego.add(turn);
        late.refilter(turn.earlier_s, &late_ego);
    }
    assert_eq!(in_time.track(), late.track());
}
