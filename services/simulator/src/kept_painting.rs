//! The painted hall as a file, so that the next simulator process need not paint it again.

use std::fs;
use std::path::{Path, PathBuf};

use flockeye_runtime::whole_file::write_whole;

use crate::parameters::WorldParameters;
use crate::sphere::SphereGrid;

/// Version of the painting code: increase it when the painted hall changes.
const PAINTER: u64 = 1;

/// Path of the painting of this world on this grid; `swept`: columns that motion blur covers in an
/// exposure. `None` without a folder.
pub(crate) fn path(parameters: &WorldParameters, grid: &SphereGrid, swept: f64) -> Option<PathBuf> {
    let folder = parameters.paint_folder.as_deref()?;
    let (seed, width, height) = (parameters.seed, grid.width, grid.height);
    let [blur, swept] = [parameters.lens_blur_px, swept].map(f64::to_bits);
    let name = format!("painting-{PAINTER}-{seed}-{width}x{height}-{blur:x}-{swept:x}");
    Some(folder.join(name))
}

/// The painting in a file, if it has `pixels` pixels.
pub(crate) fn read(path: &Path, pixels: usize) -> Option<Vec<f32>> {
    let bytes = fs::read(path).ok()?;
    let (chunks, rest) = bytes.as_chunks::<4>();
    let is_whole = chunks.len() == pixels && rest.is_empty();
    is_whole.then(|| chunks.iter().map(|chunk| f32::from_le_bytes(*chunk)).collect())
}

/// Writes a painting. If that fails, the next process paints it again.
pub(crate) fn write(path: &Path, light: &[f32]) {
    let bytes: Vec<u8> = light.iter().flat_map(|light| light.to_le_bytes()).collect();
    let made = path.parent().map_or(Ok(()), fs::create_dir_all);
    if let Err(error) = made.and_then(|()| write_whole(path, &bytes)) {
        tracing::debug!("the painted hall is not kept: {}: {error}", path.display());
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_painting_is_kept_for_the_same_world_alone_and_only_whole() {
        let folder = std::env::temp_dir().join(format!("flock-painting-{}", std::process::id()));
        let parameters =
            WorldParameters { paint_folder: Some(folder.clone()), ..WorldParameters::default() };
        let grid = SphereGrid::new(8, 4);
        let kept = path(&parameters, &grid, 0.5).unwrap();
        assert_eq!(read(&kept, 32), None);
        let light: Vec<f32> = (0..32).map(|pixel| pixel as f32 / 7.0).collect();
        write(&kept, &light);
        assert_eq!(read(&kept, 32), Some(light));
        assert_eq!(read(&kept, 33), None);
        for other in [
            path(&WorldParameters { seed: 77, ..parameters.clone() }, &grid, 0.5),
            path(&parameters, &grid, 0.6),
            path(&parameters, &SphereGrid::new(4, 8), 0.5),
        ] {
            assert_eq!(read(&other.unwrap(), 32), None);
        }
        assert!(path(&WorldParameters::default(), &grid, 0.5).is_none());
        fs::remove_dir_all(folder).unwrap();
    }
}
