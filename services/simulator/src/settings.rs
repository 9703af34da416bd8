//! The world for a configuration.

use std::path::Path;

use anyhow::Context as _;
use flockeye_config::{Resolved, Simulator};
use flockeye_convert::transfer_curve;
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::Bodies;

use crate::parameters::SwarmPlace;
use crate::{CameraCurve, World, WorldParameters};

/// The world, and its flying bodies. The painted panorama is kept in `paint_folder` for the next
/// process.
pub(crate) fn world(
    resolved: &Resolved,
    paint_folder: &Path,
) -> anyhow::Result<(World, Option<Bodies>)> {
    let flying = flying_bodies(resolved)?;
    let paint_folder = Some(paint_folder.to_owned());
    let parameters = WorldParameters { paint_folder, ..parameters(resolved)? };
    let world = match &flying {
        Some(bodies) => World::new(parameters, bodies, &Dictionary::of(bodies)?)?,
        None => World::empty(parameters)?,
    };
    Ok((world, flying))
}

/// The flying bodies: the first of the configured ones. `None` without neighbours.
///
/// # Errors
/// Fewer bodies than neighbours, or a file of bodies that cannot be read.
pub fn flying_bodies(resolved: &Resolved) -> anyhow::Result<Option<Bodies>> {
    let all = resolved.simulated_bodies()?;
    let count = resolved.pipeline.simulator.neighbours as usize;
    anyhow::ensure!(
        count <= all.len(),
        "simulator.neighbours: {count} neighbours, but {} bodies are configured",
        all.len()
    );
    if count == 0 {
        return Ok(None);
    }
    let bodies = all.iter().take(count).cloned().collect();
    Ok(Some(Bodies::new(all.dictionary.clone(), bodies)?))
}

/// The parameters of the world.
///
/// # Errors
/// A response that was not measured, or an impossible lens.
pub fn parameters(resolved: &Resolved) -> anyhow::Result<WorldParameters> {
    let (settings, usual) = (&resolved.pipeline.simulator, WorldParameters::default());
    let (transfer, gamma) = resolved.transfer;
    let curve = transfer_curve(transfer, gamma).map(CameraCurve::Curve);
    let response = curve
        .or(resolved.measured_response.map(CameraCurve::Table))
        .context("camera.response: a table was not measured")?;
    let tone = settings.stitch.map_or(0.0, |stitch| stitch.tone);
    let response = if tone > 0.0 { response.bent(tone) } else { response };
    Ok(WorldParameters {
        seed: u64::from(settings.seed),
        camera: resolved.simulated_camera()?,
        response,
        frames_per_second: settings.frames_per_second,
        exposure_s: settings.exposure_ms * 1e-3,
        exposure_stops: settings.exposure_stops,
        exposure_swing_stops: settings.exposure_swing_stops,
        sun: settings.sun,
        stitch: settings.stitch,
        read_noise: usual.read_noise * settings.noise,
        shot_noise: usual.shot_noise * settings.noise,
        observer_yaw_rate_deg_s: settings.yaw_deg_s,
        tilt_deg: settings.tilt_deg,
        yaw_swing_deg_s: settings.yaw_swing_deg_s,
        readout_s: resolved.pipeline.camera.readout_ms * 1e-3,
        distance_m: settings.distance_m,
        speed_m_s: settings.speed_m_s,
        airframes: settings.airframes,
        swarm: settings.swarm.map(|swarm| SwarmPlace {
            drone: swarm.drone,
            drones: settings.neighbours + 1,
            start_ns: swarm.start_ns,
            observer_from_camera_m: resolved.observer_from_camera.translation.vector.into(),
        }),
        ..usual
    })
}

/// A summary of the simulation, for people.
pub(crate) fn in_words(settings: &Simulator) -> String {
    let Simulator { neighbours, frames_per_second, seed, swarm, .. } = settings;
    let place = swarm.map(|swarm| format!(", drone {} of a swarm", swarm.drone));
    let place = place.unwrap_or_default();
    format!("{neighbours} neighbours, {frames_per_second} frames/s, seed {seed}{place}")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_config::Pipeline;

    #[test]
    fn neighbours_fly_as_fast_as_configured() {
        let speed_m_s = |set: &str| {
            let set = [format!("simulator.{set}")];
            let resolved = Resolved::of(Pipeline::parse("", &set, "a test").unwrap()).unwrap();
            let (world, _) = world(&resolved, &std::env::temp_dir()).unwrap();
            let places = (0..3000).map(|k| {
                let moment = world.moment(f64::from(k) * 0.02);
                let turned = moment.camera.world_from_camera;
                turned * moment.placements[0].camera_from_markers.translation.vector
            });
            let places: Vec<_> = places.collect();
            places.windows(2).map(|two| (two[1] - two[0]).norm() / 0.02).fold(0.0, f64::max)
        };
        for (set, expected) in [("speed_m_s=2.4", 2.4), ("speed_m_s=0", 0.0), ("seed=1", 0.8)] {
            let fastest = speed_m_s(set);
            assert!((fastest - expected).abs() < 0.05 * expected + 1e-9, "{set}: {fastest}");
        }
    }
}
