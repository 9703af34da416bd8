//! Mask of the pixels that the configured camera cannot see.

use std::fs::File;
use std::io::{self, BufReader};
use std::path::Path;

use flockeye_geometry::camera::Camera;
use flockeye_geometry::mask::Mask;

use super::error::SettingError;

const KEY: &str = "camera.mask";

/// Limit of a mask's pixel values below which a pixel is hidden.
const HIDDEN_BELOW: u8 = 128;

/// Visible pixels: all of the image circles, except those that the picture at `path`
/// (`camera.mask`) hides.
///
/// # Errors
/// The file cannot be read, or is of another size than the frames.
pub(crate) fn mask(path: Option<&Path>, camera: &Camera) -> Result<Mask, SettingError> {
    let Some(path) = path else { return Ok(Mask::nothing_hidden(*camera)) };
    let (sides, seen) = read_mask(path, camera)?;
    Mask::new(*camera, sides, seen)
        .map_err(|error| SettingError::new(KEY, format!("{}: {error}", path.display())))
}

/// Size of a mask's picture, and its bright pixels row by row if the size is the camera's.
fn read_mask(path: &Path, camera: &Camera) -> Result<([u32; 2], Vec<bool>), SettingError> {
    let path_text = path.display();
    let open =
        |error: io::Error| SettingError::new(KEY, format!("cannot open {path_text}: {error}"));
    let decode = |error: png::DecodingError| {
        SettingError::new(KEY, format!("{path_text} is no PNG image: {error}"))
    };
    let file = BufReader::new(File::open(path).map_err(open)?);
    let mut decoder = png::Decoder::new(file);
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(decode)?;
    let (width, height) = reader.info().size();
    if (width, height) != (camera.width(), camera.height()) {
        // Wrong sizes are refused before memory for them is allocated.
        return Ok(([width, height], Vec::new()));
    }
    let Some(bytes) = reader.output_buffer_size() else {
        return Err(decode(png::DecodingError::LimitsExceeded));
    };
    let mut pixels = vec![0; bytes];
    let info = reader.next_frame(&mut pixels).map_err(decode)?;
    let channels = info.color_type.samples();
    // In a colour picture any bright channel counts; transparency does not.
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
    use flockeye_geometry::camera::CameraModel;
    use std::path::PathBuf;

    /// A mask in the folder for temporary files, for one test to write and to remove.
    fn write_mask(name: &str, width: u32, height: u32, pixels: &[u8]) -> PathBuf {
        let path = std::env::temp_dir().join(format!("flockeye-{}-{name}", std::process::id()));
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), width, height);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(pixels).unwrap();
        path
    }

    fn read(path: &Path) -> Result<Mask, SettingError> {
        let model = CameraModel::Equirectangular { lens_distance_m: 0.0 };
        mask(Some(path), &Camera::new(128, 64, model).unwrap())
    }

    #[test]
    fn a_mask_is_read_from_its_picture() {
        // The lower half is hidden.
        let pixels: Vec<u8> = (0..64 * 128).map(|k| if k / 128 < 32 { 255 } else { 0 }).collect();
        let path = write_mask("half.png", 128, 64, &pixels);
        let mask = read(&path).unwrap();
        assert!(
            mask.hides(&-nalgebra::Vector3::z_axis()) && !mask.hides(&nalgebra::Vector3::z_axis())
        );
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn masks_that_cannot_be_used_are_refused_by_name() {
        let path = write_mask("small.png", 10, 5, &[255; 50]);
        let message = read(&path).unwrap_err().to_string();
        for part in ["camera.mask", "small.png", "10x5", "128x64"] {
            assert!(message.contains(part), "{message}");
        }
        std::fs::write(&path, b"no picture").unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(message.contains("is no PNG image"), "{message}");
        std::fs::remove_file(&path).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(message.contains("cannot open"), "{message}");
    }
}
