//! The equirectangular image, row by row. The backdrop is shifted by whole columns, and most rows
//! have no other content.

use std::f64::consts::TAU;
use std::ops::Range;

use flockeye_geometry::camera::SpherePixel;
use nalgebra::Vector3;

use crate::backdrop::Backdrop;
use crate::blend::Blend;
use crate::cube::CubeBackdrop;
use crate::density::Density;
use crate::eyes::Eye;
use crate::own_airframe::AirframeCover;
use crate::parameters::WorldParameters;
use crate::scene::FrameScene;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;

/// The grid, and all parts that are fixed on it.
#[derive(Debug)]
pub(crate) struct SpherePicture {
    grid: SphereGrid,
    backdrop: Behind,
    own_airframe: Option<AirframeCover>,
    parts: Vec<SpherePart>,
    /// `None` where each pixel shows what one eye sees.
    blend: Option<Blend>,
    /// Levels and sigmas of a row, or of the whole image in gusts: kept between frames to reuse the
    /// memory.
    levels: Vec<u8>,
    sigmas: Vec<u8>,
}

#[derive(Debug)]
enum Behind {
    /// Backdrop of a level observer with constant yaw rate: rows are shifted and copied.
    Calm(Backdrop),
    /// Backdrop of an observer in gusts: pixels are looked up.
    Gusty(CubeBackdrop),
}

/// The part of the image that belongs to one eye.
#[derive(Debug)]
struct SpherePart {
    columns: Vec<Range<usize>>,
    /// Normal of the plane that bounds the eye's hemisphere; `None` for the whole sphere.
    normal: Option<Vector3<f64>>,
}

impl SpherePart {
    fn new(eye: &Eye, grid: &SphereGrid) -> Self {
        let row = grid.height as f64 / 2.0;
        let is_seen = |column: usize| eye.ray(SpherePixel::new(column as f64, row)).is_some();
        let mut columns: Vec<Range<usize>> = Vec::new();
        for column in (0..grid.width).filter(|&column| is_seen(column)) {
            match columns.last_mut() {
                Some(run) if run.end == column => run.end += 1,
                _ => columns.push(column..column + 1),
            }
        }
        // The lens is on its optical axis.
        Self { columns, normal: eye.position_m.try_normalize(0.0) }
    }
}

impl SpherePicture {
    /// The image of the world's camera, with aspect 2:1.
    pub(crate) fn new(parameters: &WorldParameters, eyes: &[Eye], sensor: &ImageSensor) -> Self {
        let camera = &parameters.camera;
        let grid = SphereGrid::new(camera.width() as usize, camera.height() as usize);
        let room = if parameters.is_calm() { grid.width } else { grid.width * grid.height };
        Self {
            backdrop: match parameters.is_calm() {
                true => Behind::Calm(Backdrop::new(parameters, &grid, sensor)),
                false => Behind::Gusty(CubeBackdrop::new(parameters, sensor)),
            },
            own_airframe: parameters
                .airframes
                .then(|| AirframeCover::new(&grid, parameters.lens_blur_px, sensor)),
            blend: parameters.stitch.as_ref().map(Blend::new),
            parts: eyes.iter().map(|eye| SpherePart::new(eye, &grid)).collect(),
            levels: vec![0; room],
            sigmas: vec![0; room],
            grid,
        }
    }

    /// The density, which is constant, and the angle of `direction` outside the eye's part,
    /// radians.
    pub(crate) fn nearest(&self, eye: usize, direction: &Vector3<f64>) -> (Density, f64) {
        let apart = self.parts[eye]
            .normal
            .map_or(0.0, |normal| (-normal.dot(direction)).clamp(0.0, 1.0).asin());
        let apart = (apart - self.blend.as_ref().map_or(0.0, Blend::half_rad)).max(0.0);
        (Density::Even(self.grid.width as f64 / TAU), apart)
    }

    /// Composites the layers row by row, and adds noise.
    pub(crate) fn expose(
        &mut self,
        scene: FrameScene<'_>,
        sensor: &ImageSensor,
        luma: &mut [u8],
        stride: usize,
    ) {
        let width = self.grid.width;
        let turned = (scene.camera.yaw() / TAU * width as f64).round() as i64;
        let shift = turned.rem_euclid(width as i64) as usize;
        if let Behind::Gusty(backdrop) = &self.backdrop {
            backdrop.fill(&self.grid, &scene.camera, &mut self.levels, &mut self.sigmas);
        }
        let layers: Vec<_> = scene
            .layers
            .iter()
            .map(|&(eye, drawing)| (eye, drawing, drawing.rows(&self.grid)))
            .collect();
        for (row, out) in luma.chunks_mut(stride).take(self.grid.height).enumerate() {
            let out = &mut out[..width];
            let own_airframe = self.own_airframe.as_ref().filter(|own| own.touches(row));
            let place = match &self.backdrop {
                Behind::Calm(_) => 0..width,
                Behind::Gusty(_) => row * width..(row + 1) * width,
            };
            let levels = &mut self.levels[place.clone()];
            let sigmas = &mut self.sigmas[place];
            if let Behind::Calm(backdrop) = &self.backdrop {
                let [left, right] = backdrop.row(row, shift);
                let is_kept = self.blend.as_ref().is_none_or(Blend::keeps_backdrop);
                if is_kept
                    && own_airframe.is_none()
                    && layers.iter().all(|(_, _, rows)| !rows.contains(&row))
                {
                    let (out_left, out_right) = out.split_at_mut(shift);
                    sensor.expose(scene.frame, row, 0, left.0, left.1, out_left);
                    sensor.expose(scene.frame, row, shift, right.0, right.1, out_right);
                    continue;
                }
                levels[..shift].copy_from_slice(left.0);
                levels[shift..].copy_from_slice(right.0);
                sigmas[..shift].copy_from_slice(left.1);
                sigmas[shift..].copy_from_slice(right.1);
            }
            let in_row = layers.iter().filter(|(_, _, rows)| rows.contains(&row));
            if let Some(blend) = &mut self.blend {
                let whole = 0..width;
                let whole = std::slice::from_ref(&whole);
                blend.row(row, &self.grid, sensor, levels, sigmas, |lens, levels, sigmas| {
                    for (_, drawing, _) in in_row.clone().filter(|(eye, ..)| *eye == lens) {
                        drawing.draw_row(row, whole, &self.grid, sensor, levels, sigmas);
                    }
                });
            } else {
                for (eye, drawing, _) in in_row {
                    let columns = &self.parts[*eye].columns;
                    drawing.draw_row(row, columns, &self.grid, sensor, levels, sigmas);
                }
            }
            if let Some(own_airframe) = own_airframe {
                own_airframe.draw_row(row, sensor, levels, sigmas);
            }
            sensor.expose(scene.frame, row, 0, levels, sigmas, out);
        }
        if let Some(blend) = &self.blend {
            blend.sharpen(luma, stride, [width, self.grid.height]);
        }
    }
}
