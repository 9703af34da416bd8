//! One target at one exposure: what readers of the first schema understand. Nothing is added to it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::number::{check_covariance, check_finite, check_rotation, to_digits};
use super::{WireError, shortened};
use crate::{MeasuredBy, TrackState};

/// The value of [`PoseReport::schema`] that this crate writes and understands.
pub const POSE_SCHEMA: &str = "flockeye.pose/1";

/// One radio packet: the most that a report on one target may have.
pub const MAX_REPORT_BYTES: usize = 1_200;

/// One observer's report on one target at one exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
        numbers.for_each(|x| *x = to_digits(*x, 7));
        rounded.covariance.iter_mut().for_each(|x| *x = to_digits(*x, 4));
        let json = serde_json::to_vec(&rounded)?;
        if json.len() > MAX_REPORT_BYTES {
            return Err(WireError::TooLong { found: json.len(), most: MAX_REPORT_BYTES });
        }
        Ok(json)
    }

    /// Reads a report of untrusted origin.
    ///
    /// # Errors
    /// See [`WireError`].
    pub fn from_json(bytes: &[u8]) -> Result<Self, WireError> {
        if bytes.len() > MAX_REPORT_BYTES {
            return Err(WireError::TooLong { found: bytes.len(), most: MAX_REPORT_BYTES });
        }
        let report: Self = serde_json::from_slice(bytes)?;
        if report.schema != POSE_SCHEMA {
            return Err(WireError::Schema {
                found: shortened(&report.schema),
                wanted: POSE_SCHEMA,
            });
        }
        check_finite("position", &report.position)?;
        check_rotation("orientation", &report.orientation)?;
        check_covariance("covariance", &report.covariance)?;
        check_finite("velocity", &report.linear_velocity)?;
        check_finite("velocity", &report.angular_velocity)?;
        check_finite("time", &[report.latency_ms, report.unseen_s, report.stream_s])?;
        Ok(report)
    }
}
