//! All targets of one frame, with what swarms need to combine what they hear.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::number::{check_covariance, check_finite, check_rotation, to_digits, to_millionths};
use super::{MAX_TARGETS, WireError, is_name, shortened};
use crate::{MeasuredBy, TrackState};

/// The value of [`FrameReport::schema`] that this crate writes and understands.
pub const FRAME_SCHEMA: &str = "flockeye.frame/2";

/// One radio packet: the most that a report may have for each target.
pub const MAX_TARGET_BYTES: usize = 1_200;

/// The most that a frame report may have: one packet for each target, and 8 kB for what they share.
pub const MAX_FRAME_REPORT_BYTES: usize = MAX_TARGETS * MAX_TARGET_BYTES + 8_192;

/// One observer's report on all it saw at one exposure.
///
/// A frame in which nobody is seen is reported too, at most once a second, so that "I see nobody" differs
/// from "nothing is heard of me".
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FrameReport {
    /// [`FRAME_SCHEMA`]. Readers refuse another number and ignore unknown fields.
    pub schema: String,
    /// The observer's name.
    pub observer: String,
    /// The frame's number in its epoch.
    pub frame: u64,
    /// The source's epoch.
    pub epoch: u32,
    /// Mid-exposure, nanoseconds since the Unix epoch, by the observer's clock.
    pub stamp_utc_ns: i64,
    /// Whether the observer's clock is synchronised with UTC.
    pub clock_synchronised: bool,
    /// Mid-exposure in the source's own time, seconds.
    pub stream_s: f64,
    /// Exposure to the moment this report was handed to the network.
    pub latency_ms: f64,
    /// Where the observer was at the exposure by its own odometry, where it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub odometry: Option<Odometry>,
    /// How the clocks of the peers that the observer hears differ from its own, by the peers' names. About
    /// once a second; else left out.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub clocks: BTreeMap<String, ClockOffset>,
    /// The targets, each once.
    pub targets: Vec<TargetReport>,
}

/// A pose by the observer's own dead reckoning, in a frame that it began with (REP-105's `odom`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Odometry {
    /// Position of the observer in that frame (x east or forward, z up), metres.
    pub position: [f64; 3],
    /// Orientation, that frame from observer, quaternion x y z w.
    pub orientation: [f64; 4],
    /// Deviations of position along the frame's axes (m) and of the rotation vector (rad), where they are known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deviations: Option<[f64; 6]>,
    /// Velocity along the observer's axes, m/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity along the observer's axes, rad/s.
    pub angular_velocity: [f64; 3],
}

/// How a peer's clock differs from the observer's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClockOffset {
    /// The shortest time from sending, by the peer's clock, to arrival, by the observer's, of late. With the
    /// same from the peer it gives the offset without a guess at the time on the air (as in NTP, RFC 5905).
    pub one_way_ms: f64,
    /// The peer's clock less the observer's, as estimated.
    pub offset_ms: f64,
    /// Standard deviation of `offset_ms`.
    pub deviation_ms: f64,
}

/// What one frame says of one target.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TargetReport {
    /// The target's name.
    #[serde(rename = "target")]
    pub name: String,
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
    /// Covariance of position and rotation vector in the observer's frame: the upper triangle of the 6x6
    /// matrix, row by row. Where there is a rival, it covers both poses.
    pub covariance: [f64; 21],
    /// Velocity relative to the observer, along its axes, m/s; its own rotation is taken out where it is
    /// known.
    pub linear_velocity: [f64; 3],
    /// Angular velocity, the same, rad/s.
    pub angular_velocity: [f64; 3],
    /// This frame's own measurement, which no earlier frame is part of; where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured: Option<Measurement>,
    /// Another pose that the target may have instead of the filtered one: the track is ambiguous. Nothing
    /// is measured then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rival: Option<Rival>,
    /// The filtered pose, predicted to about when this was sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted: Option<Predicted>,
    /// In which directions next to nothing is known of the pose; left out where there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub degenerate: Option<Degenerate>,
}

/// A pose measured in one frame alone.
///
/// Its errors are independent of those of other observers. They are independent of those of other frames, too,
/// apart from errors of video codecs and of the observer's lens model. So measurements may be combined by their
/// covariances. Filtered poses may not: they share what the filter assumes of motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Measurement {
    /// As [`TargetReport::position`].
    pub position: [f64; 3],
    /// As [`TargetReport::orientation`].
    pub orientation: [f64; 4],
    /// As [`TargetReport::covariance`].
    pub covariance: [f64; 21],
}

/// A pose that is possible beside the filtered one, for example the mirror pose of a flat marker. If one of
/// the two is true, the other is false.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Rival {
    /// As [`TargetReport::position`].
    pub position: [f64; 3],
    /// As [`TargetReport::orientation`].
    pub orientation: [f64; 4],
    /// Covariance of this pose alone, as [`TargetReport::covariance`].
    pub covariance: [f64; 21],
    /// Log odds of the filtered pose against this one, at least 0. Its probability is 1 / (1 + e^lead).
    pub lead: f64,
}

/// A pose foreseen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Predicted {
    /// So long after the exposure, seconds.
    pub after_s: f64,
    /// Position in the observer's frame of then, metres.
    pub position: [f64; 3],
    /// Orientation, observer (of then) from target.
    pub orientation: [f64; 4],
    /// Deviations of position along the observer's axes (m) and of the rotation vector (rad).
    pub deviations: [f64; 6],
}

/// Directions in which a pose is so uncertain that its covariance no longer describes it.
///
/// A covariance speaks of small errors. Along these directions the deviation is above a fifth of the distance
/// (m), or half a radian, where the terms that it leaves out are no longer small.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Degenerate {
    /// Unit vector in the observer's frame along which the position is uncertain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position: Option<[f64; 3]>,
    /// Unit vector in the observer's frame about which the orientation is uncertain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<[f64; 3]>,
}

/// One target of a report, with what the report says of its frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sighting {
    /// The report's schema.
    pub schema: String,
    /// The observer's name.
    pub observer: String,
    /// The frame's number in its epoch.
    pub frame: u64,
    /// The source's epoch.
    pub epoch: u32,
    /// Mid-exposure, nanoseconds since the Unix epoch, by the observer's clock.
    pub stamp_utc_ns: i64,
    /// Whether the observer's clock is synchronised with UTC.
    pub clock_synchronised: bool,
    /// Mid-exposure in the source's own time, seconds.
    pub stream_s: f64,
    /// Exposure to the moment the report was handed to the network.
    pub latency_ms: f64,
    /// The target.
    #[serde(flatten)]
    pub target: TargetReport,
}

impl FrameReport {
    /// When the report was handed to the network, by the observer's clock, nanoseconds since 1970.
    pub fn sent_utc_ns(&self) -> i64 {
        self.stamp_utc_ns.saturating_add((self.latency_ms * 1e6) as i64)
    }

    /// One sighting for each target.
    pub fn sightings(self) -> impl Iterator<Item = Sighting> {
        let Self { schema, observer, frame, epoch, stamp_utc_ns, clock_synchronised, .. } = self;
        let (stream_s, latency_ms) = (self.stream_s, self.latency_ms);
        self.targets.into_iter().map(move |target| Sighting {
            schema: schema.clone(),
            observer: observer.clone(),
            frame,
            epoch,
            stamp_utc_ns,
            clock_synchronised,
            stream_s,
            latency_ms,
            target,
        })
    }

    /// The report as it goes over the network. Lengths and angles are rounded to millionths, covariances to
    /// three digits.
    ///
    /// # Errors
    /// [`WireError::TooLong`] where a target takes more than one packet, or all more than
    /// [`MAX_FRAME_REPORT_BYTES`].
    pub fn to_json(&self) -> Result<Vec<u8>, WireError> {
        let mut rounded = self.clone();
        rounded.latency_ms = to_digits(self.latency_ms, 7);
        if let Some(odometry) = &mut rounded.odometry {
            odometry.round();
        }
        for clock in rounded.clocks.values_mut() {
            let ClockOffset { one_way_ms, offset_ms, deviation_ms } = clock;
            *one_way_ms = (*one_way_ms * 1e3).round() / 1e3;
            *offset_ms = (*offset_ms * 1e3).round() / 1e3;
            *deviation_ms = to_digits(*deviation_ms, 3);
        }
        for target in &mut rounded.targets {
            target.round();
            let found = serde_json::to_vec(target)?.len();
            if found > MAX_TARGET_BYTES {
                return Err(WireError::TooLong { found, most: MAX_TARGET_BYTES });
            }
        }
        let json = serde_json::to_vec(&rounded)?;
        if json.len() > MAX_FRAME_REPORT_BYTES {
            return Err(WireError::TooLong { found: json.len(), most: MAX_FRAME_REPORT_BYTES });
        }
        Ok(json)
    }

    /// Reads a report of untrusted origin.
    ///
    /// # Errors
    /// See [`WireError`].
    pub fn from_json(bytes: &[u8]) -> Result<Self, WireError> {
        if bytes.len() > MAX_FRAME_REPORT_BYTES {
            return Err(WireError::TooLong { found: bytes.len(), most: MAX_FRAME_REPORT_BYTES });
        }
        let report: Self = serde_json::from_slice(bytes)?;
        if report.schema != FRAME_SCHEMA {
            let found = shortened(&report.schema);
            return Err(WireError::Schema { found, wanted: FRAME_SCHEMA });
        }
        if report.targets.len() > MAX_TARGETS || report.clocks.len() > MAX_TARGETS {
            let found = report.targets.len().max(report.clocks.len());
            return Err(WireError::TooManyTargets { found });
        }
        check_finite("time", &[report.latency_ms, report.stream_s])?;
        if let Some(odometry) = &report.odometry {
            odometry.check()?;
        }
        for (peer, clock) in &report.clocks {
            check_name(peer)?;
            check_finite("clock", &[clock.one_way_ms, clock.offset_ms, clock.deviation_ms])?;
        }
        let mut names = BTreeSet::new();
        for target in &report.targets {
            target.check()?;
            if !names.insert(&target.name) {
                return Err(WireError::Twice { target: target.name.clone() });
            }
        }
        Ok(report)
    }
}

impl Odometry {
    fn round(&mut self) {
        let numbers = self.position.iter_mut().chain(&mut self.orientation);
        numbers
            .chain(&mut self.linear_velocity)
            .chain(&mut self.angular_velocity)
            .for_each(millionths);
        self.deviations.iter_mut().flatten().for_each(three_digits);
    }

    fn check(&self) -> Result<(), WireError> {
        check_finite("odometry", &self.position)?;
        check_rotation("odometry", &self.orientation)?;
        check_finite(
            "odometry",
            self.deviations.as_ref().map_or(&[], |deviations| &deviations[..]),
        )?;
        check_finite("odometry", &self.linear_velocity)?;
        check_finite("odometry", &self.angular_velocity)
    }
}

impl TargetReport {
    fn round(&mut self) {
        self.unseen_s = to_digits(self.unseen_s, 7);
        let numbers = self.position.iter_mut().chain(&mut self.orientation);
        numbers
            .chain(&mut self.linear_velocity)
            .chain(&mut self.angular_velocity)
            .for_each(millionths);
        self.covariance.iter_mut().for_each(three_digits);
        if let Some(measured) = &mut self.measured {
            measured.position.iter_mut().chain(&mut measured.orientation).for_each(millionths);
            measured.covariance.iter_mut().for_each(three_digits);
        }
        if let Some(rival) = &mut self.rival {
            rival.position.iter_mut().chain(&mut rival.orientation).for_each(millionths);
            rival.covariance.iter_mut().for_each(three_digits);
            three_digits(&mut rival.lead);
        }
        if let Some(predicted) = &mut self.predicted {
            predicted.position.iter_mut().chain(&mut predicted.orientation).for_each(millionths);
            predicted.deviations.iter_mut().for_each(three_digits);
            millionths(&mut predicted.after_s);
        }
        if let Some(degenerate) = &mut self.degenerate {
            let directions = degenerate.position.iter_mut().chain(&mut degenerate.rotation);
            directions.flatten().for_each(three_digits);
        }
    }

    fn check(&self) -> Result<(), WireError> {
        check_name(&self.name)?;
        check_finite("position", &self.position)?;
        check_rotation("orientation", &self.orientation)?;
        check_covariance("covariance", &self.covariance)?;
        check_finite("velocity", &self.linear_velocity)?;
        check_finite("velocity", &self.angular_velocity)?;
        check_finite("time", &[self.unseen_s])?;
        if let Some(measured) = &self.measured {
            check_finite("measured position", &measured.position)?;
            check_rotation("measured orientation", &measured.orientation)?;
            check_covariance("measured covariance", &measured.covariance)?;
        }
        if let Some(rival) = &self.rival {
            check_finite("rival's position", &rival.position)?;
            check_rotation("rival's orientation", &rival.orientation)?;
            check_covariance("rival's covariance", &rival.covariance)?;
            check_finite("rival's lead", &[rival.lead])?;
        }
        if let Some(predicted) = &self.predicted {
            check_finite("predicted position", &predicted.position)?;
            check_rotation("predicted orientation", &predicted.orientation)?;
            check_finite("predicted deviations", &predicted.deviations)?;
            check_finite("predicted time", &[predicted.after_s])?;
        }
        Ok(())
    }
}

fn check_name(name: &str) -> Result<(), WireError> {
    if is_name(name) { Ok(()) } else { Err(WireError::Name { found: shortened(name) }) }
}

fn millionths(x: &mut f64) {
    *x = to_millionths(*x);
}

fn three_digits(x: &mut f64) {
    *x = to_digits(*x, 3);
}
