//! What goes over the network: JSON that any language reads, at most [`MAX_REPORT_BYTES`] long.
//!
//! `docs/PEERS.md` describes the same for authors of subscribers.

use serde::{Deserialize, Serialize};

use crate::{MeasuredBy, TrackState};

/// The value of [`PoseReport::schema`] that this crate writes and understands.
pub const POSE_SCHEMA: &str = "flockeye.pose/1";

/// One radio packet.
pub const MAX_REPORT_BYTES: usize = 1_200;

/// Most characters of a swarm's, an observer's or a target's name.
pub const MAX_NAME_CHARS: usize = 31;

/// One observer's report on one target at one exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseReport {
    /// [`POSE_SCHEMA`]. Readers refuse another major number and ignore unknown fields.
    pub schema: String,
    /// The observer's name.
    pub observer: String,
    /// The target's name.
    pub target: String,
    /// The frame's number in its epoch.
    pub frame: u64,
    /// The source's epoch.
    pub epoch: u32,
    /// Mid-exposure, nanoseconds since the Unix epoch, by the observer's clock.
    pub stamp_utc_ns: i64,
    /// Whether the observer's clock is synchronised with UTC. If not, count freshness from the
    /// arrival of the report plus `latency_ms`.
    pub clock_synchronised: bool,
    /// Mid-exposure in the source's own time, seconds.
    pub stream_s: f64,
    /// Exposure to the moment this report was handed to the network.
    pub latency_ms: f64,
    /// State of the track.
    pub state: TrackState,
    /// What this frame's measurement was made from.
    pub measured_by: MeasuredBy,
    /// Markers decoded in this frame.
    pub markers: u32,
    /// Time since the target was last measured, seconds.
    pub unseen_s: f64,
    /// Filtered position of the target in the observer's frame (x forward, y left, z up), metres.
    pub position: [f64; 3],
    /// Filtered orientation, observer from target, quaternion x y z w.
    pub orientation: [f64; 4],
    /// Covariance of position and rotation vector in the observer's frame: the upper triangle of
    /// the 6x6 matrix, row by row.
    pub covariance: [f64; 21],
    /// Velocity relative to the observer, along its axes, m/s; its own rotation is taken out where it is
    /// known.
    pub linear_velocity: [f64; 3],
    /// Angular velocity, the same, rad/s.
    pub angular_velocity: [f64; 3],
}

/// Why a report from the network was refused.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// Longer than any report may be.
    #[error("a report of {found} bytes (at most {MAX_REPORT_BYTES})")]
    TooLong {
        /// Its length.
        found: usize,
    },
    /// Not JSON, or not of this form.
    #[error("not a pose report: {0}")]
    Json(#[from] serde_json::Error),
    /// A schema that this version does not know.
    #[error("schema '{found}' instead of '{POSE_SCHEMA}'")]
    Schema {
        /// What it says.
        found: String,
    },
    /// Invalid numbers.
    #[error("{what} is not finite or not a rotation")]
    Number {
        /// Which.
        what: &'static str,
    },
}

impl PoseReport {
    /// The report as it goes over the network. Numbers carry seven significant digits.
    ///
    /// # Errors
    /// [`WireError::TooLong`] where names make it longer than one packet.
    pub fn to_json(&self) -> Result<Vec<u8>, WireError> {
        let mut rounded = self.clone();
        let numbers = rounded
            .position
            .iter_mut()
            .chain(&mut rounded.orientation)
            .chain(&mut rounded.linear_velocity)
            .chain(&mut rounded.angular_velocity)
            .chain([&mut rounded.latency_ms, &mut rounded.unseen_s]);
        numbers.for_each(|x| *x = round_to(*x, 7));
        rounded.covariance.iter_mut().for_each(|x| *x = round_to(*x, 4));
        let json = serde_json::to_vec(&rounded)?;
        if json.len() > MAX_REPORT_BYTES {
            return Err(WireError::TooLong { found: json.len() });
        }
        Ok(json)
    }

    /// Reads a report of untrusted origin.
    ///
    /// # Errors
    /// See [`WireError`].
    pub fn from_json(bytes: &[u8]) -> Result<Self, WireError> {
        if bytes.len() > MAX_REPORT_BYTES {
            return Err(WireError::TooLong { found: bytes.len() });
        }
        let report: Self = serde_json::from_slice(bytes)?;
        if report.schema != POSE_SCHEMA {
            return Err(WireError::Schema { found: report.schema });
        }
        if !report.position.iter().all(|x| x.is_finite()) {
            return Err(WireError::Number { what: "position" });
        }
        let norm = report.orientation.iter().map(|q| q * q).sum::<f64>().sqrt();
        // NaN compares false, so it is refused here too.
        let is_unit = (norm - 1.0).abs() < 1e-3;
        if !is_unit {
            return Err(WireError::Number { what: "orientation" });
        }
        Ok(report)
    }
}

/// `x` with `digits` significant decimal digits, which keeps the JSON short.
fn round_to(x: f64, digits: i32) -> f64 {
    if x == 0.0 || !x.is_finite() {
        return x;
    }
    let scale = 10f64.powi(digits - 1 - x.abs().log10().floor() as i32);
    if scale.is_finite() && scale > 0.0 { (x * scale).round() / scale } else { x }
}

/// Key under which `observer` reports on `target`.
pub fn pose_key(swarm: &str, observer: &str, target: &str) -> String {
    format!("flockeye/{swarm}/{observer}/sees/{target}/pose")
}

/// Key of the liveliness token of `observer`.
pub fn alive_key(swarm: &str, observer: &str) -> String {
    format!("flockeye/{swarm}/{observer}/alive")
}

/// Key expression of all reports in `swarm`.
pub fn all_poses_key(swarm: &str) -> String {
    pose_key(swarm, "*", "*")
}

/// Key expression of all liveliness tokens in `swarm`.
pub fn all_alive_key(swarm: &str) -> String {
    alive_key(swarm, "*")
}

/// Whether `name` can stand in a key: letters, digits, `-`, `_` and `.`, 1 to 31 of them.
pub fn is_name(name: &str) -> bool {
    (1..=MAX_NAME_CHARS).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn worst_report() -> PoseReport {
        PoseReport {
            schema: POSE_SCHEMA.into(),
            observer: "o".repeat(MAX_NAME_CHARS),
            target: "t".repeat(MAX_NAME_CHARS),
            frame: u64::MAX,
            epoch: u32::MAX,
            stamp_utc_ns: i64::MIN,
            clock_synchronised: false,
            stream_s: -12345.678901234567,
            latency_ms: 1234.5678901234,
            state: TrackState::Confirmed,
            measured_by: MeasuredBy::Decoded,
            markers: u32::MAX,
            unseen_s: 1.2345678901234,
            position: [-1.234_567_890_123e-5; 3],
            orientation: [-0.5; 4],
            covariance: [-1.234_567_890_123e-12; 21],
            linear_velocity: [-1.234_567_890_123e-5; 3],
            angular_velocity: [-1.234_567_890_123e-5; 3],
        }
    }

    #[test]
    fn the_longest_report_fits_a_packet() {
        let json = worst_report().to_json().expect("fits");
        assert!(json.len() <= MAX_REPORT_BYTES, "{} bytes", json.len());
        let back = PoseReport::from_json(&json).expect("reads back");
        assert_eq!(back.frame, u64::MAX);
        assert!((back.covariance[3] / -1.234_567e-12 - 1.0).abs() < 1e-3);
    }

    #[test]
    fn the_wire_format_is_pinned() {
        let mut report = worst_report();
        (report.observer, report.target) = ("wren".into(), "kite".into());
        (report.frame, report.epoch, report.markers) = (7, 1, 3);
        let value: serde_json::Value =
            serde_json::from_slice(&report.to_json().expect("fits")).expect("is JSON");
        let keys: Vec<_> = value.as_object().expect("an object").keys().cloned().collect();
        assert_eq!(
            keys.join(" "),
            "schema observer target frame epoch stamp_utc_ns clock_synchronised stream_s latency_ms \
             state measured_by markers unseen_s position orientation covariance linear_velocity \
             angular_velocity"
        );
        assert_eq!(value["state"], "confirmed");
        assert_eq!(value["measured_by"], "decoded");
    }

    #[test]
    fn foreign_bytes_are_refused_with_their_reason() {
        let error = |bytes: &[u8]| PoseReport::from_json(bytes).expect_err("refused").to_string();
        assert!(error(b"\xff\xfe").starts_with("not a pose report"));
        assert!(error(&[b' '; 2000]).contains("2000 bytes"));
        let mut report = worst_report();
        report.schema = "flockeye.pose/9".into();
        assert!(error(&report.to_json().expect("fits")).contains("flockeye.pose/9"));
        let mut report = worst_report();
        report.orientation = [0.0; 4];
        assert!(error(&report.to_json().expect("fits")).contains("orientation"));
    }

    #[test]
    fn names_that_could_break_a_key_are_refused() {
        assert!(is_name("drone-1"));
        for name in ["", "a/b", "a*", "$", "ä", &"x".repeat(32)] {
            assert!(!is_name(name), "{name}");
        }
    }
}
