//! The rows of the camera's recorded rotation.

use flockeye_contract::{FrameStamp, Rotation, RotationSource};
use flockeye_convert::camera_turn;
use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use serde::ser::{Serialize, Serializer};

use crate::table::{TableCells, TableError, TableRow, cells, triangle};
use crate::writer::WrittenRow;

/// A row of the rotations: how the camera has turned to one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct RotationRow {
    /// The source's frame, from 0.
    pub frame: u64,
    /// Mid-exposure, stream time, seconds.
    pub stamp_s: f64,
    /// Mid-exposure on the frames' clock, seconds since the stream of the run's first frame began.
    /// It differs from `stamp_s` if frames arrive less evenly than they were exposed.
    pub exposure_s: f64,
    /// The rotation; `None` if it is not known.
    pub turn: Option<RecordedTurn>,
}

/// A rotation that is known.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedTurn {
    /// The sensor that measured the rotation.
    pub source: RotationSource,
    /// Exposure of the earlier frame, stream time, seconds.
    pub earlier_s: f64,
    /// Exposure of the earlier frame on the clock of `exposure_s`.
    pub earlier_exposure_s: f64,
    /// Turns directions from the camera frame at the earlier exposure into that at this exposure.
    pub later_from_earlier: UnitQuaternion<f64>,
    /// Covariance of the rotation vector in the camera frame at this exposure, rad^2.
    pub covariance: Matrix3<f64>,
    /// The camera's own angular velocity at the exposure, in its own axes, rad/s.
    pub rate_in_camera: Vector3<f64>,
    /// Covariance of the rate, (rad/s)^2.
    pub rate_covariance: Matrix3<f64>,
}

const ROTATION: [&str; 4] = ["qx", "qy", "qz", "qw"];
/// The upper triangle of the rotation's covariance, row by row.
const COVARIANCE: [&str; 6] = ["c00", "c01", "c02", "c11", "c12", "c22"];
const RATE: [&str; 3] = ["rx", "ry", "rz"];
/// Columns of the rate's covariance.
const RATE_COVARIANCE: [&str; 6] = ["r00", "r01", "r02", "r11", "r12", "r22"];

impl RotationRow {
    /// The row of a rotation. `before` is the stamp of the rotation before it. If the rotation was
    /// measured from that frame, the earlier stream time is taken from it. `zero_ns` is the frames'
    /// clock when the stream of the run's first frame began.
    pub fn of(rotation: &Rotation, before: Option<&FrameStamp>, zero_ns: i64) -> Self {
        let stamp = &rotation.stamp;
        let since_zero_s = |at_ns: i64| at_ns.saturating_sub(zero_ns) as f64 * 1e-9;
        let stamp_s = stamp.stream_ns as f64 * 1e-9;
        let turn = camera_turn(rotation).map(|turn| {
            let earlier_ns = rotation.earlier_exposure_ns;
            let from = before.filter(|before| before.exposure_ns == earlier_ns);
            let passed_s = stamp.exposure_ns.saturating_sub(earlier_ns) as f64 * 1e-9;
            RecordedTurn {
                // Only `Nothing` has no turn, and an unknown code does not pass the contract's
                // check.
                source: RotationSource::try_from(rotation.source)
                    .unwrap_or(RotationSource::Nothing),
                earlier_s: from.map_or(stamp_s - passed_s, |from| from.stream_ns as f64 * 1e-9),
                earlier_exposure_s: since_zero_s(earlier_ns),
                later_from_earlier: turn.later_from_earlier,
                covariance: turn.covariance,
                rate_in_camera: turn.rate_in_camera,
                rate_covariance: turn.rate_covariance,
            }
        });
        let exposure_s = since_zero_s(stamp.exposure_ns);
        Self { frame: stamp.sequence, stamp_s, exposure_s, turn }
    }
}

impl WrittenRow for RotationRow {
    fn names() -> Vec<&'static str> {
        Self::REQUIRED.split(',').collect()
    }
}

impl Serialize for RotationRow {
    /// The cells, in the order of their columns' names.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let turn = self.turn.as_ref();
        let row = (
            self.frame,
            self.stamp_s,
            self.exposure_s,
            turn.map_or(RotationSource::Nothing, |turn| turn.source),
            turn.map(|turn| turn.earlier_s),
            turn.map(|turn| turn.earlier_exposure_s),
            cells::<4>(turn.map(|turn| turn.later_from_earlier.coords.into())),
            cells::<6>(turn.map(|turn| triangle(&turn.covariance))),
            cells::<3>(turn.map(|turn| turn.rate_in_camera.into())),
            cells::<6>(turn.map(|turn| triangle(&turn.rate_covariance))),
        );
        row.serialize(serializer)
    }
}

impl TableRow for RotationRow {
    const REQUIRED: &'static str = "\
        frame,stamp_s,exposure_s,source,earlier_s,earlier_exposure_s,qx,qy,qz,qw,c00,c01,\
        c02,c11,c12,c22,rx,ry,rz,r00,r01,r02,r11,r12,r22";
    const CURE: &'static str = "record the rotations with flockeye up --rotations";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        let source = cells.code(RotationSource::ALL, "source", "what a rotation is measured by")?;
        let turn = match source {
            RotationSource::Nothing => None,
            source => {
                let [x, y, z] = RATE;
                Some(RecordedTurn {
                    source,
                    earlier_s: cells.number("earlier_s")?,
                    earlier_exposure_s: cells.number("earlier_exposure_s")?,
                    later_from_earlier: cells.rotation(ROTATION)?,
                    covariance: cells.symmetric(&COVARIANCE)?,
                    rate_in_camera: Vector3::new(
                        cells.number(x)?,
                        cells.number(y)?,
                        cells.number(z)?,
                    ),
                    rate_covariance: cells.symmetric(&RATE_COVARIANCE)?,
                })
            }
        };
        let (stamp_s, exposure_s) = (cells.number("stamp_s")?, cells.number("exposure_s")?);
        Ok(Self { frame: cells.count("frame")?, stamp_s, exposure_s, turn })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::read;
    use crate::writer::TableWriter;

    fn stamp(sequence: u64, exposure_ns: i64, stream_ns: i64) -> FrameStamp {
        FrameStamp { sequence, exposure_ns, stream_ns, ..FrameStamp::default() }
    }

    fn rotation() -> Rotation {
        Rotation {
            stamp: stamp(7, 5_040_000_000, 233_333_333),
            earlier_exposure_ns: 5_000_000_000,
            later_from_earlier: [0.0, 0.6, 0.0, 0.8],
            covariance: [3e-7, 1e-8, 0.0, 1e-8, 2e-7, 0.0, 0.0, 0.0, 1e-7],
            rate_in_camera: [0.1, -0.2, 0.3],
            rate_covariance: [1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 2e-4],
            source: RotationSource::Picture.code(),
            generation: 0,
            ..Rotation::default()
        }
    }

    #[test]
    fn the_earlier_exposure_is_the_frames_that_it_was_measured_from() {
        let earlier_s = |before: Option<FrameStamp>| {
            let row = RotationRow::of(&rotation(), before.as_ref(), 4_800_000_000);
            assert!((row.exposure_s - 0.24).abs() < 1e-12);
            let turn = row.turn.expect("it is known");
            assert!((turn.earlier_exposure_s - 0.2).abs() < 1e-12);
            turn.earlier_s
        };
        // Played slower than it was taken: 40 ms passed for 33 of the stream.
        assert_eq!(earlier_s(Some(stamp(6, 5_000_000_000, 200_000_000))), 0.2);
        let by_difference = 0.233_333_333 - 0.04;
        assert!(
            (earlier_s(Some(stamp(5, 4_960_000_000, 166_666_667))) - by_difference).abs() < 1e-12
        );
        assert!((earlier_s(None) - by_difference).abs() < 1e-12);
    }

    #[test]
    fn what_was_written_is_read_again() {
        let path =
            std::env::temp_dir().join(format!("flockeye-{}-rotations.csv", std::process::id()));
        let unknown = Rotation { stamp: stamp(0, 1, 0), ..Rotation::default() };
        let rows = [RotationRow::of(&unknown, None, 1), RotationRow::of(&rotation(), None, 1)];
        assert_eq!(rows[0].turn, None);
        let mut table = TableWriter::create(&path).expect("it can be written");
        rows.iter().for_each(|row| table.add(row).expect("there is room"));
        table.finish().expect("there is room");
        assert_eq!(read::<RotationRow>(&path).expect("it is right"), rows);
        let text = std::fs::read_to_string(&path).expect("it is there");
        assert!(text.contains("\n0,0.0,0.0,nothing,,,,"), "{text}");
        for (from, to, wanted) in [
            (
                ",picture,",
                ",stars,",
                "column source: 'stars' is not what a rotation is measured by",
            ),
            (",0.6,", ",1.6,", "is not the w of a quaternion of length 1"),
        ] {
            assert!(text.contains(from), "{from} is not in {text}");
            std::fs::write(&path, text.replacen(from, to, 1)).expect("it can be written");
            let error = read::<RotationRow>(&path).expect_err("it is wrong").to_string();
            assert!(error.contains("line 3, ") && error.contains(wanted), "{error}");
        }
        std::fs::remove_file(path).expect("it can be removed");
    }
}
