//! The rows of the detected markers' corner rays.

use flockeye_contract::{DetectedMarker, DetectionHeader};
use serde::ser::{Serialize, Serializer};

use crate::table::{TableCells, TableError, TableRow};
use crate::writer::WrittenRow;

/// The rays of a marker's four corners, as detection found them in a view of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarkerRays {
    /// Number of the source's stream; it rises each time the source restarts its stream.
    pub epoch: u32,
    /// The source's frame, from 0.
    pub frame: u64,
    /// The marker's id in its dictionary.
    pub marker: u32,
    /// Unit rays of the corners in the camera frame, in ArUco's order.
    pub rays_in_camera: [[f64; 3]; 4],
    /// Standard deviation of each ray across its direction, radians.
    pub deviations_rad: [f64; 4],
}

/// The columns of each corner: the ray and its standard deviation.
const CORNERS: [[&str; 4]; 4] = [
    ["x0", "y0", "z0", "deviation0_rad"],
    ["x1", "y1", "z1", "deviation1_rad"],
    ["x2", "y2", "z2", "deviation2_rad"],
    ["x3", "y3", "z3", "deviation3_rad"],
];

impl MarkerRays {
    /// The row of a marker that was found in a view.
    pub fn new(header: &DetectionHeader, marker: &DetectedMarker) -> Self {
        Self {
            epoch: header.stamp.epoch,
            frame: header.stamp.sequence,
            marker: marker.id,
            rays_in_camera: marker.rays_in_camera,
            deviations_rad: marker.deviations,
        }
    }
}

impl WrittenRow for MarkerRays {
    fn names() -> Vec<&'static str> {
        Self::REQUIRED.split(',').collect()
    }
}

impl Serialize for MarkerRays {
    /// The cells, in the order of their columns' names.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let corners: [[f64; 4]; 4] = std::array::from_fn(|k| {
            let [x, y, z] = self.rays_in_camera[k];
            [x, y, z, self.deviations_rad[k]]
        });
        (self.epoch, self.frame, self.marker, corners).serialize(serializer)
    }
}

impl TableRow for MarkerRays {
    const REQUIRED: &'static str = "\
        epoch,frame,marker,x0,y0,z0,deviation0_rad,x1,y1,z1,deviation1_rad,x2,y2,z2,\
        deviation2_rad,x3,y3,z3,deviation3_rad";
    const CURE: &'static str = "record the rays with flockeye up --rays";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        let (mut rays_in_camera, mut deviations_rad) = ([[0.0; 3]; 4], [0.0; 4]);
        for (corner, [x, y, z, deviation_rad]) in CORNERS.into_iter().enumerate() {
            let ray = [cells.number(x)?, cells.number(y)?, cells.number(z)?];
            let norm = ray.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (norm - 1.0).abs() > 1e-6 {
                return Err(cells.refuse(x, "the x of a unit ray"));
            }
            rays_in_camera[corner] = ray;
            deviations_rad[corner] = cells.number(deviation_rad)?;
            if deviations_rad[corner] <= 0.0 {
                return Err(cells.refuse(deviation_rad, "a positive number"));
            }
        }
        Ok(Self {
            epoch: cells.small_count("epoch")?,
            frame: cells.count("frame")?,
            marker: cells.small_count("marker")?,
            rays_in_camera,
            deviations_rad,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::read;
    use crate::writer::TableWriter;
    use bytemuck::Zeroable;

    #[test]
    fn rays_are_read_as_they_were_written_to_the_last_bit() {
        let path = std::env::temp_dir().join(format!("flockeye-{}-rays.csv", std::process::id()));
        let (sin, cos) = 0.123_f64.sin_cos();
        let found = DetectedMarker {
            rays_in_camera: [[cos, sin, 0.0], [cos, -sin, 0.0], [sin, 0.0, cos], [0.0, 0.0, -1.0]],
            deviations: [1e-3 / 3.0, 2e-3, 3e-5, 1e-4],
            id: 17,
            ..DetectedMarker::default()
        };
        let row = MarkerRays::new(&DetectionHeader::zeroed(), &found);
        let mut table = TableWriter::create(&path).expect("it can be written");
        table.add(&row).expect("there is room");
        table.finish().expect("there is room");
        assert_eq!(read::<MarkerRays>(&path).expect("it is right"), [row]);
        let text = std::fs::read_to_string(&path).expect("it is there");
        for (from, to, wanted) in [
            ("-1.0,", "-1.5,", "column x3: '0.0' is not the x of a unit ray"),
            (",0.002,", ",0,", "column deviation1_rad: '0' is not a positive number"),
            (",17,", ",-17,", "column marker: '-17' is not a whole number"),
        ] {
            assert!(text.contains(from), "{from} is not in {text}");
            std::fs::write(&path, text.replacen(from, to, 1)).expect("it can be written");
            let error = read::<MarkerRays>(&path).expect_err("it is wrong").to_string();
            assert!(error.contains("line 2, ") && error.contains(wanted), "{error}");
        }
        std::fs::remove_file(path).expect("it can be removed");
    }
}
