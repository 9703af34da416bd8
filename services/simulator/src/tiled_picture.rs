//! The image of any camera, tile by tile: the directions of all pixels are computed once.

use nalgebra::Vector3;

use crate::cube::CubeBackdrop;
use crate::density::Density;
use crate::eyes::Eye;
use crate::own_airframe;
use crate::panorama::{Outlook, Panoramas};
use crate::parameters::WorldParameters;
use crate::scene::FrameScene;
use crate::sensor::ImageSensor;
use crate::tiles::{ImageTile, TILE, bands};

/// Pixels of a tile covered by the own airframe: index in row order, and coverage.
type Covered = Vec<(u8, f32)>;

/// The tiles, and all parts that are fixed behind and in front of them.
#[derive(Debug)]
pub(crate) struct TiledPicture {
    width: usize,
    height: usize,
    bands: Vec<Vec<ImageTile>>,
    /// The backdrop in gusts; `None` in calm air, which uses the panoramas.
    cube: Option<CubeBackdrop>,
    panoramas: Panoramas,
    outlooks: Vec<Vec<Outlook>>,
    own_airframe: Vec<Vec<Covered>>,
    /// Level and sigma of pixels of no eye.
    black: [u8; 2],
    /// A band's levels and sigmas, in whole tiles.
    levels: Vec<u8>,
    sigmas: Vec<u8>,
}

impl TiledPicture {
    pub(crate) fn new(parameters: &WorldParameters, eyes: &[Eye], sensor: &ImageSensor) -> Self {
        let (width, height) = (parameters.camera.width(), parameters.camera.height());
        let bands = bands(&parameters.camera, eyes);
        let (panoramas, outlooks) = Panoramas::new(parameters, &bands, sensor);
        let covered = |tile: &ImageTile| {
            if parameters.airframes { covered(tile, parameters) } else { Vec::new() }
        };
        let room = (width as usize).next_multiple_of(TILE) * TILE;
        Self {
            width: width as usize,
            height: height as usize,
            own_airframe: bands.iter().map(|band| band.iter().map(covered).collect()).collect(),
            bands,
            cube: (!parameters.is_calm()).then(|| CubeBackdrop::new(parameters, sensor)),
            panoramas,
            outlooks,
            black: [sensor.level(0.0), sensor.sigma_of_light(0.0)],
            levels: vec![0; room],
            sigmas: vec![0; room],
        }
    }

    /// The density in the eye's tile nearest to `direction`, and the angle of `direction` outside
    /// that tile, radians. `None` if the eye has no tile.
    pub(crate) fn nearest(&self, eye: usize, direction: &Vector3<f64>) -> Option<(Density, f64)> {
        let tiles = self.bands.iter().flatten().filter(|tile| tile.eye == eye);
        let nearness = |tile: &ImageTile| tile.axis.dot(direction);
        let tile = tiles.max_by(|a, b| nearness(a).total_cmp(&nearness(b)))?;
        Some((
            tile.density.moved(direction, &tile.axis),
            (tile.axis.angle(direction) - tile.radius).max(0.0),
        ))
    }

    /// Composites the layers band by band, and adds noise.
    pub(crate) fn expose(
        &mut self,
        scene: FrameScene<'_>,
        sensor: &ImageSensor,
        luma: &mut [u8],
        stride: usize,
    ) {
        let row_length = self.levels.len() / TILE;
        let mut rows = luma.chunks_mut(stride).take(self.height).enumerate();
        let still = self.outlooks.iter().zip(&self.own_airframe);
        for (index, (band, (outlooks, own_airframe))) in self.bands.iter().zip(still).enumerate() {
            self.levels.fill(self.black[0]);
            self.sigmas.fill(self.black[1]);
            for ((tile, outlook), covered) in band.iter().zip(outlooks).zip(own_airframe) {
                let near: Vec<_> = scene
                    .layers
                    .iter()
                    .filter(|(eye, _)| *eye == tile.eye)
                    .map(|(_, drawing)| drawing)
                    .filter(|drawing| drawing.touches(&tile.axis, tile.radius))
                    .collect();
                for row in 0..TILE {
                    let at = row * row_length + tile.column;
                    let levels = &mut self.levels[at..at + TILE];
                    let sigmas = &mut self.sigmas[at..at + TILE];
                    let yaw = scene.camera.yaw();
                    match &self.cube {
                        None => self.panoramas.fill(tile, outlook, row, yaw, levels, sigmas),
                        Some(cube) => {
                            let height = (index * TILE + row) as f64 / self.height as f64;
                            for column in tile.seen_in(row) {
                                let ray = tile.rays[row].map(|axis| f64::from(axis[column]));
                                let seen = cube.of_ray(&scene.camera, &ray.into(), height);
                                [levels[column], sigmas[column]] = seen;
                            }
                        }
                    }
                    for drawing in &near {
                        drawing.draw_rays(&tile.rays[row], sensor, levels, sigmas);
                    }
                }
                for &(index, cover) in covered {
                    let (row, column) = (usize::from(index) / TILE, usize::from(index) % TILE);
                    let at = row * row_length + tile.column + column;
                    own_airframe::blend(cover, sensor, &mut self.levels[at], &mut self.sigmas[at]);
                }
            }
            let written =
                self.levels.chunks_exact(row_length).zip(self.sigmas.chunks_exact(row_length));
            for ((levels, sigmas), (row, out)) in written.zip(&mut rows) {
                let [levels, sigmas] = [levels, sigmas].map(|values| &values[..self.width]);
                sensor.expose(scene.frame, row, 0, levels, sigmas, &mut out[..self.width]);
            }
        }
    }
}

fn covered(tile: &ImageTile, parameters: &WorldParameters) -> Covered {
    let softness = own_airframe::softness(parameters, &tile.density);
    let mut covered = Vec::new();
    for row in 0..TILE {
        for column in tile.seen_in(row) {
            let [x, y, z] = [0, 1, 2].map(|axis| tile.rays[row][axis][column]);
            let cover = own_airframe::cover(y.atan2(x), z.atan2(x.hypot(y)), softness);
            if cover > 0.0 {
                covered.push(((row * TILE + column) as u8, cover));
            }
        }
    }
    covered
}
