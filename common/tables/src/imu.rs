//! The rows of an inertial sensor's file.

use flockeye_contract::ImuSample;
use flockeye_geometry::inertial::{RateRecord, RateSample};
use nalgebra::Vector3;
use serde::ser::{Serialize, Serializer};

use crate::table::{TableCells, TableError, TableRow, cells};
use crate::writer::WrittenRow;

/// A sample of an inertial sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuRow {
    /// Time of the sample, stream time, seconds.
    pub t_s: f64,
    /// Angular velocity along the sensor's axes, rad/s, its bias included.
    pub rate: Vector3<f64>,
    /// Specific force along the sensor's axes, m/s^2; `None` where the file has none.
    pub specific_force: Option<Vector3<f64>>,
}

impl ImuRow {
    /// The row of a sample. `zero_ns` is the frames' clock at the beginning of the stream,
    /// nanoseconds.
    pub fn of(sample: &ImuSample, zero_ns: i64) -> Self {
        let force = Vector3::from(sample.specific_force);
        Self {
            t_s: sample.at_ns.saturating_sub(zero_ns) as f64 * 1e-9,
            rate: sample.rate.into(),
            specific_force: force.iter().all(|force| force.is_finite()).then_some(force),
        }
    }
}

/// The rates of a whole file in the order of their times.
pub fn rate_record(mut rows: Vec<ImuRow>) -> RateRecord {
    rows.sort_by(|one, other| one.t_s.total_cmp(&other.t_s));
    let mut record = RateRecord::new(f64::INFINITY);
    rows.iter().for_each(|row| record.push(RateSample { at_s: row.t_s, rate: row.rate }));
    record
}

impl WrittenRow for ImuRow {
    fn names() -> Vec<&'static str> {
        vec!["t_s", "gx", "gy", "gz", "ax", "ay", "az"]
    }
}

impl Serialize for ImuRow {
    /// The cells, in the order of their columns' names.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let (rate, force): ([f64; 3], _) = (self.rate.into(), self.specific_force.map(Into::into));
        (self.t_s, rate, cells::<3>(force)).serialize(serializer)
    }
}

impl TableRow for ImuRow {
    const REQUIRED: &'static str = "t_s,gx,gy,gz";
    const CURE: &'static str =
        "write these columns: seconds of the stream, and rad/s along the sensor's axes";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        let rate = Vector3::new(cells.number("gx")?, cells.number("gy")?, cells.number("gz")?);
        let force = ["ax", "ay", "az"].map(|column| cells.maybe_number(column));
        let [x, y, z] = force;
        let specific_force = match (x?, y?, z?) {
            (Some(x), Some(y), Some(z)) => Some(Vector3::new(x, y, z)),
            _ => None,
        };
        Ok(Self { t_s: cells.number("t_s")?, rate, specific_force })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::table::read;
    use crate::writer::TableWriter;

    #[test]
    fn samples_are_read_as_they_were_written() {
        let folder = std::env::temp_dir().join(format!("flockeye-imu-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("imu.csv");
        let sample = ImuSample {
            at_ns: 7_250_000_000,
            rate: [0.1, -0.2, 0.3],
            specific_force: [0.0, 0.5, 9.8],
        };
        let no_force = ImuSample { at_ns: 7_255_000_000, specific_force: [f64::NAN; 3], ..sample };
        let rows = [sample, no_force].map(|sample| ImuRow::of(&sample, 7_000_000_000));
        let mut table = TableWriter::create(&path).unwrap();
        rows.iter().for_each(|row| table.add(row).unwrap());
        table.finish().unwrap();
        let found: Vec<ImuRow> = read(&path).unwrap();
        assert_eq!(found, rows);
        assert_eq!((found[0].t_s, found[1].specific_force), (0.25, None));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
