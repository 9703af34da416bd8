//! The camera's own rotation between two frames, seen in the sphere itself: a visual gyroscope.
//!
//! Both frames are averaged to 480x240 pixels, and to two levels below. Points with texture of the
//! earlier frame are looked up in the later one, and the rotation that makes them agree is found by
//! robust Gauss-Newton steps, coarse level first. Beside the rotation there are five more unknowns:
//! the camera's translation over one common distance (a point at direction d moves by t - d (d t)),
//! and the gain and offset of the brightness. Steps are taken on the earlier frame's gradients
//! (inverse compositional: Baker and Matthews, Lucas-Kanade 20 Years On, 2004), so they are
//! computed once.
//!
//! What stays put while the camera turns is the drone itself. It is learned and left out
//! ([`own_airframe`]), because it would pull the rotation towards none.
//!
//! The covariance does not take pixels as independent: residuals are summed by sectors of the
//! sphere, and the scatter of these sums says how certain the rotation is (a cluster-robust or
//! sandwich covariance: Liang and Zeger, Biometrika 73, 1986).
//!
//! | module | what it does |
//! | --- | --- |
//! | [`grid`] | the sphere as small images of longitude and latitude |
//! | [`points`] | points with texture, and their gradients |
//! | [`solve`] | the rotation between two frames |
//! | [`own_airframe`] | where the drone sees itself |

pub mod grid;
mod normal_equations;
pub mod own_airframe;
pub mod points;
pub mod solve;

use nalgebra::UnitQuaternion;

use self::grid::{CELLS, Level, Sampler};
use self::own_airframe::AirframeCell;
use self::points::{MIN_POINTS, TexturePoint, points_of};
pub use self::solve::CameraRotation;
use crate::sphere::SphereImage;

/// A rotation that is less certain than this says nothing, radians (half a degree).
const MAX_SIGMA_RAD: f64 = 0.0087;

/// Follows the camera's rotation from frame to frame.
#[derive(Debug)]
pub struct Gyroscope {
    sampler: Sampler,
    /// The frame before, with its points, at all levels.
    earlier: Option<(Vec<Level>, Vec<Vec<TexturePoint>>)>,
    /// Where the next solution is looked for: the last rotation.
    last: UnitQuaternion<f64>,
    /// By cell, where the drone sees itself.
    airframe: Vec<AirframeCell>,
}

impl Gyroscope {
    /// Averages frames with `sampler`.
    pub fn new(sampler: Sampler) -> Self {
        let airframe = vec![AirframeCell::default(); CELLS];
        Self { sampler, earlier: None, last: UnitQuaternion::identity(), airframe }
    }

    /// Takes the next frame, and says how the camera has turned since the one before. `expected` is
    /// the rotation to start from where something else knows it; otherwise the last one is.
    ///
    /// `None` for the first frame, and where the picture does not tell: there is no texture, or too
    /// little of it agrees.
    pub fn next(
        &mut self,
        frame: &SphereImage<'_>,
        expected: Option<UnitQuaternion<f64>>,
    ) -> Option<CameraRotation> {
        let pyramid = self.sampler.pyramid(frame);
        let points: Vec<_> = pyramid.iter().map(|level| points_of(level, &self.sampler)).collect();
        // A frame without texture agrees with any other, but for the brightness.
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

/// Learns where the drone sees itself, from how well points agree that turn and that stay.
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
