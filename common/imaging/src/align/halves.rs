//! The halves of a stitched picture that show a body, each from a lens of its own.
//!
//! A body beside the border between the halves is modelled half by half: each pixel shows what its
//! lens sees. What is not known of the lenses, the constants of [`Stitch`], are further unknowns of
//! the fit, because the two parts of the body's print show them. Pixels in which both lenses may show
//! are left out.

use flockeye_geometry::camera::{Half, ShownBy, Stitch};
use nalgebra::{Isometry3, Matrix3, Matrix5, Matrix6, SMatrix, UnitQuaternion, Vector3, Vector5};

use super::alignment::SeenStitch;
use super::patch::Picture;

/// Below this disparity, with its deviation, the halves are one picture: pixels of the sphere image. No
/// pixel near the border is left out then.
const NEGLIGIBLE_PX: f64 = 0.4;
/// Least standard deviation of a constant in a fit, metres or radians: it keeps its prior finite.
const MIN_SIGMA: f64 = 2e-5;
/// Distance of a body's middle from the border, as a share of its radius, up to which each half shows a
/// good part of it.
const MIDDLE_SHARE: f64 = 0.7;

/// The halves that show a body.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Halves {
    shown: Vec<Half>,
    camera_from_patch: UnitQuaternion<f64>,
    /// The constants of the camera, and the body's middle at the start.
    stitch: Option<(Stitch, Vector3<f64>)>,
    /// Whether all of the body lies where both lenses may show. It is taken to be between where they
    /// show it.
    is_mixed: bool,
}

impl Halves {
    /// The halves that show a body with its middle at this place in the camera frame.
    pub(super) fn of(picture: &Picture<'_>, place: &Vector3<f64>, radius_m: f64) -> Self {
        let camera_from_patch = picture.view.camera_from_view;
        let whole =
            Self { shown: vec![Half::Ahead], camera_from_patch, stitch: None, is_mixed: false };
        let Some(stitch) = picture.stitch else { return whole };
        let (size, deviation) = stitch.extent_rad(place);
        if (size + deviation) * picture.pixels_per_radian < NEGLIGIBLE_PX {
            return whole;
        }
        let shown_by = ShownBy::of(place, radius_m);
        let shown = match shown_by {
            ShownBy::One(half) => vec![half],
            ShownBy::Both => Half::ALL.to_vec(),
            ShownBy::Mixed => whole.shown.clone(),
        };
        let is_mixed = shown_by == ShownBy::Mixed;
        Self { shown, stitch: Some((stitch, *place)), is_mixed, ..whole }
    }

    /// Number of halves: one or two.
    pub(super) fn count(&self) -> usize {
        self.shown.len()
    }

    /// Where each half shows a body with this pose, in the patch's axes. The constants of the camera
    /// differ from the assumed ones by `change`.
    pub(super) fn poses(
        &self,
        patch_from_markers: &Isometry3<f64>,
        change: &Vector5<f64>,
    ) -> impl Iterator<Item = Isometry3<f64>> {
        self.shown.iter().map(move |half| self.shown_from_patch(*half, change) * patch_from_markers)
    }

    fn shown_from_patch(&self, half: Half, change: &Vector5<f64>) -> Isometry3<f64> {
        let Some((stitch, place)) = self.stitch.filter(|_| !self.is_mixed) else {
            return Isometry3::identity();
        };
        let shown_from_camera = stitch.changed(change).shown_from_camera(half, &place);
        self.camera_from_patch.inverse() * shown_from_camera * self.camera_from_patch
    }

    /// The pose of a body where constants that differ by `change` make a half show it as it does at
    /// `patch_from_markers` without that change.
    pub(super) fn shown_alike(
        &self,
        half: Half,
        patch_from_markers: &Isometry3<f64>,
        change: &Vector5<f64>,
    ) -> Isometry3<f64> {
        let shown = self.shown_from_patch(half, &Vector5::zeros()) * patch_from_markers;
        self.shown_from_patch(half, change).inverse() * shown
    }

    /// Whether the pixel of this direction shows the half of this number, and no other. Where there is
    /// one picture, or all of the body may show both lenses, every pixel does.
    #[inline]
    pub(super) fn shows(&self, half: u8, direction_in_patch: &Vector3<f64>) -> bool {
        if self.stitch.is_none() || self.is_mixed {
            return true;
        }
        let unmixed = Half::unmixed(&(self.camera_from_patch * direction_in_patch));
        unmixed.is_some() && unmixed == self.shown.get(usize::from(half)).copied()
    }

    /// Whether each half shows a good part of the body.
    pub(super) fn show_both_sides(&self, radius_m: f64) -> bool {
        let middle = self.stitch.filter(|_| self.shown.len() > 1);
        middle.is_some_and(|(_, place)| place.x.abs() < MIDDLE_SHARE * radius_m)
    }

    /// Derivative of what a half shows by the constants. It is multiplied by the derivative by the
    /// pose at which the half shows the body: by its shift and its rotation, as in
    /// [`PointFlow::by_pose`](super::model::geometry::PointFlow::by_pose).
    pub(super) fn by_constants(&self, half: usize) -> SMatrix<f64, 5, 6> {
        let Some((_, place)) = &self.stitch else { return SMatrix::zeros() };
        let in_camera = Stitch::pose_by_constants(self.shown[half], place);
        let patch_from_camera = self.camera_from_patch.inverse().to_rotation_matrix();
        let mut in_patch = SMatrix::<f64, 6, 5>::zeros();
        for at in [0, 3] {
            let turned = patch_from_camera * in_camera.fixed_view::<3, 5>(at, 0);
            in_patch.fixed_view_mut::<3, 5>(at, 0).copy_from(&turned);
        }
        in_patch.transpose()
    }

    /// Covariance of the constants before the fit. `None` where one half shows all of the body.
    pub(super) fn prior(&self) -> Option<Matrix5<f64>> {
        let (stitch, _) = self.stitch.filter(|_| self.shown.len() > 1)?;
        Some(stitch.covariance() + Matrix5::identity() * MIN_SIGMA.powi(2))
    }

    /// The change of the constants that moves the halves most against each other, by one standard
    /// deviation, and that deviation of the disparity, radians.
    pub(super) fn most_uncertain(&self) -> (Vector5<f64>, f64) {
        let Some((stitch, place)) = self.stitch else { return (Vector5::zeros(), 0.0) };
        let by = Stitch::by_constants(&place);
        let axes = (by * stitch.covariance() * by.transpose()).symmetric_eigen();
        let most = axes.eigenvalues.imax();
        let deviation_rad = axes.eigenvalues[most].max(0.0).sqrt();
        let change = stitch.covariance() * by.transpose() * axes.eigenvectors.column(most);
        (change / deviation_rad.max(f64::MIN_POSITIVE), deviation_rad)
    }

    /// Covariance of the body's pose if both halves may show all of it: position (m), then rotation
    /// vector (rad), in the camera frame.
    pub(super) fn mixed_covariance(&self, place_in_camera: &Vector3<f64>) -> Matrix6<f64> {
        match self.stitch.filter(|_| self.is_mixed) {
            Some((stitch, _)) => stitch.mixed_covariance(place_in_camera),
            None => Matrix6::zeros(),
        }
    }

    /// Covariance that predictions of the pose lack, because all come from one half. Zero if that half
    /// shows all of the body.
    pub(super) fn of_predictions(&self) -> Matrix6<f64> {
        match self.stitch.filter(|_| self.shown.len() > 1) {
            Some((stitch, place)) => stitch.pose_covariance(&place),
            None => Matrix6::zeros(),
        }
    }

    /// What a fit says of the camera's constants, without their prior: of the disparity at the body.
    /// How one half magnifies the body against the other, and how its nearer facets move, says
    /// something of them too, but errors of the body's shape look the same.
    ///
    /// `change` are the fitted constants less the assumed ones, `covariance` is theirs. The prior
    /// counts `weight` times in the fit. Both are divided by `factor`.
    pub(super) fn seen(
        &self,
        change: &Vector5<f64>,
        covariance: &Matrix5<f64>,
        weight: f64,
        factor: f64,
    ) -> Option<SeenStitch> {
        let ((stitch, place), before) = self.stitch.zip(self.prior())?;
        let by_constants = Stitch::by_constants(&place);
        let of_disparity = |covariance: &Matrix5<f64>| {
            let covariance: Matrix3<f64> = by_constants * covariance * by_constants.transpose();
            covariance.cholesky().map(|covariance| covariance.inverse())
        };
        let (both, before) = of_disparity(covariance).zip(of_disparity(&before))?;
        // Rounding and robust weights may leave less than the prior along some axis: nothing was
        // seen there.
        let axes = (both - before * weight).symmetric_eigen();
        let is_seen = axes.eigenvalues.map(|information| f64::from(information > 0.0));
        let seen =
            axes.eigenvectors * Matrix3::from_diagonal(&is_seen) * axes.eigenvectors.transpose();
        let information = seen * (both - before * weight) * seen / factor;
        let moment = seen * both * by_constants * change / factor;
        let information = by_constants.transpose() * information * by_constants;
        let moment = by_constants.transpose() * moment + information * stitch.constants();
        let is_finite = information.iter().chain(moment.iter()).all(|x| x.is_finite());
        is_finite.then_some(SeenStitch { information, moment })
    }
}
