//! The camera's own rotation between two frames, seen in the sphere itself: a visual gyroscope.
//!
//! Both frames are averaged to 480x240 pixels, and to two levels below. Points with texture of the earlier frame
//! are looked up in the later one, and the rotation that makes them agree is found by robust
//! Gauss-Newton steps, coarse level first. Beside the rotation there are five more unknowns: the camera's
//! translation over one common distance (a point at direction d moves by t - d (d t)), and the gain and
//! offset of the brightness. Steps are taken on the earlier frame's gradients (inverse compositional:
//! Baker and Matthews, Lucas-Kanade 20 Years On, 2004), so they are computed once.
//!
//! What stays put while the camera turns is the drone itself. It is learned and left out
//! ([`own_airframe`]), because it would pull the rotation towards none.
//!
//! The covariance does not take pixels as independent: residuals are summed by sectors of the sphere, and
//! the scatter of these sums says how certain the rotation is (a cluster-robust or sandwich covariance:
//! Liang and Zeger, Biometrika 73, 1986).
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

use nalgebra::{Matrix3, UnitQuaternion};

use self::grid::{Pyramid, Sampler};
use self::own_airframe::OwnAirframe;
use self::points::{MIN_POINTS, Points};
use self::solve::{RotationFit, Start};
use crate::sphere::SphereImage;

/// A rotation that is less certain than this says nothing, radians (half a degree).
const MAX_SIGMA_RAD: f64 = 0.0087;

/// The camera's rotation from one frame to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraRotation {
    /// Turns directions in the earlier camera's frame into the later one's.
    pub later_from_earlier: UnitQuaternion<f64>,
    /// Covariance of the rotation vector in the later camera's frame, radians squared.
    pub covariance: Matrix3<f64>,
    /// Points that it rests on.
    pub points: usize,
}

/// Follows the camera's rotation from frame to frame.
#[derive(Debug)]
pub struct Gyroscope {
    sampler: Sampler,
    earlier: Option<(Pyramid, Vec<Points>)>,
    /// Where the next solution is looked for: the last rotation.
    last: UnitQuaternion<f64>,
    airframe: OwnAirframe,
}

impl Gyroscope {
    /// Averages frames with `sampler`.
    pub fn new(sampler: Sampler) -> Self {
        let airframe = OwnAirframe::default();
        Self { sampler, earlier: None, last: UnitQuaternion::identity(), airframe }
    }

    /// Takes the next frame, and says how the camera has turned since the one before. `expected` is the
    /// rotation to start from where something else knows it; otherwise the last one is.
    ///
    /// `None` for the first frame, and where the picture does not tell: there is no texture, or too
    /// little of it agrees.
    pub fn next(
        &mut self,
        frame: &SphereImage<'_>,
        expected: Option<UnitQuaternion<f64>>,
    ) -> Option<CameraRotation> {
        let pyramid = self.sampler.pyramid(frame);
        let points: Vec<Points> =
            pyramid.levels().iter().map(|level| Points::of(level, &self.sampler)).collect();
        // A frame without texture agrees with any other, but for the brightness.
        let is_plain = points.iter().all(|points| points.all.len() < MIN_POINTS);
        let found = self.earlier.as_ref().filter(|_| !is_plain).and_then(|(_, points)| {
            let start = Start { expected, last: self.last };
            let fit = solve::rotation(points, &pyramid, &start, &self.airframe)?;
            let is_certain = fit.covariance.symmetric_eigenvalues().max() < MAX_SIGMA_RAD.powi(2);
            is_certain.then_some(fit)
        });
        if let (Some(fit), Some((earlier, of_earlier))) = (&found, &self.earlier) {
            learn(&mut self.airframe, fit, earlier, of_earlier, &pyramid);
        }
        self.last = found.as_ref().map_or_else(UnitQuaternion::identity, |fit| fit.rotation);
        self.earlier = Some((pyramid, points));
        found.map(|fit| CameraRotation {
            later_from_earlier: fit.rotation,
            covariance: fit.covariance,
            points: fit.points,
        })
    }
}

/// Learns where the drone sees itself, from how well points agree that turn and that stay.
fn learn(
    airframe: &mut OwnAirframe,
    fit: &RotationFit,
    earlier: &Pyramid,
    points: &[Points],
    later: &Pyramid,
) {
    let (Some(points), Some(later), Some(earlier)) =
        (points.first(), later.levels().first(), earlier.levels().first())
    else {
        return;
    };
    let turn = fit.rotation.scaled_axis().cast::<f32>() / later.pixel_rad() as f32;
    for (point, &turns) in points.all.iter().zip(&fit.residuals) {
        let stays = later.at(point.pixel) - earlier.at(point.pixel);
        airframe.note(point.cell, turns, stays, turn.cross(&point.direction).norm());
    }
}

#[cfg(test)]
mod tests;
