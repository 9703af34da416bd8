//! `flockeye calibrate body`: the real poses of a body's markers, from a recording of the body.

use std::collections::BTreeMap;
use std::path::Path;

use crate::calibration::body::{BodyCalibration, CalibratedMarker, calibrate};
use anyhow::Context;
use flockeye_cli::text_table::TextTable;
use flockeye_cli::{Configuration, Screen};
use flockeye_geometry::body::Bodies;
use flockeye_geometry::pose::CornerRay;
use flockeye_tables::MarkerRays;
use nalgebra::{Unit, Vector3};
use serde_json::{Value, json};

use super::{lossless, written};

/// Runs the recording lossless, calibrates the bodies that are seen in it, and writes them.
///
/// # Errors
/// `flockeye up` fails, no body is seen often enough, or the file cannot be written.
pub(crate) fn run(configuration: &Configuration, path: &Path) -> anyhow::Result<()> {
    let configuration = lossless(configuration)?;
    let bodies = flockeye_config::bodies(&configuration.load()?.bodies)?;
    // The file is opened first, so that an unwritable file is reported before the long run.
    let is_new = !path.exists();
    let file = std::fs::OpenOptions::new().create(true).append(true).open(path);
    file.with_context(|| format!("cannot write {}", path.display()))?;
    let outcome = find(&configuration, &bodies).and_then(|found| {
        let text = serde_json::to_string_pretty(&document(&bodies, &found)?)? + "\n";
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
    });
    match &outcome {
        Ok(()) => Screen::new().line(&format!("written to {}", path.display())),
        // The empty file that was created above is not a valid bodies file.
        Err(_) if is_new => drop(std::fs::remove_file(path)),
        Err(_) => {}
    }
    outcome
}

/// Runs the recording, and calibrates the bodies that are seen in it.
fn find(configuration: &Configuration, bodies: &Bodies) -> anyhow::Result<Vec<BodyCalibration>> {
    let mut screen = Screen::new();
    let frames = by_frame(&written(configuration, "--rays", "the recording", false)?);
    let (mut found, mut refused) = (Vec::new(), None);
    for body in bodies.iter() {
        let is_seen = |ray: &CornerRay| body.marker(ray.marker_id).is_some();
        if !frames.iter().flatten().any(is_seen) {
            screen.line(&format!("body '{}' is never seen: it stays as designed", body.name));
            continue;
        }
        match calibrate(body, &frames) {
            Ok(calibration) => {
                screen.line(&table(&calibration));
                found.push(calibration);
            }
            // A body in the background must not prevent the calibration of another one.
            Err(error) => {
                screen.line(&format!("body '{}' stays as designed: {error}", body.name));
                refused = refused.or(Some(error));
            }
        }
    }
    match (found.is_empty(), refused) {
        (true, Some(error)) => Err(error.into()),
        (true, None) => anyhow::bail!("no marker of any body was read. Cure: see `flockeye check`"),
        (false, _) => Ok(found),
    }
}

/// The rays of each frame.
pub(super) fn by_frame(rows: &[MarkerRays]) -> Vec<Vec<CornerRay>> {
    let mut frames: BTreeMap<(u32, u64), Vec<CornerRay>> = BTreeMap::new();
    for row in rows {
        let rays = frames.entry((row.epoch, row.frame)).or_default();
        rays.extend((0..4).map(|corner| CornerRay {
            marker_id: row.marker,
            corner,
            ray_in_camera: Unit::new_normalize(Vector3::from(row.rays_in_camera[corner])),
            deviation_rad: row.deviations_rad[corner],
        }));
    }
    frames.into_values().collect()
}

/// The calibration as text.
fn table(calibration: &BodyCalibration) -> String {
    let titles = ["marker", "shift mm", "+-", "turn deg", "+-", "frames"];
    let mut table = TextTable::new(0, &titles);
    for found in &calibration.markers {
        table.row([
            found.marker.id.to_string(),
            format!("{:.2}", found.shift_m.norm() * 1e3),
            format!("{:.2}", found.shift_deviation_m() * 1e3),
            format!("{:.2}", found.turn_rad.norm().to_degrees()),
            format!("{:.2}", found.turn_deviation_rad().to_degrees()),
            found.frames.to_string(),
        ]);
    }
    let mut text = format!(
        "body '{}': {} frames, errors of {:.2} stated standard deviations\n{}",
        calibration.body.name,
        calibration.frames,
        calibration.scatter,
        table.text()
    );
    for (id, frames) in &calibration.left {
        text += &format!("\nmarker {id} was seen in {frames} frames only: it stays as designed");
    }
    text
}

/// The bodies file, with the standard deviations of calibrated markers.
fn document(bodies: &Bodies, found: &[BodyCalibration]) -> anyhow::Result<Value> {
    let all = bodies.iter().map(|body| {
        let calibrated = found.iter().find(|found| found.body.name == body.name);
        calibrated.map_or(body, |calibration| &calibration.body).clone()
    });
    let mut document = Bodies::new(bodies.dictionary.clone(), all.collect())?.to_json();
    for calibration in found {
        let name = &calibration.body.name;
        let markers = document["bodies"][name]["markers"].as_array_mut().into_iter().flatten();
        for marker in markers {
            let id = marker["id"].as_u64();
            let of = |other: &&CalibratedMarker| Some(u64::from(other.marker.id)) == id;
            if let Some(calibrated) = calibration.markers.iter().find(of) {
                marker["shift_deviation_m"] = json!(calibrated.shift_deviation_m());
                marker["turn_deviation_rad"] = json!(calibrated.turn_deviation_rad());
                marker["frames"] = json!(calibrated.frames);
            }
        }
    }
    Ok(document)
}
