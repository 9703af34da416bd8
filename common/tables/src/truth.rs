//! The rows of the truth.

use flockeye_contract::{BodyTruth, TruthHeader};
use flockeye_convert::rotation;
use nalgebra::{UnitQuaternion, Vector3};
use serde::Serialize;

use crate::table::{TableCells, TableError, TableRow};
use crate::writer::WrittenRow;

/// A row of the truth: the body's pose in the camera frame. The columns are those of the reference
/// recordings, and the camera's attitude.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthRow {
    /// The source's frame, from 0.
    pub frame: u64,
    /// Mid-exposure, stream time, seconds.
    pub t_s: f64,
    /// The body's name.
    pub body: String,
    /// Position, metres.
    pub x: f64,
    /// Position, metres.
    pub y: f64,
    /// Position, metres.
    pub z: f64,
    /// Orientation.
    pub qw: f64,
    /// Orientation.
    pub qx: f64,
    /// Orientation.
    pub qy: f64,
    /// Orientation.
    pub qz: f64,
    /// Distance, metres.
    pub dist_m: f64,
    /// Azimuth, degrees.
    pub az_deg: f64,
    /// Elevation, degrees.
    pub el_deg: f64,
    /// Markers of which at least half is visible.
    pub n_markers_vis50: u32,
    /// Markers of which at least 90 % is visible.
    pub n_markers_vis90: u32,
    /// Side of the best visible marker, pixels; 0 where it is not known.
    pub best_side_px: f64,
    /// Length of the motion blur, pixels; 0 where it is not known.
    pub blur_px: f64,
    /// The scene; empty where it is not known.
    pub env: String,
    /// The observer's yaw, degrees; 0 where it is not known.
    pub observer_yaw_deg: f64,
    /// Exposure compensation, stops; 0 where it is not known.
    pub ev: f64,
    /// Sensitivity; 0 where it is not known.
    pub iso: u32,
    /// Length of the exposure, seconds; 0 where it is not known.
    pub exposure_s: f64,
    /// 1 if a whole marker is visible at less than 65 degrees of incidence, else 0.
    pub localisable: u32,
    /// The camera's attitude in the world: turns directions in the camera frame into the world's.
    /// All four are empty where it is not known.
    pub camera_qw: Option<f64>,
    /// Attitude.
    pub camera_qx: Option<f64>,
    /// Attitude.
    pub camera_qy: Option<f64>,
    /// Attitude.
    pub camera_qz: Option<f64>,
}

impl WrittenRow for TruthRow {
    fn names() -> Vec<&'static str> {
        let header = "frame,t_s,body,x,y,z,qw,qx,qy,qz,dist_m,az_deg,el_deg,n_markers_vis50,\
             n_markers_vis90,best_side_px,blur_px,env,observer_yaw_deg,ev,iso,exposure_s,\
             localisable,camera_qw,camera_qx,camera_qy,camera_qz";
        header.split(',').collect()
    }
}

impl TruthRow {
    /// The row of a body in a frame.
    pub fn of(header: &TruthHeader, body: &BodyTruth) -> Self {
        let [x, y, z] = body.camera_from_markers.position;
        let [qx, qy, qz, qw] = body.camera_from_markers.orientation;
        let attitude = header.world_from_camera;
        let is_known = attitude.iter().any(|&number| number != 0.0);
        let [camera_qx, camera_qy, camera_qz, camera_qw] =
            attitude.map(|number| is_known.then_some(number));
        Self {
            frame: header.stamp.sequence,
            t_s: header.stamp.stream_ns as f64 * 1e-9,
            body: body.name.to_string(),
            x,
            y,
            z,
            qw,
            qx,
            qy,
            qz,
            dist_m: Vector3::new(x, y, z).norm(),
            az_deg: y.atan2(x).to_degrees(),
            el_deg: z.atan2(x.hypot(y)).to_degrees(),
            n_markers_vis50: body.markers_visible_50,
            n_markers_vis90: body.markers_visible_90,
            best_side_px: body.best_side_px,
            blur_px: body.blur_px,
            env: "simulated".into(),
            observer_yaw_deg: header.observer_yaw.to_degrees(),
            ev: 0.0,
            iso: 0,
            exposure_s: header.exposure_s,
            localisable: body.localisable,
            camera_qw,
            camera_qx,
            camera_qy,
            camera_qz,
        }
    }

    /// The camera's attitude in the world, where it is known.
    pub fn world_from_camera(&self) -> Option<UnitQuaternion<f64>> {
        Some(rotation([self.camera_qx?, self.camera_qy?, self.camera_qz?, self.camera_qw?]))
    }

    /// The body's position, metres.
    pub fn position(&self) -> Vector3<f64> {
        Vector3::new(self.x, self.y, self.z)
    }

    /// The body's orientation.
    pub fn orientation(&self) -> UnitQuaternion<f64> {
        rotation([self.qx, self.qy, self.qz, self.qw])
    }
}

impl TableRow for TruthRow {
    const REQUIRED: &'static str = "frame,t_s,body,x,y,z,qw,qx,qy,qz,n_markers_vis90,localisable";
    const CURE: &'static str = "record the truth of a simulated flight with flockeye up --truth, or \
                                write these columns of another one's";

    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
        let known = |column: &str| Ok(cells.maybe_number(column)?.unwrap_or(0.0));
        let [x, y, z] = [cells.number("x")?, cells.number("y")?, cells.number("z")?];
        let orientation = cells.rotation(["qx", "qy", "qz", "qw"])?;
        let attitude = match cells.text("camera_qw") {
            "" => None,
            _ => Some(cells.rotation(["camera_qx", "camera_qy", "camera_qz", "camera_qw"])?),
        };
        let n_markers_vis90 = cells.small_count("n_markers_vis90")?;
        let n_markers_vis50 = match cells.text("n_markers_vis50") {
            "" => n_markers_vis90,
            _ => cells.small_count("n_markers_vis50")?,
        };
        Ok(Self {
            frame: cells.count("frame")?,
            t_s: cells.number("t_s")?,
            body: cells.text("body").to_owned(),
            x,
            y,
            z,
            qw: orientation.w,
            qx: orientation.i,
            qy: orientation.j,
            qz: orientation.k,
            dist_m: cells.maybe_number("dist_m")?.unwrap_or(Vector3::new(x, y, z).norm()),
            az_deg: cells.maybe_number("az_deg")?.unwrap_or(y.atan2(x).to_degrees()),
            el_deg: cells.maybe_number("el_deg")?.unwrap_or(z.atan2(x.hypot(y)).to_degrees()),
            n_markers_vis50,
            n_markers_vis90,
            best_side_px: known("best_side_px")?,
            blur_px: known("blur_px")?,
            env: cells.text("env").to_owned(),
            observer_yaw_deg: known("observer_yaw_deg")?,
            ev: known("ev")?,
            iso: cells.value("iso", "a whole number from 0")?.unwrap_or(0),
            exposure_s: known("exposure_s")?,
            localisable: cells.small_count("localisable")?,
            camera_qw: attitude.map(|attitude| attitude.w),
            camera_qx: attitude.map(|attitude| attitude.i),
            camera_qy: attitude.map(|attitude| attitude.j),
            camera_qz: attitude.map(|attitude| attitude.k),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::read;
    use bytemuck::Zeroable;

    #[test]
    fn the_truth_has_the_columns_of_the_reference_recordings_and_the_attitude() {
        let mut writer = csv::Writer::from_writer(Vec::new());
        let row = TruthRow::of(&TruthHeader::zeroed(), &BodyTruth::zeroed());
        writer.serialize(row).expect("memory is there");
        let text = String::from_utf8(writer.into_inner().expect("flushed")).expect("text");
        let wanted = "frame,t_s,body,x,y,z,qw,qx,qy,qz,dist_m,az_deg,el_deg,n_markers_vis50,\
                      n_markers_vis90,best_side_px,blur_px,env,observer_yaw_deg,ev,iso,exposure_s,\
                      localisable,camera_qw,camera_qx,camera_qy,camera_qz";
        assert_eq!(text.lines().next(), Some(wanted));
        assert_eq!(TruthRow::names().join(","), wanted);
        assert!(text.ends_with(",0,,,,\n"), "no attitude is none: {text}");
    }

    #[test]
    fn the_attitude_is_read_as_it_was_written() {
        let header =
            TruthHeader { world_from_camera: [0.0, 0.6, 0.0, 0.8], ..TruthHeader::zeroed() };
        let body = BodyTruth {
            camera_from_markers: flockeye_contract::Pose::default(),
            ..BodyTruth::zeroed()
        };
        let row = TruthRow::of(&header, &body);
        let path = std::env::temp_dir().join(format!("flockeye-{}-turned.csv", std::process::id()));
        let mut table = crate::TableWriter::create(&path).expect("it can be written");
        table.add(&row).expect("there is room");
        table.finish().expect("there is room");
        let rows: Vec<TruthRow> = read(&path).expect("it is right");
        std::fs::remove_file(path).expect("it can be removed");
        assert_eq!(rows, [row]);
        let turned = rows[0].world_from_camera().expect("it is known").angle();
        assert!((turned - 2.0 * 0.8_f64.acos()).abs() < 1e-12, "{turned}");
    }

    #[test]
    fn a_few_columns_are_enough() {
        let path = std::env::temp_dir().join(format!("flockeye-{}-few.csv", std::process::id()));
        let header = "frame,t_s,body,x,y,z,qw,qx,qy,qz,n_markers_vis90,localisable\n";
        std::fs::write(&path, format!("{header}5,0.1,alpha,0,3,4,1,0,0,0,2,1\n"))
            .expect("it can be written");
        let rows: Vec<TruthRow> = read(&path).expect("it is right");
        std::fs::remove_file(path).expect("it can be removed");
        assert_eq!((rows[0].frame, rows[0].dist_m, rows[0].az_deg), (5, 5.0, 90.0));
        assert_eq!((rows[0].n_markers_vis50, rows[0].env.as_str()), (2, ""));
    }
}
