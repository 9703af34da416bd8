//! `flockeye calibrate body`: where a body's markers really are, from a recording of it.

use std::collections::BTreeMap;

use anyhow::Context;
use flockeye_contract::{DetectedMarker, DetectionHeader};
use flockeye_geometry::body::Bodies;
use flockeye_geometry::calibration::{
    BodyCalibration, CalibratedMarker, CalibrationOptions, calibrate,
};
use flockeye_geometry::pose::CornerRay;
use nalgebra::{Unit, Vector3};
use serde_json::{Value, json};

use crate::cli::{CalibrateBody, Configuration};
use crate::screen::Screen;
use crate::up::{self, Errand};

/// The rays of every frame of a run, as detection gave them.
#[derive(Debug, Clone, Default)]
pub struct SeenRays {
    /// By epoch and number of the frame.
    frames: BTreeMap<(u64, u64), Vec<CornerRay>>,
}

impl SeenRays {
    /// Adds what was found in one view.
    pub fn add(&mut self, header: &DetectionHeader, markers: &[DetectedMarker]) {
        if markers.is_empty() {
            return;
        }
        let key = (u64::from(header.stamp.epoch), header.stamp.sequence);
        let rays = self.frames.entry(key).or_default();
        for marker in markers {
            rays.extend((0..4).map(|corner| CornerRay {
                marker_id: marker.id,
                corner,
                ray_in_camera: Unit::new_normalize(Vector3::from(marker.rays_in_camera[corner])),
                deviation_rad: marker.deviations[corner],
            }));
        }
    }
}

/// Flies the recording without loss, refines the bodies that are seen in it, and writes them.
///
/// # Errors
/// As `flockeye up`; a body seen too seldom, with what is missing; or a file that cannot be written.
pub fn run(arguments: &CalibrateBody) -> anyhow::Result<()> {
    let path = &arguments.out;
    let mut configuration = arguments.configuration.clone();
    // Every frame is worked on, and nobody is told.
    let instance = format!("calibrate-{}", std::process::id());
    configuration.set.extend([
        "flow=lossless".to_owned(),
        "gateway.enabled=false".to_owned(),
        format!("instance={instance}"),
    ]);
    let bodies = configuration.load()?.bodies()?;
    // Said before the work, not after it.
    let is_new = !path.exists();
    let file = std::fs::OpenOptions::new().create(true).append(true).open(path);
    file.with_context(|| format!("cannot write {}", path.display()))?;
    let outcome = find(configuration, &bodies).and_then(|found| {
        let text = serde_json::to_string_pretty(&document(&bodies, &found)?)? + "\n";
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
    });
    match &outcome {
        Ok(()) => Screen::new().line(&format!("written to {}", path.display())),
        // Nobody takes an empty file for bodies.
        Err(_) if is_new => drop(std::fs::remove_file(path)),
        Err(_) => {}
    }
    outcome
}

/// Flies, and finds the bodies that are seen.
fn find(configuration: Configuration, bodies: &Bodies) -> anyhow::Result<Vec<BodyCalibration>> {
    let pipeline = configuration.load()?;
    let errand = Errand { keeps_rays: true, ..Errand::default() };
    let mut screen = Screen::new();
    let stopping = up::stopped_by_signals()?;
    let flown = up::fly(&pipeline, &errand, &mut screen, &stopping)?;
    let frames: Vec<Vec<CornerRay>> = flown.rays.frames.into_values().collect();
    let (mut found, mut refused) = (Vec::new(), None);
    for body in bodies.iter() {
        let is_seen = |ray: &CornerRay| body.marker(ray.marker_id).is_some();
        if !frames.iter().flatten().any(is_seen) {
            screen.line(&format!("body '{}' is never seen: it stays as designed", body.name));
            continue;
        }
        match calibrate(body, &frames, &CalibrationOptions::default()) {
            Ok(calibration) => {
                screen.line(table(&calibration).trim_end());
                found.push(calibration);
            }
            // One that flies by in the background keeps nobody from calibrating the other.
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

/// What was found, for people.
fn table(calibration: &BodyCalibration) -> String {
    let body = &calibration.body;
    let mut text = format!(
        "body '{}': {} frames, errors of {:.2} stated deviations\n\
         marker   shift mm          turn deg          frames\n",
        body.name, calibration.frames, calibration.scatter
    );
    for found in &calibration.markers {
        text += &format!(
            "{:>6}   {:>6.2} +- {:<6.2}  {:>6.2} +- {:<6.2}  {:>6}\n",
            found.marker.id,
            found.shift_m.norm() * 1e3,
            found.shift_deviation_m() * 1e3,
            found.turn_rad.norm().to_degrees(),
            found.turn_deviation_rad().to_degrees(),
            found.frames,
        );
    }
    for (id, frames) in &calibration.left {
        text += &format!("{id:>6}   seen too seldom: it stays as designed  {frames:>2}\n");
    }
    text
}

/// The bodies file: as it is read, with the deviations of what was found.
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
