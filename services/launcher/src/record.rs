//! Poses and truth as CSV.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::Context;
use flockeye_contract::{BodyTruth, FrameStamp, Track, TrackState, TruthHeader};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// A row of the poses: the target's pose in the observer's frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseRow {
    /// The source's frame, from 0.
    pub frame: u64,
    /// Mid-exposure, stream time, seconds.
    pub stamp_s: f64,
    /// The neighbour.
    pub target: String,
    /// Position, metres.
    pub px: f64,
    /// Position, metres.
    pub py: f64,
    /// Position, metres.
    pub pz: f64,
    /// Orientation.
    pub qx: f64,
    /// Orientation.
    pub qy: f64,
    /// Orientation.
    pub qz: f64,
    /// Orientation.
    pub qw: f64,
    /// The track's state; `coasting`: nothing was measured in this frame.
    pub state: TrackState,
    /// Markers decoded in this frame.
    pub markers: u32,
    /// Exposure (in a lossless run: frame published) to pose published.
    pub latency_ms: f64,
}

impl PoseRow {
    /// The row of a track; `None` for one whose state is unknown here.
    pub fn of(stamp: &FrameStamp, track: &Track) -> Option<Self> {
        let [px, py, pz] = track.observer_from_target.position;
        let [qx, qy, qz, qw] = track.observer_from_target.orientation;
        Some(Self {
            frame: stamp.sequence,
            stamp_s: stamp.stream_ns as f64 * 1e-9,
            target: track.name.to_string(),
            px,
            py,
            pz,
            qx,
            qy,
            qz,
            qw,
            state: TrackState::try_from(track.state).ok()?,
            markers: track.markers,
            latency_ms: track.latency.total_ns as f64 * 1e-6,
        })
    }

    /// Its position.
    pub fn position(&self) -> Vector3<f64> {
        Vector3::new(self.px, self.py, self.pz)
    }

    /// Its orientation.
    pub fn orientation(&self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_quaternion(Quaternion::new(self.qw, self.qx, self.qy, self.qz))
    }

    /// Whether the pose was measured in this frame.
    pub fn is_measured(&self) -> bool {
        !matches!(self.state, TrackState::Coasting | TrackState::Lost)
    }
}

/// A row of the truth: the body's pose in the camera frame. Columns of the reference recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
    /// Side of the best visible marker, pixels.
    pub best_side_px: f64,
    /// Length of the motion blur, pixels.
    pub blur_px: f64,
    /// The scene.
    pub env: String,
    /// The observer's yaw, degrees.
    pub observer_yaw_deg: f64,
    /// Exposure compensation, stops; 0 where it is not known.
    #[serde(default)]
    pub ev: f64,
    /// Sensitivity; 0 where it is not known.
    #[serde(default)]
    pub iso: u32,
    /// Length of the exposure, seconds.
    #[serde(default)]
    pub exposure_s: f64,
    /// 1 if a whole marker is seen at less than 65 degrees of incidence.
    pub localisable: u32,
}

impl TruthRow {
    /// The row of a body in a frame.
    pub fn of(header: &TruthHeader, body: &BodyTruth) -> Self {
        let [x, y, z] = body.camera_from_markers.position;
        let [qx, qy, qz, qw] = body.camera_from_markers.orientation;
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
        }
    }

    /// Its position.
    pub fn position(&self) -> Vector3<f64> {
        Vector3::new(self.x, self.y, self.z)
    }

    /// Its orientation.
    pub fn orientation(&self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_quaternion(Quaternion::new(self.qw, self.qx, self.qy, self.qz))
    }
}

/// A CSV file that is being written.
pub struct Recorder {
    path: PathBuf,
    writer: csv::Writer<File>,
}

impl Recorder {
    /// Creates the file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let writer = csv::Writer::from_path(path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path: path.to_owned(), writer })
    }

    /// Adds a row.
    ///
    /// # Errors
    /// It cannot be written: a full disk, say.
    pub fn add(&mut self, row: impl Serialize) -> anyhow::Result<()> {
        self.writer.serialize(row).with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Brings everything to the file.
    ///
    /// # Errors
    /// As [`Recorder::add`].
    pub fn finish(mut self) -> anyhow::Result<()> {
        self.writer.flush().with_context(|| format!("cannot write {}", self.path.display()))
    }
}

/// Reads a CSV file by its column names.
///
/// # Errors
/// The file cannot be read, or a row is not as it should be: with its line.
pub fn read<R: for<'de> Deserialize<'de>>(path: &Path) -> anyhow::Result<Vec<R>> {
    let mut reader =
        csv::Reader::from_path(path).with_context(|| format!("cannot read {}", path.display()))?;
    let rows: Result<Vec<R>, _> = reader.deserialize().collect();
    rows.with_context(|| format!("{} is not as it should be", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn the_truth_has_the_columns_of_the_reference_recordings() {
        let mut writer = csv::Writer::from_writer(Vec::new());
        let row = TruthRow::of(&TruthHeader::zeroed(), &BodyTruth::zeroed());
        writer.serialize(row).expect("memory is there");
        let text = String::from_utf8(writer.into_inner().expect("flushed")).expect("text");
        assert_eq!(
            text.lines().next().expect("a header"),
            "frame,t_s,body,x,y,z,qw,qx,qy,qz,dist_m,az_deg,el_deg,n_markers_vis50,n_markers_vis90,\
             best_side_px,blur_px,env,observer_yaw_deg,ev,iso,exposure_s,localisable"
        );
    }

    #[test]
    fn poses_have_the_promised_columns() {
        let mut writer = csv::Writer::from_writer(Vec::new());
        let row = PoseRow::of(&FrameStamp::default(), &Track::zeroed()).expect("state 0 is known");
        writer.serialize(row).expect("memory is there");
        let text = String::from_utf8(writer.into_inner().expect("flushed")).expect("text");
        let wanted = "frame,stamp_s,target,px,py,pz,qx,qy,qz,qw,state,markers,latency_ms";
        assert_eq!(text.lines().next(), Some(wanted));
        assert!(text.contains("tentative"));
    }
}
