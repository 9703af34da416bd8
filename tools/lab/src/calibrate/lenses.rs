//! `flockeye calibrate lenses`: the relative pose of the camera's two lenses. It is measured from a
//! recording in which a body spans the seam between them.

use crate::calibration::lenses::{FoundLenses, LensCalibration, calibrate};
use flockeye_cli::{Configuration, Screen};
use flockeye_config::{CameraSettings, FisheyeLens, Resolved};
use serde_json::{Value, json};

use super::body::by_frame;
use super::{STATED_AT_M, frame_by_frame, mount_of, written};

/// Largest scatter of rays that the lenses explain, in stated standard deviations.
const MUCH_SCATTER: f64 = 2.0;

/// Runs the recording lossless, and prints the relative pose of the lenses.
///
/// # Errors
/// `flockeye up` fails, the camera has one centre, or no body spans the seam often enough.
pub(crate) fn run(configuration: &Configuration, json: bool) -> anyhow::Result<()> {
    let configuration = frame_by_frame(configuration);
    let resolved = Resolved::of(configuration.load()?)?;
    // This check is first, so that a camera with one centre is refused before the long run.
    if resolved.camera.lens_positions().is_none() {
        calibrate(&resolved.camera, &[], &[])?;
    }
    let rays = written(&configuration, "--rays", "the recording", json)?;
    // All views of such a run are tiles. Their rays are valid for the distance for which the
    // camera's model is valid.
    let frames = by_frame(&rays);
    let bodies: Vec<_> = resolved.bodies.iter().cloned().collect();
    let found = calibrate(&resolved.camera, &bodies, &frames)?;
    let text = match json {
        true => serde_json::to_string_pretty(&as_json(&found))?,
        false => text(&found, &resolved.pipeline.camera)?,
    };
    Screen::new().line(&text);
    Ok(())
}

fn as_json(found: &LensCalibration) -> Value {
    let mut json = json!({
        "frames": found.frames,
        "left_out": found.left_out,
        "scatter": found.scatter,
        "scatter_as_configured": found.scatter_before,
        "error_mm_at_1.5_m": found.error_at_m(STATED_AT_M) * 1e3,
        "configured_error_mm_at_1.5_m": found.configured_error_at_m(STATED_AT_M) * 1e3,
    });
    match &found.found {
        FoundLenses::Distance { lens_distance_m, deviation_m } => {
            json["lens_distance_m"] = json!(lens_distance_m);
            json["deviation_m"] = json!(deviation_m);
        }
        FoundLenses::Second { camera_from_lens, covariance } => {
            let deviations = covariance.diagonal().map(f64::sqrt);
            json["camera_from_lens"] = json!(mount_of(camera_from_lens));
            json["position_deviation_m"] = json!(deviations.as_slice()[..3]);
            json["rotation_deviation_rad"] = json!(deviations.as_slice()[3..]);
        }
    }
    json
}

/// The report. `camera` is the configured camera.
fn text(found: &LensCalibration, camera: &CameraSettings) -> anyhow::Result<String> {
    let sides = ["ahead", "behind", "left", "right", "above", "below"];
    let seen = sides.iter().zip(found.sides).filter(|(_, count)| *count > 0);
    let seen: Vec<String> = seen.map(|(side, count)| format!("{count} {side}")).collect();
    let mut text = format!(
        "{} frames in which both lenses saw markers of one body: {}\n\
         residuals    {:.2} stated standard deviations, {:.2} with the lenses as configured\n",
        found.frames,
        seen.join(", "),
        found.scatter,
        found.scatter_before,
    );
    if found.left_out > 0 {
        text += &format!("# {} more frames fit no pose, and do not count\n", found.left_out);
    }
    match &found.found {
        FoundLenses::Distance { lens_distance_m, deviation_m } => {
            let (found_mm, deviation_mm) = (lens_distance_m * 1e3, deviation_m * 1e3);
            text += &format!(
                "distance     {found_mm:.2} mm between the lenses, +- {deviation_mm:.2}; configured are {:.2}\n",
                camera.lens_distance_m.unwrap_or(0.0) * 1e3
            );
            if *lens_distance_m < -3.0 * deviation_m {
                text += "# A distance below 0 is none. Cure: the seam must be where x is 0 in the camera frame, \
                         and things far away must be whole across it\n";
            }
        }
        FoundLenses::Second { covariance, .. } => {
            let part = |numbers: &[f64], factor: f64| {
                let [x, y, z] = [0, 1, 2].map(|k| numbers[k] * factor);
                format!("{x:.3}, {y:.3}, {z:.3}")
            };
            let deviations = covariance.diagonal().map(f64::sqrt);
            let (change, deviations) = (found.change.as_slice(), deviations.as_slice());
            let degrees = 1f64.to_degrees();
            text += &format!(
                "second lens  shifted by {} mm along x, y, z of the camera, +- {}\n             \
                 turned by {} degrees about them, +- {}; the first lens stays\n",
                part(change, 1e3),
                part(deviations, 1e3),
                part(&change[3..], degrees),
                part(&deviations[3..], degrees),
            );
        }
    }
    text += &format!(
        "it leaves    {:.2} mm at {STATED_AT_M} m in the worst direction; as configured, a neighbour is off by {:.1} mm\n",
        found.error_at_m(STATED_AT_M) * 1e3,
        found.configured_error_at_m(STATED_AT_M) * 1e3,
    );
    if found.scatter > MUCH_SCATTER {
        text += "# Rays scatter by more than they state: the lenses' curves, the stitching or the body may be off. \
                 Deviations are enlarged for that. Cure: calibrate each lens and the body first\n";
    }
    Ok(format!("{text}for pipeline.yaml:\n{}", yaml(&found.found, camera)?))
}

/// The result as lines for `pipeline.yaml`.
fn yaml(found: &FoundLenses, camera: &CameraSettings) -> serde_json::Result<String> {
    match found {
        FoundLenses::Distance { lens_distance_m, .. } => {
            Ok(format!("camera:\n  lens_distance_m: {:.5}", lens_distance_m.max(0.0)))
        }
        FoundLenses::Second { camera_from_lens, .. } => {
            let found = mount_of(camera_from_lens);
            let lenses = camera.lenses.iter().enumerate().map(|(index, lens)| match index {
                1 => in_one_line(&FisheyeLens { camera_from_lens: found, ..lens.clone() }),
                _ => in_one_line(lens),
            });
            let lenses: serde_json::Result<Vec<String>> = lenses.collect();
            Ok(format!("camera:\n  lenses:\n    - {}", lenses?.join("\n    - ")))
        }
    }
}

/// A lens as YAML in one line, without unset keys.
fn in_one_line(lens: &FisheyeLens) -> serde_json::Result<String> {
    let mut value = serde_json::to_value(lens)?;
    if let Some(keys) = value.as_object_mut() {
        keys.retain(|_, value| !value.is_null());
    }
    Ok(value.to_string())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_config::{Pipeline, isometry};
    use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};

    #[test]
    fn what_is_printed_can_be_pasted() {
        let settings = "camera:\n  width: 1280\n  height: 640\n  projection: dual_fisheye\n";
        let lens = |u: f64, more: &str| {
            format!(
                "{{centre_px: [{u}, 319.5], circle_px: 306, field_deg: 194, camera_from_lens: {{}}{more}}}"
            )
        };
        let calibrated = ", focal_px: [188.9, 187.4], double_sphere: [0.0024, 0.6605]";
        let lenses = [lens(319.5, ""), lens(959.5, calibrated)];
        let configured = format!("{settings}  lenses: [{}]", lenses.join(", "));
        let configured = Pipeline::parse(&configured, &[], "x").unwrap().camera;
        let camera_from_lens = Isometry3::from_parts(
            Vector3::new(-0.0083, 0.0001, 0.0).into(),
            UnitQuaternion::from_euler_angles(0.1, -1.5, 3.0),
        );
        let found = FoundLenses::Second { camera_from_lens, covariance: Matrix6::identity() };
        let printed = yaml(&found, &configured).unwrap();
        let whole = printed.replacen("camera:\n", settings, 1);
        let read = Pipeline::parse(&whole, &[], "x").unwrap().camera;
        let second = isometry(&read.lenses[1].camera_from_lens);
        assert!((second.translation.vector - camera_from_lens.translation.vector).norm() < 1e-6);
        assert!(second.rotation.angle_to(&camera_from_lens.rotation) < 1e-7, "{printed}");
        assert_eq!(read.lenses[0], configured.lenses[0]);
        assert_eq!(read.lenses[1].double_sphere, Some([0.0024, 0.6605]));
        let distance = FoundLenses::Distance { lens_distance_m: 0.01618, deviation_m: 1e-4 };
        let printed = yaml(&distance, &configured).unwrap();
        assert_eq!(
            Pipeline::parse(&printed, &[], "x").unwrap().camera.lens_distance_m,
            Some(0.01618)
        );
    }
}
