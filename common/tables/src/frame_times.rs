//! The rows of the frames' times.

use flockeye_contract::FrameStamp;
use serde::Serialize;

use crate::table::{TableCells, TableError, TableRow};
use crate::writer::WrittenRow;

/// Times of a frame's publication and of its end, the arrival of its last tracks. Both are
/// CLOCK_MONOTONIC, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct FrameTimes {
    /// The source's frame, from 0.
    pub frame: u64,
    /// Time of publication by the source.
    pub published_ns: u64,
    /// Time of arrival of the last tracks.
    pub ended_ns: u64,
}

impl FrameTimes {
    /// The row of a frame that ends now.
    pub fn new(stamp: &FrameStamp, ended_ns: i64) -> Self {
        // The clock counts from the start of the machine: it is never negative.
        let published_ns = stamp.published_ns.max(0).unsigned_abs();
        Self { frame: stamp.sequence, published_ns, ended_ns: ended_ns.max(0).unsigned_abs() }
    }

    /// Time from publication to end, seconds.
    pub fn work_s(&self) -> f64 {
        self.ended_ns.saturating_sub(self.published_ns) as f64 * 1e-9
    }
}

impl WrittenRow for FrameTimes {
    fn names() -> Vec<&'static str> {
        Self::REQUIRED.split(',').collect()
    }
}

impl TableRow for FrameTimes {
    const REQUIRED: &'static str = "frame,published_ns,ended_ns";
    const CURE: &'static str = "record the times with flockeye up --frame-times";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        Ok(Self {
            frame: cells.count("frame")?,
            published_ns: cells.count("published_ns")?,
            ended_ns: cells.count("ended_ns")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::read;
    use crate::writer::TableWriter;

    #[test]
    fn times_are_read_as_they_were_written() {
        let path = std::env::temp_dir().join(format!("flockeye-{}-times.csv", std::process::id()));
        let stamp =
            FrameStamp { sequence: 4, published_ns: 1_000_000_000, ..FrameStamp::default() };
        let row = FrameTimes::new(&stamp, 1_250_000_001);
        let mut table = TableWriter::create(&path).expect("it can be written");
        table.add(&row).expect("there is room");
        table.finish().expect("there is room");
        let rows: Vec<FrameTimes> = read(&path).expect("it is right");
        std::fs::remove_file(path).expect("it can be removed");
        assert_eq!(rows, [row]);
        assert!((rows[0].work_s() - 0.250_000_001).abs() < 1e-12);
    }
}
