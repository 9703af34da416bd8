//! The camera's pose on the drone, from a body at measured places.
//!
//! A body stands at places with known positions in the drone's frame, and the camera measures its
//! pose at each. [`fit`] finds `observer_from_camera` by a rigid alignment, then Gauss-Newton over
//! six parameters. Residuals are weighted by two covariances: that of the measured pose, turned
//! into the drone's frame, and that of the measured place. A place that contradicts all others is
//! left out and reported.

mod still;

use nalgebra::{Isometry3, Matrix3, Matrix6, Point3, UnitQuaternion, Vector3, Vector6};

use super::error::{CalibrationError, LEAST_PLACES};
use super::gauge::alignment;
use super::leverage::worst_error_m;
use super::weighted_ray::{difference, moved};
use flockeye_geometry::filter::chi_square_quantile;
use flockeye_geometry::pose::turned_covariance;
pub(crate) use still::{StillPose, still_pose};

/// Largest standard deviation of a determined turn, degrees.
const WORST_TURN_DEG: f64 = 2.0;
/// Probability that the chi-square of correct places is below the limit for disagreement.
const AGREEING: f64 = 0.999;
/// Least share of the places that is kept.
const KEPT_SHARE: f64 = 2.0 / 3.0;
/// Most steps.
const MAX_STEPS: usize = 50;

/// A body at a measured place.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MeasuredPlace {
    /// The body's pose, measured by the camera.
    pub seen: StillPose,
    /// Position of the body's origin in the drone's frame, metres.
    pub in_observer: Point3<f64>,
    /// Standard deviation of the position along each axis, metres.
    pub deviation_m: f64,
    /// Orientation of the body in the drone's frame, with the standard deviation about each axis
    /// (rad); `None` if not measured.
    pub orientation: Option<(UnitQuaternion<f64>, f64)>,
}

/// The residual at a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PlaceResidual {
    /// Residual from the position by the camera to the measured one, in the drone's frame, metres.
    pub residual_m: Vector3<f64>,
    /// Expected size of the residual: the root of the expected squared distance, metres.
    pub deviation_m: f64,
    /// The whole residual in stated standard deviations, with the orientation if it was measured.
    /// The mean is 1 if the deviations are right.
    pub deviations: f64,
    /// Whether the place was used.
    pub is_kept: bool,
}

/// Comparison of the residuals with the stated deviations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Agreement {
    /// Residuals are as large as stated.
    AsStated,
    /// Residuals are smaller: places or poses were measured better than stated.
    Better,
    /// Residuals are larger: an error is larger than stated. The mount's covariance was enlarged.
    Worse,
}

/// The calibrated mount.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MountCalibration {
    /// The camera's pose on the drone.
    pub observer_from_camera: Isometry3<f64>,
    /// Covariance of the pose: position (m), then rotation vector (rad), both in the drone's axes.
    /// It is enlarged if residuals are larger than stated.
    pub covariance: Matrix6<f64>,
    /// The residual at each place, in the given order.
    pub places: Vec<PlaceResidual>,
    /// Sum of the squared residuals of the used places, in stated variances.
    pub chi_square: f64,
    /// Degrees of freedom, which is the expected chi-square.
    pub freedom: usize,
    /// Whether the chi-square is as expected.
    pub agreement: Agreement,
}

impl MountCalibration {
    /// Standard deviations of the position along x, y and z, metres, then of the rotation about
    /// them, radians.
    pub(crate) fn deviations(&self) -> [f64; 6] {
        self.covariance.diagonal().map(f64::sqrt).into()
    }

    /// Position error of a neighbour at this distance, in the worst direction, due to the
    /// covariance. It is the root of the expected squared error, metres.
    pub(crate) fn error_at_m(&self, distance_m: f64) -> f64 {
        worst_error_m(&self.covariance, distance_m, |_| true)
    }

    /// Position error of a neighbour at this distance with another mount than the calibrated one,
    /// in the worst direction, metres.
    pub(crate) fn error_of_m(&self, other: &Isometry3<f64>, distance_m: f64) -> f64 {
        let error = difference(&self.observer_from_camera, other);
        worst_error_m(&(error * error.transpose()), distance_m, |_| true)
    }
}

/// Finds the camera's pose on the drone.
pub(crate) fn fit(places: &[MeasuredPlace]) -> Result<MountCalibration, CalibrationError> {
    if places.len() < LEAST_PLACES {
        return Err(CalibrationError::TooFewPlaces { places: places.len() });
    }
    if let Some(index) = places.iter().position(|place| !place.is_sound()) {
        return Err(CalibrationError::PlaceWithoutNumber { place: index + 1 });
    }
    let kept = agreeing(places)?;
    let (mount, covariance, chi_square) = fit_kept(places, &kept)?;
    let freedom = freedom(places, &kept);
    let bound = |probability: f64| chi_square_quantile(freedom as f64, probability);
    let agreement = match chi_square {
        much if much > bound(AGREEING) => Agreement::Worse,
        little if little < bound(1.0 - AGREEING) => Agreement::Better,
        _ => Agreement::AsStated,
    };
    let enlarged = match agreement {
        Agreement::Worse => chi_square / freedom as f64,
        Agreement::AsStated | Agreement::Better => 1.0,
    };
    let residual = |(place, &is_kept): (&MeasuredPlace, &bool)| {
        let rows = if place.orientation.is_some() { 6.0 } else { 3.0 };
        let residual = place.residual(&mount);
        PlaceResidual {
            residual_m: residual.fixed_rows::<3>(0).into_owned(),
            deviation_m: place.expected(&mount).fixed_view::<3, 3>(0, 0).trace().sqrt(),
            deviations: (residual.dot(&(place.information(&mount) * residual)) / rows).sqrt(),
            is_kept,
        }
    };
    Ok(MountCalibration {
        observer_from_camera: mount,
        covariance: covariance * enlarged,
        places: places.iter().zip(&kept).map(residual).collect(),
        chi_square,
        freedom,
        agreement,
    })
}

/// Degrees of freedom: the number of measured values minus the six parameters.
fn freedom(places: &[MeasuredPlace], kept: &[bool]) -> usize {
    let rows = |place: &MeasuredPlace| if place.orientation.is_some() { 6 } else { 3 };
    let kept = places.iter().zip(kept).filter(|(_, is_kept)| **is_kept);
    kept.map(|(place, _)| rows(place)).sum::<usize>().saturating_sub(6)
}

/// Flags of the places that are used. All are used if they agree, or if no small set explains the
/// disagreement. Otherwise the place whose removal helps most is left out, repeatedly.
fn agreeing(places: &[MeasuredPlace]) -> Result<Vec<bool>, CalibrationError> {
    let all = vec![true; places.len()];
    let limit = |kept: &[bool]| chi_square_quantile(freedom(places, kept) as f64, AGREEING);
    let least = LEAST_PLACES.max((KEPT_SHARE * places.len() as f64).ceil() as usize);
    let mut kept = all.clone();
    let (_, _, chi_square) = fit_kept(places, &kept)?;
    if chi_square <= limit(&kept) {
        return Ok(kept);
    }
    while kept.iter().filter(|is| **is).count() > least {
        let mut without: Vec<(f64, usize)> = Vec::new();
        for place in (0..places.len()).filter(|&place| kept[place]) {
            let mut fewer = kept.clone();
            fewer[place] = false;
            // Without this place the others do not determine the mount, so it cannot be judged.
            if let Ok((_, _, chi_square)) = fit_kept(places, &fewer) {
                without.push((chi_square / limit(&fewer), place));
            }
        }
        without.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some(&(best, place)) = without.first() else { break };
        kept[place] = false;
        if best <= 1.0 {
            // If the removal of another place helps as much, the wrong one is not known.
            let is_clear = without.get(1).is_none_or(|second| second.0 > 1.0);
            return Ok(if is_clear { kept } else { all });
        }
    }
    Ok(all)
}

/// The mount from the kept places, with its covariance and its chi-square.
fn fit_kept(
    places: &[MeasuredPlace],
    kept: &[bool],
) -> Result<(Isometry3<f64>, Matrix6<f64>, f64), CalibrationError> {
    let kept: Vec<&MeasuredPlace> =
        places.iter().zip(kept).filter(|(_, is)| **is).map(|(place, _)| place).collect();
    let seen: Vec<Point3<f64>> =
        kept.iter().map(|place| place.seen.camera_from_target.translation.vector.into()).collect();
    let measured: Vec<Point3<f64>> = kept.iter().map(|place| place.in_observer).collect();
    let mut mount = alignment(&seen, &measured);
    let (mut normal, mut gradient, mut chi_square) = equations(&kept, &mount);
    for _ in 0..MAX_STEPS {
        let Some(factor) = normal.cholesky() else { break };
        let step = -factor.solve(&gradient);
        mount = moved(&mount, &step);
        (normal, gradient, chi_square) = equations(&kept, &mount);
        if step.norm() < 1e-12 {
            break;
        }
    }
    // Places on a line do not determine the turn about it. Then the normal matrix has no inverse,
    // or a huge one.
    let turn = turns_information(&normal);
    let eigen = turn.symmetric_eigen();
    let worst = eigen.eigenvalues.imin();
    let deviation_deg = (1.0 / eigen.eigenvalues[worst].max(1e-12)).sqrt().to_degrees();
    let covariance = normal.try_inverse().filter(|_| deviation_deg <= WORST_TURN_DEG);
    let axis = eigen.eigenvectors.column(worst).into_owned();
    let axis = if axis.sum() < 0.0 { -axis } else { axis };
    match covariance {
        Some(covariance) => Ok((mount, covariance, chi_square)),
        None => Err(CalibrationError::MountUndetermined { axis: axis.into(), deviation_deg }),
    }
}

/// Information matrix of the turn alone, with an unknown shift (Schur's complement).
fn turns_information(normal: &Matrix6<f64>) -> Matrix3<f64> {
    let block = |row: usize, column: usize| -> Matrix3<f64> {
        normal.fixed_view::<3, 3>(row, column).into_owned()
    };
    let taken = block(0, 0).try_inverse().map(|inverse| block(3, 0) * inverse * block(0, 3));
    let left = block(3, 3) - taken.unwrap_or_else(Matrix3::zeros);
    (left + left.transpose()) / 2.0
}

/// The normal matrix, the gradient and the chi-square at a mount.
fn equations(
    places: &[&MeasuredPlace],
    mount: &Isometry3<f64>,
) -> (Matrix6<f64>, Vector6<f64>, f64) {
    let (mut normal, mut gradient, mut chi_square) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
    for place in places {
        let (residual, information) = (place.residual(mount), place.information(mount));
        let arm = mount.rotation * place.seen.camera_from_target.translation.vector;
        // A shift moves the seen pose. A turn moves it by turn x arm, and turns it.
        let mut by_mount = -Matrix6::<f64>::identity();
        by_mount.fixed_view_mut::<3, 3>(0, 3).copy_from(&arm.cross_matrix());
        normal += by_mount.transpose() * information * by_mount;
        gradient += by_mount.transpose() * information * residual;
        chi_square += residual.dot(&(information * residual));
    }
    (normal, gradient, chi_square)
}

impl MeasuredPlace {
    fn is_sound(&self) -> bool {
        let covariance = self.seen.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let (_, turn_rad) = self.orientation.unwrap_or((UnitQuaternion::identity(), 1.0));
        let seen = self.seen.camera_from_target.translation.vector;
        let numbers = seen.iter().chain(self.in_observer.coords.iter()).copied();
        let above_0 = [self.deviation_m, turn_rad];
        numbers.chain(self.seen.covariance.iter().copied()).all(f64::is_finite)
            && above_0.iter().all(|&deviation| deviation > 0.0 && deviation.is_finite())
            && covariance.symmetric_eigenvalues().min() >= -1e-12
    }

    /// The residual from the seen pose to the measured one: shift, then turn, in the drone's axes.
    /// Without a measured orientation the turn is 0.
    fn residual(&self, mount: &Isometry3<f64>) -> Vector6<f64> {
        let seen = mount * self.seen.camera_from_target;
        let measured = Isometry3::from_parts(
            self.in_observer.coords.into(),
            self.orientation.map_or(seen.rotation, |(orientation, _)| orientation),
        );
        difference(&seen, &measured)
    }

    /// The residual's covariance if all deviations are as stated.
    fn expected(&self, mount: &Isometry3<f64>) -> Matrix6<f64> {
        let mut expected = turned_covariance(&mount.rotation, &self.seen.covariance);
        let turn_rad = self.orientation.map_or(0.0, |(_, deviation)| deviation);
        for k in 0..3 {
            expected[(k, k)] += self.deviation_m * self.deviation_m;
            expected[(k + 3, k + 3)] += turn_rad * turn_rad;
        }
        expected
    }

    /// The inverse of that covariance; without a measured orientation, of the position only.
    fn information(&self, mount: &Isometry3<f64>) -> Matrix6<f64> {
        let expected = self.expected(mount);
        if self.orientation.is_some() {
            return expected.try_inverse().unwrap_or_else(Matrix6::zeros);
        }
        let position: Matrix3<f64> = expected.fixed_view::<3, 3>(0, 0).into_owned();
        let mut information = Matrix6::zeros();
        let inverse = position.try_inverse().unwrap_or_else(Matrix3::zeros);
        information.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse);
        information
    }
}

#[cfg(test)]
mod tests;
