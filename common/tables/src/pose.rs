//! The rows of recorded poses.

use flockeye_contract::{FrameStamp, MeasuredBy, Track, TrackState};
use flockeye_convert::{matrix6, rotation};
use nalgebra::{Matrix6, UnitQuaternion, Vector3};
use serde::ser::{Serialize, Serializer};

use crate::table::{TableCells, TableError, TableRow, cells, triangle};
use crate::writer::WrittenRow;

/// A row of the poses: the target's pose in the observer's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseRow {
    /// The source's frame, from 0.
    pub frame: u64,
    /// Mid-exposure, stream time, seconds.
    pub stamp_s: f64,
    /// The neighbour's name.
    pub target: String,
    /// Position, metres.
    pub position: Vector3<f64>,
    /// Orientation.
    pub orientation: UnitQuaternion<f64>,
    /// The track's state; `coasting`: nothing was measured in this frame.
    pub state: TrackState,
    /// Markers decoded in this frame.
    pub markers: u32,
    /// The method of this frame's measurement.
    pub measured_by: MeasuredBy,
    /// This frame's own measurement of the same pose; `None` if there is none or it was not
    /// recorded.
    pub measured: Option<MeasuredPose>,
    /// Covariance of the pose: position (m), then rotation vector (rad), both in the observer's
    /// frame; `None` where it was not recorded.
    pub covariance: Option<Matrix6<f64>>,
    /// The pose predicted for the time of sending; `None` where it was not recorded.
    pub predicted: Option<PredictedPose>,
    /// Latency from the exposure (in a lossless run: from the frame's publication) to the pose's
    /// publication, ms.
    pub latency_ms: f64,
}

/// A frame's own measurement of the target's pose in the observer's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPose {
    /// Position, metres.
    pub position: Vector3<f64>,
    /// Orientation.
    pub orientation: UnitQuaternion<f64>,
    /// Covariance, in the same form as that of the track.
    pub covariance: Option<Matrix6<f64>>,
}

/// A pose predicted for another time, in the observer's frame at that time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedPose {
    /// Time of the prediction, stream time, seconds. In a lossless run it is the exposure time.
    pub at_s: f64,
    /// Position, metres.
    pub position: Vector3<f64>,
    /// Orientation.
    pub orientation: UnitQuaternion<f64>,
    /// Covariance, in the same form as that of the track.
    pub covariance: Matrix6<f64>,
}

/// The columns of a pose.
const POSE: [&str; 7] = ["px", "py", "pz", "qx", "qy", "qz", "qw"];
/// The columns of the frame's own measurement.
const MEASURED: [&str; 7] = ["mx", "my", "mz", "mqx", "mqy", "mqz", "mqw"];
/// The upper triangle of the pose's covariance, row by row.
const COVARIANCE: [&str; 21] = [
    "c00", "c01", "c02", "c03", "c04", "c05", "c11", "c12", "c13", "c14", "c15", "c22", "c23",
    "c24", "c25", "c33", "c34", "c35", "c44", "c45", "c55",
];
/// Columns of the measurement's covariance.
const MEASURED_COVARIANCE: [&str; 21] = [
    "m00", "m01", "m02", "m03", "m04", "m05", "m11", "m12", "m13", "m14", "m15", "m22", "m23",
    "m24", "m25", "m33", "m34", "m35", "m44", "m45", "m55",
];
/// The columns of the predicted pose.
const PREDICTED: [&str; 7] = [
    "predicted_x",
    "predicted_y",
    "predicted_z",
    "predicted_qx",
    "predicted_qy",
    "predicted_qz",
    "predicted_qw",
];
/// Columns of the prediction's covariance.
const PREDICTED_COVARIANCE: [&str; 21] = [
    "p00", "p01", "p02", "p03", "p04", "p05", "p11", "p12", "p13", "p14", "p15", "p22", "p23",
    "p24", "p25", "p33", "p34", "p35", "p44", "p45", "p55",
];

impl PoseRow {
    /// The row of a track; `None` if its state is an unknown code.
    pub fn of(stamp: &FrameStamp, track: &Track) -> Option<Self> {
        let measured_by = MeasuredBy::try_from(track.measured_by).ok()?;
        let measured = &track.measured_observer_from_target;
        let predicted = &track.predicted_observer_from_target;
        let stamp_s = stamp.stream_ns as f64 * 1e-9;
        Some(Self {
            frame: stamp.sequence,
            stamp_s,
            target: track.name.to_string(),
            position: track.observer_from_target.position.into(),
            orientation: rotation(track.observer_from_target.orientation),
            state: TrackState::try_from(track.state).ok()?,
            markers: track.markers,
            measured_by,
            measured: (measured_by != MeasuredBy::Nothing).then(|| MeasuredPose {
                position: measured.position.into(),
                orientation: rotation(measured.orientation),
                covariance: Some(matrix6(&track.measured_covariance)),
            }),
            covariance: Some(matrix6(&track.covariance)),
            predicted: Some(PredictedPose {
                at_s: stamp_s + (track.predicted_ns - stamp.exposure_ns) as f64 * 1e-9,
                position: predicted.position.into(),
                orientation: rotation(predicted.orientation),
                covariance: matrix6(&track.predicted_covariance),
            }),
            latency_ms: track.latency.total_ns as f64 * 1e-6,
        })
    }

    /// Whether the pose was measured in this frame.
    pub fn is_measured(&self) -> bool {
        self.measured_by != MeasuredBy::Nothing
    }
}

impl WrittenRow for PoseRow {
    fn names() -> Vec<&'static str> {
        let before = ["frame", "stamp_s", "target"].into_iter().chain(POSE);
        let own = before.chain(["state", "markers", "measured_by"]).chain(MEASURED);
        let own = own.chain(COVARIANCE).chain(MEASURED_COVARIANCE).chain(["latency_ms"]);
        own.chain(["predicted_s"]).chain(PREDICTED).chain(PREDICTED_COVARIANCE).collect()
    }
}

impl Serialize for PoseRow {
    /// The cells, in the order of their columns' names.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let numbers = |position: &Vector3<f64>, orientation: &UnitQuaternion<f64>| -> [f64; 7] {
            let [x, y, z] = (*position).into();
            let [qx, qy, qz, qw] = orientation.coords.into();
            [x, y, z, qx, qy, qz, qw]
        };
        let covariance = |covariance: Option<Matrix6<f64>>| -> [Option<f64>; 21] {
            cells(covariance.as_ref().map(triangle))
        };
        let (measured, predicted) = (self.measured.as_ref(), self.predicted.as_ref());
        let row = (
            self.frame,
            self.stamp_s,
            &self.target,
            numbers(&self.position, &self.orientation),
            self.state,
            self.markers,
            self.measured_by,
            cells(measured.map(|pose| numbers(&pose.position, &pose.orientation))),
            covariance(self.covariance),
            covariance(measured.and_then(|pose| pose.covariance)),
            self.latency_ms,
            predicted.map(|pose| pose.at_s),
            cells(predicted.map(|pose| numbers(&pose.position, &pose.orientation))),
            covariance(predicted.map(|pose| pose.covariance)),
        );
        row.serialize(serializer)
    }
}

impl TableRow for PoseRow {
    const REQUIRED: &'static str =
        "frame,stamp_s,target,px,py,pz,qx,qy,qz,qw,state,markers,latency_ms";
    const CURE: &'static str = "record the poses with flockeye up --poses";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        let state = cells.code(
            TrackState::ALL,
            "state",
            "tentative, confirmed, coasting, lost or measured",
        )?;
        let measured_by = match cells.text("measured_by") {
            // A file without this column: the state shows whether the pose was measured.
            "" if matches!(state, TrackState::Coasting | TrackState::Lost) => MeasuredBy::Nothing,
            "" => MeasuredBy::Decoded,
            _ => cells.code(MeasuredBy::ALL, "measured_by", "nothing, decoded or aligned")?,
        };
        let [px, py, pz, qx, qy, qz, qw] = POSE;
        Ok(Self {
            frame: cells.count("frame")?,
            stamp_s: cells.number("stamp_s")?,
            target: cells.text("target").to_owned(),
            position: Vector3::new(cells.number(px)?, cells.number(py)?, cells.number(pz)?),
            orientation: cells.rotation([qx, qy, qz, qw])?,
            state,
            markers: cells.small_count("markers")?,
            measured_by,
            measured: measured(cells)?,
            covariance: covariance(cells, COVARIANCE)?,
            predicted: predicted(cells)?,
            latency_ms: cells.number("latency_ms")?,
        })
    }
}

fn measured(cells: &TableCells<'_>) -> Result<Option<MeasuredPose>, TableError> {
    if MEASURED.iter().all(|column| cells.text(column).is_empty()) {
        return Ok(None);
    }
    let [x, y, z, qx, qy, qz, qw] = MEASURED;
    Ok(Some(MeasuredPose {
        position: Vector3::new(cells.number(x)?, cells.number(y)?, cells.number(z)?),
        orientation: cells.rotation([qx, qy, qz, qw])?,
        covariance: covariance(cells, MEASURED_COVARIANCE)?,
    }))
}

fn predicted(cells: &TableCells<'_>) -> Result<Option<PredictedPose>, TableError> {
    let (Some(at_s), Some(covariance)) =
        (cells.maybe_number("predicted_s")?, covariance(cells, PREDICTED_COVARIANCE)?)
    else {
        return Ok(None);
    };
    let [x, y, z, qx, qy, qz, qw] = PREDICTED;
    Ok(Some(PredictedPose {
        at_s,
        position: Vector3::new(cells.number(x)?, cells.number(y)?, cells.number(z)?),
        orientation: cells.rotation([qx, qy, qz, qw])?,
        covariance,
    }))
}

fn covariance(
    cells: &TableCells<'_>,
    names: [&str; 21],
) -> Result<Option<Matrix6<f64>>, TableError> {
    if names.iter().all(|column| cells.text(column).is_empty()) {
        return Ok(None);
    }
    cells.symmetric(&names).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::read;
    use bytemuck::Zeroable;
    use flockeye_contract::Pose;
    use nalgebra::Vector6;

    fn file(name: &str, text: &[u8]) -> std::path::PathBuf {
        let path = std::env::temp_dir().join(format!("flockeye-{}-{name}.csv", std::process::id()));
        std::fs::write(&path, text).expect("it can be written");
        path
    }

    fn written(rows: &[PoseRow]) -> Vec<u8> {
        let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(Vec::new());
        writer.write_record(PoseRow::names()).expect("memory is there");
        for row in rows {
            writer.serialize(row).expect("memory is there");
        }
        writer.into_inner().expect("flushed")
    }

    fn track(measured_by: MeasuredBy) -> Track {
        let spread = |scale: f64| {
            let mut matrix =
                Matrix6::from_diagonal(&Vector6::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)) * scale;
            (matrix[(0, 4)], matrix[(4, 0)]) = (scale / 7.0, scale / 7.0);
            std::array::from_fn(|k| matrix[(k / 6, k % 6)])
        };
        Track {
            observer_from_target: Pose {
                position: [1.0, -2.0, 0.1],
                orientation: [0.5, 0.5, 0.5, 0.5],
            },
            covariance: spread(1e-5),
            measured_observer_from_target: Pose {
                position: [1.01, -2.0, 0.1],
                orientation: [0.0, 0.6, 0.0, 0.8],
            },
            measured_covariance: spread(1e-4),
            predicted_observer_from_target: Pose {
                position: [1.02, -2.0, 0.1],
                orientation: [0.0, 0.0, 0.6, 0.8],
            },
            predicted_covariance: spread(2e-5),
            predicted_ns: 25_000_000,
            name: "alpha".into(),
            state: TrackState::Confirmed.code(),
            measured_by: measured_by.code(),
            markers: 3,
            ..Track::zeroed()
        }
    }

    #[test]
    fn poses_have_the_promised_columns() {
        let row = PoseRow::of(&FrameStamp::default(), &track(MeasuredBy::Nothing));
        let text = String::from_utf8(written(&[row.expect("known codes")])).expect("text");
        let wanted = "frame,stamp_s,target,px,py,pz,qx,qy,qz,qw,state,markers,measured_by,\
                      mx,my,mz,mqx,mqy,mqz,mqw,\
                      c00,c01,c02,c03,c04,c05,c11,c12,c13,c14,c15,c22,c23,c24,c25,c33,c34,c35,c44,\
                      c45,c55,\
                      m00,m01,m02,m03,m04,m05,m11,m12,m13,m14,m15,m22,m23,m24,m25,m33,m34,m35,m44,\
                      m45,m55,latency_ms,predicted_s,predicted_x,predicted_y,predicted_z,\
                      predicted_qx,predicted_qy,predicted_qz,predicted_qw,\
                      p00,p01,p02,p03,p04,p05,p11,p12,p13,p14,p15,p22,p23,p24,p25,p33,p34,p35,p44,\
                      p45,p55";
        assert_eq!(text.lines().next(), Some(wanted));
        assert_eq!(PoseRow::names().join(","), wanted);
        assert!(text.contains(",confirmed,3,nothing,,,,,,,,"), "{text}");
        assert_eq!(wanted.split(',').count(), 92);
    }

    #[test]
    fn what_was_written_is_read_again() {
        let rows: Vec<PoseRow> = MeasuredBy::ALL
            .iter()
            .filter_map(|by| PoseRow::of(&FrameStamp::default(), &track(*by)))
            .collect();
        let path = file("again", &written(&rows));
        assert_eq!(read::<PoseRow>(&path).expect("they are right"), rows);
        std::fs::remove_file(path).expect("it can be removed");
        let covariance = rows[1].measured.and_then(|measured| measured.covariance);
        let covariance = covariance.expect("it was measured");
        assert_eq!((covariance[(1, 1)], covariance[(4, 0)]), (2e-4, 1e-4 / 7.0));
        let predicted = rows[0].predicted.expect("it was recorded");
        assert_eq!((predicted.at_s, predicted.position.x), (0.025, 1.02));
        assert_eq!(predicted.covariance[(4, 0)], 2e-5 / 7.0);
    }

    #[test]
    fn recordings_without_the_newer_columns_are_read() {
        let header = "frame,stamp_s,target,px,py,pz,qx,qy,qz,qw,state,markers,latency_ms\n";
        let row = |state: &str| format!("7,0.2,alpha,1,2,3,0,0,0,1,{state},2,12.5\n");
        let text = format!("{header}{}{}", row("confirmed"), row("coasting"));
        let path = file("old", text.as_bytes());
        let rows: Vec<PoseRow> = read(&path).expect("they are right");
        assert_eq!(rows.iter().map(PoseRow::is_measured).collect::<Vec<_>>(), [true, false]);
        assert_eq!((rows[0].measured, rows[0].covariance), (None, None));
        assert_eq!(rows[0].predicted, None);
        for (wrong, wanted) in [
            (row("unsure"), "column state: 'unsure' is not tentative, confirmed"),
            (row("lost").replace("0,0,0,1,", "0,0,0,0,"), "column qw: '0' is not the w of a"),
            (row("lost").replace(",2,12.5", ",two,12.5"), "column markers: 'two' is not a whole"),
        ] {
            std::fs::write(&path, format!("{header}{wrong}")).expect("it can be written");
            let error = read::<PoseRow>(&path).expect_err("it is wrong").to_string();
            assert!(error.contains("line 2, ") && error.contains(wanted), "{error}");
        }
        std::fs::remove_file(path).expect("it can be removed");
    }
}
