//! Where the camera sits on the drone: from a body at places that were measured on the bench.
//!
//! A body stands at places whose position in the drone's frame is known, and the camera measures
//! its pose at each. [`fit`] finds `observer_from_camera`: a rigid alignment as start, then
//! Gauss-Newton over its six parameters. Errors are weighted by both covariances, that of the
//! measured pose turned into the drone's frame and that of the measured place. A place that
//! contradicts all others is left out and named.

mod still;

use nalgebra::{Isometry3, Matrix3, Matrix6, Point3, UnitQuaternion, Vector3, Vector6};

use super::error::{CalibrationError, LEAST_PLACES};
use super::gauge::alignment;
use super::leverage::worst_error_m;
use super::weighted_ray::{difference, moved};
use flockeye_geometry::filter::chi_square_quantile;
pub use still::{StillPose, still_pose};

/// A turn known worse than this is not known, degrees.
const WORST_TURN_DEG: f64 = 2.0;
/// Places disagree if their chi-square is larger than right ones' with this probability.
const AGREEING: f64 = 0.999;
/// At least this share of the places is kept.
const KEPT_SHARE: f64 = 2.0 / 3.0;
/// Most steps.
const MAX_STEPS: usize = 50;

/// A body at a place that was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredPlace {
    /// The body's pose as the camera measured it.
    pub seen: StillPose,
    /// Where the body's origin was in the drone's frame, metres.
    pub in_observer: Point3<f64>,
    /// Standard deviation of that along each axis, metres.
    pub deviation_m: f64,
    /// How the body was turned in the drone's frame, with the standard deviation about each axis
    /// (rad), if that was measured.
    pub orientation: Option<(UnitQuaternion<f64>, f64)>,
}

/// What is left at a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceResidual {
    /// From where the camera sees the body to where it was, in the drone's frame, metres.
    pub residual_m: Vector3<f64>,
    /// What that is expected to be: the root of the expected squared distance, metres.
    pub deviation_m: f64,
    /// The whole residual, with that of the orientation if it was measured, in stated standard
    /// deviations: 1 on average if these are right.
    pub deviations: f64,
    /// Whether the place counted.
    pub is_kept: bool,
}

/// Whether the places agree as well as was stated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Agreement {
    /// As well as stated.
    AsStated,
    /// Better: places or poses were measured better than stated.
    Better,
    /// Worse: something is off by more than stated. The mount's covariance was enlarged.
    Worse,
}

/// A mount as it was found.
#[derive(Debug, Clone, PartialEq)]
pub struct MountCalibration {
    /// Where the camera sits.
    pub observer_from_camera: Isometry3<f64>,
    /// Its covariance: position (m), then rotation vector (rad), both in the drone's axes. Enlarged
    /// where the places agree worse than stated.
    pub covariance: Matrix6<f64>,
    /// What is left at each place, in the given order.
    pub places: Vec<PlaceResidual>,
    /// Sum of the squared residuals of the places that counted, in stated variances.
    pub chi_square: f64,
    /// Its degrees of freedom: what it is on average.
    pub freedom: usize,
    /// Whether that is too much.
    pub agreement: Agreement,
}

impl MountCalibration {
    /// Standard deviations of the position along x, y and z, metres, then of the rotation about
    /// them, radians.
    pub fn deviations(&self) -> [f64; 6] {
        self.covariance.diagonal().map(f64::sqrt).into()
    }

    /// What the mount's uncertainty makes of a neighbour's position this far away, in the worst
    /// direction: the root of the expected squared error, metres.
    pub fn error_at_m(&self, distance_m: f64) -> f64 {
        worst_error_m(&self.covariance, distance_m, |_| true)
    }

    /// By how much another mount than the found one puts a neighbour this far away elsewhere, in
    /// the worst direction, metres.
    pub fn error_of_m(&self, other: &Isometry3<f64>, distance_m: f64) -> f64 {
        let error = difference(&self.observer_from_camera, other);
        worst_error_m(&(error * error.transpose()), distance_m, |_| true)
    }
}

/// The covariance of a pose, position then rotation vector, with both in other axes.
pub fn turned_covariance(turn: &UnitQuaternion<f64>, covariance: &Matrix6<f64>) -> Matrix6<f64> {
    let rotation = turn.to_rotation_matrix();
    let mut both = Matrix6::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation.matrix());
    both.fixed_view_mut::<3, 3>(3, 3).copy_from(rotation.matrix());
    both * covariance * both.transpose()
}

/// Finds where the camera sits.
pub fn fit(places: &[MeasuredPlace]) -> Result<MountCalibration, CalibrationError> {
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

/// Numbers measured, less six.
fn freedom(places: &[MeasuredPlace], kept: &[bool]) -> usize {
    let rows = |place: &MeasuredPlace| if place.orientation.is_some() { 6 } else { 3 };
    let kept = places.iter().zip(kept).filter(|(_, is_kept)| **is_kept);
    kept.map(|(place, _)| rows(place)).sum::<usize>().saturating_sub(6)
}

/// Which places count. All do if they agree, or if no few of them explain that they do not. Else
/// the one without which the others agree best is left out, and so on.
fn agreeing(places: &[MeasuredPlace]) -> Result<Vec<bool>, CalibrationError> {
    let all = vec![true; places.len()];
    let limit = |kept: &[bool]| chi_square_quantile(freedom(places, kept) as f64, AGREEING);
    let least = LEAST_PLACES.max((KEPT_SHARE * places.len() as f64).ceil() as usize);
    let mut kept = all.clone();
    if fit_kept(places, &kept)?.2 <= limit(&kept) {
        return Ok(kept);
    }
    while kept.iter().filter(|is| **is).count() > least {
        let mut without: Vec<(f64, usize)> = Vec::new();
        for place in (0..places.len()).filter(|&place| kept[place]) {
            let mut fewer = kept.clone();
            fewer[place] = false;
            // Places that are not enough without this one say nothing about it.
            if let Ok((_, _, chi_square)) = fit_kept(places, &fewer) {
                without.push((chi_square / limit(&fewer), place));
            }
        }
        without.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some(&(best, place)) = without.first() else { break };
        kept[place] = false;
        if best <= 1.0 {
            // Where another one would do as well, nobody knows which of them is wrong.
            let is_clear = without.get(1).is_none_or(|second| second.0 > 1.0);
            return Ok(if is_clear { kept } else { all });
        }
    }
    Ok(all)
}

/// The mount by the places that are kept, with its covariance and its chi-square.
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
    // A line leaves the turn about it open: then the normal matrix has no inverse, or a huge one.
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

/// What is known of the turn alone, the shift being unknown (Schur's complement).
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
        // A shift moves what is seen, a turn moves it by turn x arm and turns it.
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

    /// From what is seen to what was measured: shift, then turn, in the drone's axes. Without a
    /// measured orientation the turn is 0.
    fn residual(&self, mount: &Isometry3<f64>) -> Vector6<f64> {
        let seen = mount * self.seen.camera_from_target;
        let measured = Isometry3::from_parts(
            self.in_observer.coords.into(),
            self.orientation.map_or(seen.rotation, |(orientation, _)| orientation),
        );
        difference(&seen, &measured)
    }

    /// The residual's covariance, if all is as stated.
    fn expected(&self, mount: &Isometry3<f64>) -> Matrix6<f64> {
        let mut expected = turned_covariance(&mount.rotation, &self.seen.covariance);
        let turn_rad = self.orientation.map_or(0.0, |(_, deviation)| deviation);
        for k in 0..3 {
            expected[(k, k)] += self.deviation_m * self.deviation_m;
            expected[(k + 3, k + 3)] += turn_rad * turn_rad;
        }
        expected
    }

    /// Its inverse; without a measured orientation, of the position alone.
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
