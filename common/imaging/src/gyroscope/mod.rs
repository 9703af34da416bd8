//! The camera's own rotation between two frames, from the sphere image: a visual gyroscope.
//!
//! Both frames are averaged to 480x240 pixels, and to two levels below. Points with texture of the
//! earlier frame are looked up in the later one. Robust Gauss-Newton steps find the rotation with
//! the least differences, coarse level first. Beside the rotation there are five more unknowns.
//! Three are the camera's translation t over one common distance: a point at direction d moves by
//! t - d (d t). Two are the gain and offset of the brightness. Steps are taken on the earlier
//! frame's gradients (inverse compositional: Baker and Matthews, Lucas-Kanade 20 Years On, 2004),
//! so they are computed once.
//!
//! The drone itself stays in place in the picture while the camera turns. It is detected and left
//! out ([`own_airframe`]), because it would pull the rotation towards zero.
//!
//! The covariance does not assume independent pixels. Residuals are summed by sectors of the
//! sphere, and the covariance follows from the scatter of these sums (a cluster-robust or sandwich
//! covariance: Liang and Zeger, Biometrika 73, 1986).
//!
//! | module | what it does |
//! | --- | --- |
//! | [`grid`] | the sphere as small images of longitude and latitude |
//! | [`points`] | points with texture, and their gradients |
//! | [`solve`] | the rotation between two frames |
//! | [`own_airframe`] | where the picture shows the drone itself |

pub mod grid;
mod normal_equations;
pub mod own_airframe;
pub mod points;
pub mod solve;

use flockeye_geometry::ego_rotation::Turned;
use nalgebra::UnitQuaternion;

use self::grid::{CELLS, Level, Sampler};
use self::own_airframe::AirframeCell;
use self::points::{MIN_POINTS, TexturePoint, points_of};
use crate::sphere::SphereImage;

/// Largest standard deviation of a usable rotation, radians (half a degree).
const MAX_SIGMA_RAD: f64 = 0.0087;

/// Follows the camera's rotation from frame to frame.
#[derive(Debug)]
pub struct Gyroscope {
    sampler: Sampler,
    /// The frame before, with its points, at all levels.
    earlier: Option<(Vec<Level>, Vec<Vec<TexturePoint>>)>,
    /// Start of the next solution: the last rotation.
    last: UnitQuaternion<f64>,
    /// Statistics of each cell, from which the own airframe is detected.
    airframe: Vec<AirframeCell>,
}

impl Gyroscope {
    /// Averages frames with `sampler`.
    pub fn new(sampler: Sampler) -> Self {
        let airframe = vec![AirframeCell::default(); CELLS];
        Self { sampler, earlier: None, last: UnitQuaternion::identity(), airframe }
    }

    /// Handles the next frame, and returns the camera's rotation since the one before. The start is
    /// `expected` from another source, or else the last rotation.
    ///
    /// `None` for the first frame, and where the picture does not determine the rotation: too
    /// little texture, or too little of it fits.
    pub fn next(
        &mut self,
        frame: &SphereImage<'_>,
        expected: Option<UnitQuaternion<f64>>,
    ) -> Option<Turned> {
        let pyramid = self.sampler.pyramid(frame);
        let points: Vec<_> = pyramid.iter().map(|level| points_of(level, &self.sampler)).collect();
        // A frame without texture matches any other, up to the brightness.
        let is_plain = points.iter().all(|points| points.len() < MIN_POINTS);
        let found = self.earlier.as_ref().filter(|_| !is_plain).and_then(|(_, points)| {
            let found = solve::rotation(points, &pyramid, expected, self.last, &self.airframe)?;
            let deviation2 = found.0.covariance.symmetric_eigenvalues().max();
            (deviation2 < MAX_SIGMA_RAD.powi(2)).then_some(found)
        });
        if let (Some((rotation, residuals)), Some((earlier, of_earlier))) = (&found, &self.earlier)
            && let (Some(points), Some(later), Some(earlier)) =
                (of_earlier.first(), pyramid.first(), earlier.first())
        {
            let turn = &rotation.later_from_earlier;
            learn(&mut self.airframe, turn, residuals, points, earlier, later);
        }
        self.earlier = Some((pyramid, points));
        let found = found.map(|(rotation, _)| rotation);
        self.last = found.map_or_else(UnitQuaternion::identity, |found| found.later_from_earlier);
        found
    }
}

/// Updates the detection of the own airframe, from the residuals of points that turn and that stay.
fn learn(
    airframe: &mut [AirframeCell],
    rotation: &UnitQuaternion<f64>,
    residuals: &[f32],
    points: &[TexturePoint],
    earlier: &Level,
    later: &Level,
) {
    let turn = rotation.scaled_axis().cast::<f32>() / later.pixel_rad() as f32;
    for (point, &turns) in points.iter().zip(residuals) {
        let stays = later.at(point.pixel) - earlier.at(point.pixel);
        let moved_px = turn.cross(&point.place.direction).norm();
        airframe[point.place.cell].note(turns, stays, moved_px);
    }
}

#[cfg(test)]
mod tests;
