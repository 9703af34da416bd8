//! The configured camera: its model, its curve, and what it cannot see.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use flockeye_contract::Transfer;
use flockeye_geometry::camera::{Camera, CameraModel, Lens, LensCurve};
use flockeye_geometry::mask::{Mask, MaskError};
use nalgebra::Vector2;

use super::mount::isometry;
use crate::types::{self, FisheyeLens, Pipeline, Response};

/// A setting of the camera that cannot be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key}: {reason}")]
pub struct CameraSettingError {
    /// Its key in the configuration.
    pub key: String,
    /// What is wrong with it, and the cure.
    pub reason: String,
}

impl CameraSettingError {
    fn new(key: impl Into<String>, reason: impl Into<String>) -> Self {
        Self { key: key.into(), reason: reason.into() }
    }
}

/// Why `camera.mask` cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MaskFileError {
    /// The camera itself cannot be.
    #[error(transparent)]
    Camera(#[from] CameraSettingError),
    /// The file cannot be opened.
    #[error("camera.mask: cannot open {path}: {error}")]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        error: std::io::Error,
    },
    /// The file is no picture.
    #[error("camera.mask: {path} is no PNG image: {error}")]
    Decode {
        /// The file.
        path: PathBuf,
        /// The decoder's reason.
        error: png::DecodingError,
    },
    /// The picture does not fit the frames.
    #[error("camera.mask: {path}: {error}")]
    Size {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        error: MaskError,
    },
}

/// Pixels of a mask darker than this are hidden.
const HIDDEN_BELOW: u8 = 128;

impl Pipeline {
    /// The camera model, right for `camera.assumed_distance_m`.
    ///
    /// # Errors
    /// A setting of which there is no camera.
    pub fn camera_model(&self) -> Result<Camera, CameraSettingError> {
        let camera = &self.camera;
        let model = match camera.projection {
            types::CameraModel::Equirectangular => {
                if camera.width != 2 * camera.height {
                    let (width, height) = (camera.width, camera.height);
                    return Err(CameraSettingError::new(
                        "camera.width",
                        format!(
                            "an equirectangular image is twice as wide as high, not {width}x{height}"
                        ),
                    ));
                }
                CameraModel::Equirectangular { lens_distance_m: camera.lens_distance_m }
            }
            types::CameraModel::DualFisheye => {
                let [one, other] = camera.lenses.as_slice() else {
                    return Err(CameraSettingError::new(
                        "camera.lenses",
                        format!(
                            "a dual fisheye camera has two lenses, not {}. Cure: list both, as \
                             docs/CAMERAS.md shows, or set camera.projection to what the camera \
                             sends",
                            camera.lenses.len()
                        ),
                    ));
                };
                CameraModel::DualFisheye([lens(0, one)?, lens(1, other)?])
            }
            types::CameraModel::Stereographic => CameraModel::Stereographic {
                field_rad: camera.stereographic_field_deg.to_radians(),
            },
        };
        let key = match camera.projection {
            types::CameraModel::Equirectangular => "camera.lens_distance_m",
            types::CameraModel::DualFisheye => "camera.lenses",
            types::CameraModel::Stereographic => "camera.stereographic_field_deg",
        };
        let model = Camera::new(camera.width, camera.height, model)
            .map_err(|error| CameraSettingError::new(key, error.to_string()))?;
        Ok(model.at_distance(camera.assumed_distance_m))
    }

    /// The code of the camera's transfer curve, and its gamma where it has one.
    pub fn transfer(&self) -> (Transfer, f32) {
        match self.camera.response {
            Response::Srgb => (Transfer::Srgb, 0.0),
            Response::Gamma => (Transfer::Gamma, self.camera.gamma),
            Response::Linear => (Transfer::Linear, 0.0),
            Response::Table => (Transfer::Table, 0.0),
        }
    }

    /// The light of each code where the camera's response was measured; `None` for the curves that
    /// headers name.
    ///
    /// # Errors
    /// As [`Pipeline::response_table`].
    pub fn measured_response(&self) -> Result<Option<[f32; 256]>, CameraSettingError> {
        match self.camera.response {
            Response::Table => self.response_table().map(Some),
            Response::Srgb | Response::Gamma | Response::Linear => Ok(None),
        }
    }

    /// `camera.response_table` for each code, interpolated: white is 1.
    ///
    /// # Errors
    /// Fewer than two entries, or entries that do not rise.
    pub fn response_table(&self) -> Result<[f32; 256], CameraSettingError> {
        let given = &self.camera.response_table;
        let fault = |reason: String| Err(CameraSettingError::new("camera.response_table", reason));
        if given.len() < 2 {
            return fault(format!(
                "response: table needs the light of 2 to 256 codes, not of {}",
                given.len()
            ));
        }
        // NaN rises nowhere.
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
        // Steps too small, or numbers too large, for what works with it.
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

    /// What the camera sees: everything its image circles hold, less what `camera.mask` hides.
    ///
    /// # Errors
    /// The file cannot be read, or is of another size than the frames.
    pub fn mask(&self) -> Result<Mask, MaskFileError> {
        let camera = self.camera_model()?;
        let Some(path) = &self.camera.mask else { return Ok(Mask::nothing_hidden(camera)) };
        let (sides, seen) = read_mask(path, &camera)?;
        Mask::new(camera, sides, seen)
            .map_err(|error| MaskFileError::Size { path: path.clone(), error })
    }
}

fn lens(index: usize, lens: &FisheyeLens) -> Result<Lens, CameraSettingError> {
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
            return Err(CameraSettingError::new(format!("camera.lenses.{index}"), reason));
        }
    };
    let is_calibrated = curve != LensCurve::Equidistant([0.0; 4]);
    if is_calibrated && lens.focal_px.is_none() {
        let reason = "a calibrated curve needs the focal lengths it was calibrated with";
        return Err(CameraSettingError::new(key("focal_px"), reason));
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

/// The sides of a mask's picture, and, if they are the camera's, which of its pixels are bright, row
/// by row.
fn read_mask(path: &Path, camera: &Camera) -> Result<([u32; 2], Vec<bool>), MaskFileError> {
    let open = |error| MaskFileError::Open { path: path.to_owned(), error };
    let decode = |error| MaskFileError::Decode { path: path.to_owned(), error };
    let file = BufReader::new(File::open(path).map_err(open)?);
    let mut decoder = png::Decoder::new(file);
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(decode)?;
    let (width, height) = reader.info().size();
    if (width, height) != (camera.width(), camera.height()) {
        // Before memory is made for it.
        return Ok(([width, height], Vec::new()));
    }
    let Some(bytes) = reader.output_buffer_size() else {
        return Err(decode(png::DecodingError::LimitsExceeded));
    };
    let mut pixels = vec![0; bytes];
    let info = reader.next_frame(&mut pixels).map_err(decode)?;
    let channels = info.color_type.samples();
    // Of a colour picture any bright channel counts; transparency does not.
    let colours = match channels {
        1 | 2 => 1,
        _ => 3,
    };
    let seen = pixels[..info.buffer_size()]
        .chunks_exact(channels)
        .map(|pixel| pixel[..colours].iter().any(|&value| value >= HIDDEN_BELOW))
        .collect();
    Ok(([info.width, info.height], seen))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    /// A mask in the folder for temporary files, for one test to write and to remove.
    fn write_mask(name: &str, width: u32, height: u32, pixels: &[u8]) -> PathBuf {
        let path = std::env::temp_dir().join(format!("flockeye-{}-{name}", std::process::id()));
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), width, height);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(pixels).unwrap();
        path
    }

    fn pipeline(path: PathBuf) -> Pipeline {
        let mut pipeline = Pipeline::default();
        (pipeline.camera.width, pipeline.camera.height) = (128, 64);
        pipeline.camera.mask = Some(path);
        pipeline
    }

    #[test]
    fn a_mask_is_read_from_its_picture() {
        // The lower half is hidden.
        let pixels: Vec<u8> = (0..64 * 128).map(|k| if k / 128 < 32 { 255 } else { 0 }).collect();
        let path = write_mask("half.png", 128, 64, &pixels);
        let mask = pipeline(path.clone()).mask().unwrap();
        assert!(
            mask.hides(&-nalgebra::Vector3::z_axis()) && !mask.hides(&nalgebra::Vector3::z_axis())
        );
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn masks_that_cannot_be_used_are_refused_by_name() {
        let path = write_mask("small.png", 10, 5, &[255; 50]);
        let message = pipeline(path.clone()).mask().unwrap_err().to_string();
        for part in ["camera.mask", "small.png", "10x5", "128x64"] {
            assert!(message.contains(part), "{message}");
        }
        std::fs::write(&path, b"no picture").unwrap();
        let message = pipeline(path.clone()).mask().unwrap_err().to_string();
        assert!(message.contains("is no PNG image"), "{message}");
        std::fs::remove_file(&path).unwrap();
        let message = pipeline(path).mask().unwrap_err().to_string();
        assert!(message.contains("cannot open"), "{message}");
    }

    #[test]
    fn a_table_is_interpolated_between_its_entries() {
        let mut pipeline = Pipeline::default();
        pipeline.camera.response_table = vec![1.0, 2.0, 5.0];
        let table = pipeline.response_table().unwrap();
        assert_eq!((table[0], table[255]), (0.0, 1.0));
        assert!((table[64] - 0.25 * 64.0 / 127.5).abs() < 1e-6, "{}", table[64]);
        assert!(table.windows(2).all(|pair| pair[1] > pair[0]));
    }
}
