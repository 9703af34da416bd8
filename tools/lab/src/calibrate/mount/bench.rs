//! The file of places, and the measured pose at each place.

use std::collections::BTreeSet;

use crate::calibration::mount::{MeasuredPlace, still_pose};
use anyhow::{bail, ensure};
use flockeye_config::{Mount, isometry};
use flockeye_geometry::pose::turned_covariance;
use flockeye_tables::PoseRow;
use nalgebra::{Isometry3, Matrix6};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where a body was put.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct MeasuringBench {
    /// Which body; left out: the one that is seen, if it is one.
    #[serde(default)]
    pub body: Option<String>,
    /// Standard deviation of the measured positions along each axis, metres.
    #[schemars(range(min = 0.00001, max = 1.0))]
    pub deviation_m: f64,
    /// Standard deviation of the measured orientations about each axis, degrees.
    #[serde(default)]
    #[schemars(range(min = 0.001, max = 45.0))]
    pub orientation_deviation_deg: Option<f64>,
    /// The places, in the order of the pictures.
    pub places: Vec<BenchPlace>,
}

/// One place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct BenchPlace {
    /// Where the body's origin was in the drone's frame, metres: x forward, y left, z up.
    pub position: [f64; 3],
    /// How it was turned there, unit quaternion x, y, z, w; left out: not measured.
    #[serde(default)]
    pub orientation: Option<[f64; 4]>,
    /// This position's own standard deviation, metres.
    #[serde(default)]
    #[schemars(range(min = 0.00001, max = 1.0))]
    pub deviation_m: Option<f64>,
    /// First and last frame of the source that show it, from 0; left out everywhere: one frame
    /// each, in order.
    #[serde(default)]
    pub frames: Option<[u64; 2]>,
}

impl MeasuringBench {
    /// Refuses errors that the schema cannot express.
    ///
    /// # Errors
    /// Frames are given for some places only or in the wrong order, or an orientation is invalid or
    /// has no deviation.
    pub(super) fn check(&self) -> anyhow::Result<()> {
        let with_frames = self.places.iter().filter(|place| place.frames.is_some()).count();
        ensure!(
            with_frames == 0 || with_frames == self.places.len(),
            "{with_frames} of {} places have frames. Cure: frames for all of them, or for none: then each \
             place has one frame, in order",
            self.places.len()
        );
        for (number, place) in (1..).zip(&self.places) {
            let name = format!("places.{} (the {number}. place)", number - 1);
            if let Some([first, last]) = place.frames {
                ensure!(first <= last, "{name}.frames: the last frame, {last}, is before {first}");
            }
            let Some(orientation) = place.orientation else { continue };
            let norm = orientation.iter().map(|q| q * q).sum::<f64>().sqrt();
            ensure!(
                (norm - 1.0).abs() <= 1e-3,
                "{name}.orientation: a rotation's quaternion x, y, z, w has length 1, not {norm:.4}"
            );
            ensure!(
                self.orientation_deviation_deg.is_some(),
                "{name}.orientation: how well was it measured? Cure: orientation_deviation_deg"
            );
        }
        Ok(())
    }

    /// The body's name: the one in the file, or the only one that has poses.
    ///
    /// # Errors
    /// No body or several bodies have poses, or the named body has none.
    pub(super) fn body(&self, rows: &[PoseRow]) -> anyhow::Result<String> {
        let seen: BTreeSet<&str> = rows.iter().map(|row| row.target.as_str()).collect();
        match (&self.body, Vec::from_iter(&seen).as_slice()) {
            (Some(body), _) if seen.contains(body.as_str()) => Ok(body.clone()),
            (None, [body]) => Ok((**body).to_owned()),
            (_, []) => bail!("no body is seen in any frame. Cure: see `flockeye check`"),
            (Some(body), _) => bail!("body '{body}' is never seen; seen are {seen:?}"),
            (None, _) => {
                bail!("{seen:?} are seen. Cure: name the one that was put there with `body`")
            }
        }
    }

    /// The measured pose at each place; `None` if the body has no pose there. `configured` is the
    /// mount with which the poses were recorded.
    pub(super) fn see(
        &self,
        rows: &[PoseRow],
        body: &str,
        configured: &Isometry3<f64>,
    ) -> anyhow::Result<Vec<Option<MeasuredPlace>>> {
        let places = (0u64..).zip(&self.places).map(|(index, place)| {
            let [first, last] = place.frames.unwrap_or([index, index]);
            let own = rows.iter().filter(|row| {
                row.target == body && row.is_measured() && (first..=last).contains(&row.frame)
            });
            let poses: anyhow::Result<Vec<_>> = own.map(|row| in_camera(row, configured)).collect();
            let Some(seen) = still_pose(&poses?) else { return Ok(None) };
            let turn_rad = self.orientation_deviation_deg.unwrap_or(0.0).to_radians();
            let turned = |orientation: [f64; 4]| {
                (isometry(&Mount { position: [0.0; 3], orientation }).rotation, turn_rad)
            };
            Ok(Some(MeasuredPlace {
                seen,
                in_observer: place.position.into(),
                deviation_m: place.deviation_m.unwrap_or(self.deviation_m),
                orientation: place.orientation.map(turned),
            }))
        });
        places.collect()
    }
}

/// The frame's own measurement as a pose in the camera frame, which does not depend on the
/// configured mount.
fn in_camera(
    row: &PoseRow,
    configured: &Isometry3<f64>,
) -> anyhow::Result<(Isometry3<f64>, Matrix6<f64>)> {
    let (position, orientation, covariance) = match &row.measured {
        Some(measured) => (measured.position, measured.orientation, measured.covariance),
        None => (row.position, row.orientation, row.covariance),
    };
    let Some(covariance) = covariance else {
        bail!(
            "frame {}: its pose has no covariance. Cure: record it with flockeye up --poses",
            row.frame
        )
    };
    let observer_from_target = Isometry3::from_parts(position.into(), orientation);
    let covariance = turned_covariance(&configured.rotation.inverse(), &covariance);
    Ok((configured.inverse() * observer_from_target, covariance))
}
