//! What the tests share: recordings with ground truth, and views cut from them.

#![allow(dead_code, reason = "not every test needs all of it")]

use flockeye_geometry::camera::Equirectangular;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::image::LumaImage;
use nalgebra::{Unit, Vector3};
use opencv::imgcodecs::{IMREAD_GRAYSCALE, imread};
use opencv::prelude::*;

pub(crate) use flockeye_require::recordings as data;

/// An 8-bit image that owns its pixels.
pub(crate) struct Picture {
    pub pixels: Vec<u8>,
    pub width: usize,
    pub height: usize,
}

impl Picture {
    /// The luma of an image file.
    pub(crate) fn read(path: &std::path::Path) -> Self {
        let mat = imread(path.to_str().expect("a readable path"), IMREAD_GRAYSCALE).expect("read");
        let pixels = mat.data_bytes().expect("continuous").to_vec();
        Self { pixels, width: mat.cols() as usize, height: mat.rows() as usize }
    }

    pub(crate) fn image(&self) -> LumaImage<'_> {
        LumaImage::new(&self.pixels, self.width, self.height, self.width).expect("consistent")
    }

    /// Cuts `view` from this image of the whole sphere, interpolating linearly between code values.
    pub(crate) fn cut(&self, view: &View) -> Picture {
        let camera = Equirectangular { width: self.width as u32, height: self.height as u32 };
        let size = view.size_px as usize;
        let mut pixels = Vec::with_capacity(size * size);
        for y in 0..size {
            for x in 0..size {
                let at = camera.project(&view.ray(ViewPixel::new(x as f64, y as f64))).0;
                let (left, top) = (at.x.floor(), at.y.floor());
                let (fx, fy) = (at.x - left, at.y - top);
                let code = |dx: f64, dy: f64| {
                    let column = (left + dx).rem_euclid(self.width as f64) as usize;
                    let row = (top + dy).clamp(0.0, self.height as f64 - 1.0) as usize;
                    f64::from(self.pixels[row * self.width + column])
                };
                let upper = code(0.0, 0.0) * (1.0 - fx) + code(1.0, 0.0) * fx;
                let lower = code(0.0, 1.0) * (1.0 - fx) + code(1.0, 1.0) * fx;
                pixels.push((upper * (1.0 - fy) + lower * fy).round() as u8);
            }
        }
        Picture { pixels, width: size, height: size }
    }
}

/// Twelve views that cover the sphere: the faces of a dodecahedron.
pub(crate) fn partitions(focal: f64) -> Vec<View> {
    let golden = (1.0 + 5f64.sqrt()) / 2.0;
    let mut views = Vec::new();
    for a in [-1.0, 1.0] {
        for b in [-golden, golden] {
            for axis in [Vector3::new(0.0, a, b), Vector3::new(a, b, 0.0), Vector3::new(b, 0.0, a)]
            {
                let field = 75f64.to_radians();
                let size = (2.0 * focal * (field / 2.0).tan()).ceil() as u32;
                let direction = Unit::new_normalize(axis);
                views.push(View::looking_at(&direction, field, size));
            }
        }
    }
    views
}
