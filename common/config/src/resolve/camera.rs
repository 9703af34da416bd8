//! The configured camera: its model and its transfer curve.

use flockeye_contract::{Projection, Transfer};
use flockeye_geometry::camera::{Camera, CameraModel, Lens, LensCurve};
use nalgebra::Vector2;

use super::error::SettingError;
use super::mount::isometry;
use crate::types::{CameraSettings, FisheyeLens, Pipeline};

/// The camera model, exact for `camera.assumed_distance_m`.
///
/// # Errors
/// Settings that describe no possible camera.
pub(crate) fn camera(settings: &CameraSettings) -> Result<Camera, SettingError> {
    let model = match settings.projection {
        Projection::Equirectangular => {
            if settings.width != 2 * settings.height {
                let (width, height) = (settings.width, settings.height);
                return Err(SettingError::new(
                    "camera.width",
                    format!(
                        "an equirectangular image is twice as wide as high, not {width}x{height}"
                    ),
                ));
            }
            let lens_distance_m = settings.lens_distance_m.unwrap_or(0.0);
            CameraModel::Equirectangular { lens_distance_m }
        }
        Projection::DualFisheye => {
            let [one, other] = settings.lenses.as_slice() else {
                return Err(SettingError::new(
                    "camera.lenses",
                    format!(
                        "a dual fisheye camera has two lenses, not {}. Cure: list both, as \
                         docs/CAMERAS.md shows, or set camera.projection to what the camera \
                         sends",
                        settings.lenses.len()
                    ),
                ));
            };
            CameraModel::DualFisheye([lens(0, one)?, lens(1, other)?])
        }
        Projection::Stereographic => {
            CameraModel::Stereographic { field_rad: settings.stereographic_field_deg.to_radians() }
        }
    };
    let key = match settings.projection {
        Projection::Equirectangular => "camera.lens_distance_m",
        Projection::DualFisheye => "camera.lenses",
        Projection::Stereographic => "camera.stereographic_field_deg",
    };
    let model = Camera::new(settings.width, settings.height, model)
        .map_err(|error| SettingError::new(key, error))?;
    Ok(model.at_distance(settings.assumed_distance_m))
}

/// Camera of the simulator: the configured one with the lenses of `simulator`, where it has some.
///
/// # Errors
/// Settings that describe no possible camera, with their keys in `simulator`.
pub(crate) fn simulated_camera(pipeline: &Pipeline) -> Result<Camera, SettingError> {
    let simulator = &pipeline.simulator;
    let mut settings = pipeline.camera.clone();
    settings.lens_distance_m = simulator.lens_distance_m.or(settings.lens_distance_m);
    if !simulator.lenses.is_empty() {
        settings.lenses.clone_from(&simulator.lenses);
    }
    camera(&settings).map_err(|SettingError { key, reason }| {
        // Other settings are the camera's.
        let is_own = match key.strip_prefix("camera.") {
            Some("lens_distance_m") => simulator.lens_distance_m.is_some(),
            Some(rest) => rest.starts_with("lenses") && !simulator.lenses.is_empty(),
            None => false,
        };
        let key = if is_own { key.replacen("camera", "simulator", 1) } else { key };
        SettingError { key, reason }
    })
}

/// Transfer curve of the camera, and its gamma where it has one. It is sRGB where none is stated.
pub(crate) fn transfer(settings: &CameraSettings) -> (Transfer, f32) {
    let response = settings.response.unwrap_or(Transfer::Srgb);
    (response, if response == Transfer::Gamma { settings.gamma } else { 0.0 })
}

/// The radiance of each code if the camera's response is a measured table; `None` for the curves
/// that headers name.
///
/// # Errors
/// As [`response_table`].
pub(crate) fn measured_response(
    settings: &CameraSettings,
) -> Result<Option<[f32; 256]>, SettingError> {
    match settings.response {
        Some(Transfer::Table) => response_table(settings).map(Some),
        Some(Transfer::Srgb | Transfer::Gamma | Transfer::Linear) | None => Ok(None),
    }
}

/// `camera.response_table` for each code, interpolated: white is 1.
///
/// # Errors
/// Fewer than two entries, or entries that do not rise.
pub(crate) fn response_table(settings: &CameraSettings) -> Result<[f32; 256], SettingError> {
    let given = &settings.response_table;
    let fault = |reason: String| Err(SettingError::new("camera.response_table", reason));
    if given.len() < 2 {
        return fault(format!(
            "response: table needs the light of 2 to 256 codes, not of {}",
            given.len()
        ));
    }
    // Comparisons with NaN are false, so NaN is refused too.
    let rises = |pair: &[f64]| pair[1] > pair[0];
    if let Some(at) = given.windows(2).position(|pair| !rises(pair)) {
        let (before, after) = (given[at], given[at + 1]);
        return fault(format!(
            "a brighter code stands for more light, but entry {} is {after} after {before}",
            at + 1
        ));
    }
    let (black, white) = (given[0], given[given.len() - 1]);
    let table: [f32; 256] = std::array::from_fn(|code| {
        let place = code as f64 / 255.0 * (given.len() - 1) as f64;
        let below = (place as usize).min(given.len() - 2);
        let share = place - below as f64;
        let light = given[below] + share * (given[below + 1] - given[below]);
        ((light - black) / (white - black)) as f32
    });
    // In single precision, very small steps vanish.
    let rises = |pair: &[f32]| pair[1] > pair[0];
    match table.windows(2).position(|pair| !rises(pair)) {
        None => Ok(table),
        Some(code) => fault(format!(
            "from code {code} to {} the light does not rise by anything that single precision \
             can tell",
            code + 1
        )),
    }
}

fn lens(index: usize, lens: &FisheyeLens) -> Result<Lens, SettingError> {
    let key = |name: &str| format!("camera.lenses.{index}.{name}");
    let curve = match (lens.equidistant, lens.double_sphere, lens.unified) {
        (None, None, None) => LensCurve::Equidistant([0.0; 4]),
        (Some(terms), None, None) => LensCurve::Equidistant(terms),
        (None, Some([xi, alpha]), None) => LensCurve::DoubleSphere { xi, alpha },
        (None, None, Some([xi, k1, k2, p1, p2])) => {
            LensCurve::Unified { xi, distortion: [k1, k2, p1, p2] }
        }
        _ => {
            let reason = "a lens has one curve: keep one of equidistant, double_sphere and unified";
            return Err(SettingError::new(format!("camera.lenses.{index}"), reason));
        }
    };
    let is_calibrated = curve != LensCurve::Equidistant([0.0; 4]);
    if is_calibrated && lens.focal_px.is_none() {
        let reason = "a calibrated curve needs the focal lengths it was calibrated with";
        return Err(SettingError::new(key("focal_px"), reason));
    }
    let filling = Lens::equidistant(
        isometry(&lens.camera_from_lens),
        lens.centre_px.into(),
        lens.circle_px,
        lens.field_deg.to_radians(),
    );
    let focal_px = lens.focal_px.map_or(filling.focal_px, Vector2::from);
    Ok(Lens { focal_px, curve, ..filling })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn the_simulated_camera_has_its_own_lenses() {
        let pipeline = |overrides: &[&str]| {
            let overrides: Vec<String> = overrides.iter().map(|&text| text.into()).collect();
            Pipeline::parse("", &overrides, "x")
        };
        let distance = |camera: Camera| match camera.model() {
            CameraModel::Equirectangular { lens_distance_m } => *lens_distance_m,
            model => panic!("{model:?}"),
        };
        let believed = ["camera.lens_distance_m=0.01"];
        let real = ["camera.lens_distance_m=0.01", "simulator.lens_distance_m=0.016"];
        for (settings, wanted) in [(&believed[..], 0.01), (&real, 0.016)] {
            let pipeline = pipeline(settings).unwrap();
            assert_eq!(distance(simulated_camera(&pipeline).unwrap()), wanted);
            assert_eq!(distance(camera(&pipeline.camera).unwrap()), 0.01);
        }
        let lens = "{centre_px: [959, 959], circle_px: 900, field_deg: 190, camera_from_lens: {}}";
        let second = lens.replace("959, 959", "2879, 959");
        let sets = |which: &str, list: &str| format!("{which}.lenses=[{list}]");
        let both = sets("camera", &format!("{lens}, {second}"));
        let dual = "camera.projection=dual_fisheye";
        let moved = second.replace("{}", "{position: [0.01, 0, 0]}");
        let drawn = pipeline(&[dual, &both, &sets("simulator", &format!("{lens}, {moved}"))]);
        let drawn = simulated_camera(&drawn.unwrap()).unwrap().lens_positions().unwrap();
        assert_eq!(drawn[1].x, 0.01);
        let error = pipeline(&[dual, &both, &sets("simulator", lens)]).unwrap_err().to_string();
        assert!(error.contains("simulator.lenses: a dual fisheye camera has two"), "{error}");
    }

    #[test]
    fn a_table_is_interpolated_between_its_entries() {
        let response_table = vec![1.0, 2.0, 5.0];
        let settings = CameraSettings { response_table, ..CameraSettings::default() };
        let table = super::response_table(&settings).unwrap();
        assert_eq!((table[0], table[255]), (0.0, 1.0));
        assert!((table[64] - 0.25 * 64.0 / 127.5).abs() < 1e-6, "{}", table[64]);
        assert!(table.windows(2).all(|pair| pair[1] > pair[0]));
    }
}
