#![allow(clippy::unwrap_used, clippy::expect_used)]
use proptest::prelude::*;

use super::*;

fn header(frame_id: &str) -> Header {
    Header { stamp: Time { sec: 1_700_000_000, nanosec: 123 }, frame_id: frame_id.into() }
}

fn pose() -> PoseWithCovariance {
    let (position, orientation) = ([1.0, -2.0, 0.5], [0.0, 0.0, 0.6, 0.8]);
    let covariance =
        std::array::from_fn(|row| std::array::from_fn(|column| (6 * row + column) as f64 / 1024.0));
    PoseWithCovariance { position, orientation, covariance }
}

fn transform(child: &str) -> TransformStamped {
    TransformStamped {
        header: header("wren/base_link"),
        child_frame_id: child.into(),
        translation: [1.0, -2.0, 0.5],
        rotation: pose().orientation,
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The files were written by `rosbags`, an encoder of ROS messages in Python. The test of foreign
/// subscribers reads them too.
fn assert_golden<M: Ros2Message>(message: &M, golden: &str) {
    let golden: String = golden.split_whitespace().collect();
    assert_eq!(hex(&message.to_cdr().unwrap()), golden);
}

#[test]
fn a_pose_has_the_bytes_that_ros_reads() {
    let message = PoseWithCovarianceStamped { header: header("wren/base_link"), pose: pose() };
    assert_golden(&message, include_str!("../../tests/golden/pose.hex"));
}

#[test]
fn transforms_have_the_bytes_that_ros_reads() {
    let transforms = ["kite_seen_by_wren", "a_seen_by_wren"].map(transform).to_vec();
    assert_golden(&TfMessage { transforms }, include_str!("../../tests/golden/tf.hex"));
}

#[test]
fn odometry_has_the_bytes_that_ros_reads() {
    let velocity_covariance = std::array::from_fn(|row| {
        std::array::from_fn(|column| if row == column { 1e6 } else { 0.0 })
    });
    let message = OdometryMessage {
        header: header("kite/base_link"),
        child_frame_id: "wren/base_link".into(),
        pose: pose(),
        linear_velocity: [2.0, 0.0, 0.25],
        angular_velocity: [0.0, -0.5, 0.125],
        velocity_covariance,
    };
    assert_golden(&message, include_str!("../../tests/golden/odometry.hex"));
}

#[test]
fn times_are_rounded_down_and_bounded() {
    let time = |sec, nanosec| Some(Time { sec, nanosec });
    assert_eq!(Time::from_utc_ns(1_700_000_000_000_000_123), time(1_700_000_000, 123));
    assert_eq!(Time::from_utc_ns(-1), time(-1, 999_999_999));
    assert_eq!(Time::from_utc_ns(i64::from(i32::MAX) * 1_000_000_000), time(i32::MAX, 0));
    assert_eq!(Time::from_utc_ns((i64::from(i32::MAX) + 1) * 1_000_000_000), None);
    assert_eq!(Time::from_utc_ns(i64::MIN), None);
}

/// CDR as its specification says it, to compare with.
struct Plain(Vec<u8>);

impl Plain {
    fn number<const SIZE: usize>(&mut self, bytes: [u8; SIZE]) {
        // Alignment counts from after the four bytes of the header.
        while !(self.0.len() - 4).is_multiple_of(SIZE) {
            self.0.push(0);
        }
        self.0.extend(bytes);
    }

    fn text(&mut self, text: &str) {
        self.number((text.len() as u32 + 1).to_le_bytes());
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }
}

proptest! {
    #[test]
    fn whatever_the_names_are_everything_is_aligned(
        names in proptest::collection::vec(("[a-z_/]{0,40}", "[a-z_/]{0,40}"), 0..8),
        sec in any::<i32>(),
        nanosec in 0..1_000_000_000_u32,
        values in any::<[f64; 7]>(),
    ) {
        let [x, y, z, rx, ry, rz, rw] = values;
        let transforms = names.iter().map(|(frame, child)| TransformStamped {
            header: Header { stamp: Time { sec, nanosec }, frame_id: frame.clone() },
            child_frame_id: child.clone(),
            translation: [x, y, z],
            rotation: [rx, ry, rz, rw],
        });
        let mut plain = Plain(vec![0, 1, 0, 0]);
        plain.number((names.len() as u32).to_le_bytes());
        for (frame, child) in &names {
            plain.number(sec.to_le_bytes());
            plain.number(nanosec.to_le_bytes());
            plain.text(frame);
            plain.text(child);
            values.iter().for_each(|value| plain.number(value.to_le_bytes()));
        }
        let message = TfMessage { transforms: transforms.collect() };
        prop_assert_eq!(message.to_cdr().unwrap(), plain.0);
    }
}
