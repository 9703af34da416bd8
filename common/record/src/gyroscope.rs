//! The rows of an inertial sensor's file, as far as the camera's rotation is judged by them.

use nalgebra::Vector3;

use crate::table::{TableCells, TableError, TableRow};

/// A sample of a gyroscope whose axes are the camera's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GyroscopeRow {
    /// When it was taken, stream time, seconds.
    pub t_s: f64,
    /// Angular velocity in the camera's axes, rad/s, the sensor's bias included.
    pub rate_in_camera: Vector3<f64>,
}

impl TableRow for GyroscopeRow {
    const REQUIRED: &'static [&'static str] = &["t_s", "gx", "gy", "gz"];
    const CURE: &'static str =
        "write these columns: seconds of the stream, and rad/s along the camera's axes";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        let rate_in_camera =
            Vector3::new(cells.number("gx")?, cells.number("gy")?, cells.number("gz")?);
        Ok(Self { t_s: cells.number("t_s")?, rate_in_camera })
    }
}
