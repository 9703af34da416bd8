//! The rows of an inertial sensor's file.

use nalgebra::Vector3;

use crate::table::{TableCells, TableError, TableRow};

/// A sample of an inertial sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuRow {
    /// When it was taken, stream time, seconds.
    pub t_s: f64,
    /// Angular velocity along the sensor's axes, rad/s, its bias included.
    pub rate: Vector3<f64>,
    /// Specific force along the sensor's axes, m/s^2; `None` where the file has none.
    pub specific_force: Option<Vector3<f64>>,
}

impl TableRow for ImuRow {
    const REQUIRED: &'static [&'static str] = &["t_s", "gx", "gy", "gz"];
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
