//! A painted hall that a simulator's process leaves to the next one, which then starts in half of the time.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::parameters::WorldParameters;
use crate::sphere::SphereGrid;

/// Rises when the hall is painted in another way.
const PAINTER: u64 = 1;

/// Where one painting is kept.
#[derive(Debug)]
pub struct KeptPainting(PathBuf);

impl KeptPainting {
    /// The painting of this world on this grid, with so many columns swept in an exposure. `None` where
    /// nothing is kept.
    pub fn of(parameters: &WorldParameters, grid: &SphereGrid, swept: f64) -> Option<Self> {
        let folder = parameters.paint_folder.as_deref()?;
        let all = [
            PAINTER,
            parameters.seed,
            grid.width as u64,
            grid.height as u64,
            parameters.lens_blur_px.to_bits(),
            swept.to_bits(),
        ];
        // FNV-1a (Fowler, Noll, Vo), the same in every process.
        let digest = all
            .iter()
            .flat_map(|part| part.to_le_bytes())
            .fold(0xcbf2_9ce4_8422_2325_u64, |digest, byte| {
                (digest ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
            });
        Some(Self(folder.join(format!("painting-{digest:016x}"))))
    }

    /// What was kept, if that is a painting of `pixels` pixels.
    pub fn read(&self, pixels: usize) -> Option<Vec<f32>> {
        let bytes = fs::read(&self.0).ok()?;
        let (chunks, rest) = bytes.as_chunks::<4>();
        let is_whole = chunks.len() == pixels && rest.is_empty();
        is_whole.then(|| chunks.iter().map(|chunk| f32::from_le_bytes(*chunk)).collect())
    }

    /// Keeps a painting. Where that cannot be, the next process paints it again.
    pub fn write(&self, light: &[f32]) {
        let bytes: Vec<u8> = light.iter().flat_map(|light| light.to_le_bytes()).collect();
        if let Err(error) = write_whole(&self.0, &bytes) {
            tracing::debug!("the painted hall is not kept: {}: {error}", self.0.display());
        }
    }
}

/// A process that is killed meanwhile leaves no half of it.
fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    let fresh = path.with_extension("new");
    fs::write(&fresh, bytes).and_then(|()| fs::rename(&fresh, path)).inspect_err(|_| {
        // On a full disk, half of it would only be in the way.
        fs::remove_file(&fresh).ok();
    })
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
        let kept = KeptPainting::of(&parameters, &grid, 0.5).unwrap();
        assert_eq!(kept.read(32), None);
        let light: Vec<f32> = (0..32).map(|pixel| pixel as f32 / 7.0).collect();
        kept.write(&light);
        assert_eq!(kept.read(32), Some(light));
        assert_eq!(kept.read(33), None);
        for other in [
            KeptPainting::of(&WorldParameters { seed: 77, ..parameters.clone() }, &grid, 0.5),
            KeptPainting::of(&parameters, &grid, 0.6),
            KeptPainting::of(&parameters, &SphereGrid::new(4, 8), 0.5),
        ] {
            assert_eq!(other.unwrap().read(32), None);
        }
        assert!(KeptPainting::of(&WorldParameters::default(), &grid, 0.5).is_none());
        fs::remove_dir_all(folder).unwrap();
    }
}
