//! A body aligned with the pixels of the best view of it.

use flockeye_geometry::body::Bodies;
use flockeye_geometry::view::View;
use flockeye_imaging::align::{AlignOptions, Alignment, BodyPrint, PrintError, align, reacquire};
use flockeye_imaging::edges::MarkerPrint;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use nalgebra::Isometry3;

/// A view of a neighbour, with its pixels.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'p> {
    /// The pixels.
    pub image: LumaImage<'p>,
    /// What they show.
    pub view: View,
    /// What light they stand for.
    pub light: &'p LinearLight,
    /// The distance that its rays are right for, metres; it matters for lenses beside the middle.
    pub rays_m: f64,
}

/// Aligns the configured bodies.
#[derive(Debug, Clone)]
pub struct Aligner {
    prints: Vec<BodyPrint>,
    pixels_per_radian: f64,
    options: AlignOptions,
}

impl Aligner {
    /// For `bodies` with markers that look as `print_of` says, on a sphere image of this resolution.
    ///
    /// # Errors
    /// A marker that cannot be drawn.
    pub fn new<'p>(
        bodies: &Bodies,
        print_of: impl Fn(u32) -> Option<&'p MarkerPrint>,
        pixels_per_radian: f64,
    ) -> Result<Self, PrintError> {
        let prints =
            bodies.iter().map(|body| BodyPrint::new(body, &print_of)).collect::<Result<_, _>>()?;
        Ok(Self { prints, pixels_per_radian, options: AlignOptions::default() })
    }

    /// Aligns body `target` from the first of `starts` that leads to it. `None` if none does.
    pub fn align(
        &self,
        target: usize,
        picture: &Picture<'_>,
        starts: &[Start],
    ) -> Option<Alignment> {
        let print = self.prints.get(target)?;
        starts.iter().find_map(|start| {
            let options = AlignOptions { coarse_first: start.is_rough, ..self.options };
            align(
                print,
                &picture.image,
                picture.light,
                &picture.view,
                self.pixels_per_radian,
                &start.camera_from_markers,
                &options,
            )
            .ok()
            .filter(Alignment::is_believed)
        })
    }
}

impl Aligner {
    /// Looks for body `target` round where it was predicted.
    pub fn reacquire(
        &self,
        target: usize,
        picture: &Picture<'_>,
        predicted: &Isometry3<f64>,
    ) -> Option<Alignment> {
        reacquire(
            self.prints.get(target)?,
            &picture.image,
            picture.light,
            &picture.view,
            self.pixels_per_radian,
            predicted,
            &self.options,
        )
    }
}

/// Where alignment may begin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Start {
    /// The pose.
    pub camera_from_markers: Isometry3<f64>,
    /// Whether it may be off by more than half a cell.
    pub is_rough: bool,
}
