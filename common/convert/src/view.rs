//! Geometry and pixels of a view's message.

use flockeye_contract::{PlannedView, ViewHeader};
use flockeye_geometry::view::View;
use flockeye_imaging::image::{ImageError, LumaImage};
use flockeye_imaging::light::LightError;
use nalgebra::{UnitQuaternion, Vector3};

use crate::pose::rotation;

/// Reason why a view's pixels cannot be used.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ViewError {
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Light(#[from] LightError),
    #[error(
        "its curve is a table, but the configuration has none. Cure: set camera.response to table, \
         and camera.response_table"
    )]
    NoTable,
}

/// Geometry of a view from its header. The rotation is normalised; the contract's check has refused
/// quaternions that are not of length 1.
pub fn view_of(header: &ViewHeader) -> View {
    View {
        camera_from_view: rotation(header.camera_from_view),
        focal_px: header.focal_px,
        size_px: header.size_px,
    }
}

/// A planned view at a frame's exposure: a region of interest turns with its neighbour.
pub fn at_exposure(planned: &PlannedView, exposure_ns: i64) -> View {
    let reference_from_view = rotation(planned.camera_from_view);
    let elapsed_s = (exposure_ns - planned.reference_ns) as f64 * 1e-9;
    let turn = Vector3::from(planned.rate_in_camera) * elapsed_s;
    // A prediction for a distant time has no meaning.
    let is_near = turn.norm() < 0.5;
    let turn =
        if is_near { UnitQuaternion::from_scaled_axis(turn) } else { UnitQuaternion::identity() };
    View {
        camera_from_view: turn * reference_from_view,
        focal_px: planned.focal_px,
        size_px: planned.size_px,
    }
}

/// Pixels of a view, from its header and the message's items.
///
/// # Errors
/// The items are too few.
pub fn image_of<'p>(header: &ViewHeader, pixels: &'p [u8]) -> Result<LumaImage<'p>, ViewError> {
    let size = header.size_px as usize;
    Ok(LumaImage::new(pixels, size, size, header.stride as usize)?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_view_shorter_than_it_says_is_refused() {
        let header = ViewHeader { size_px: 10, stride: 10, ..ViewHeader::default() };
        assert!(image_of(&header, &[0; 99]).is_err());
        assert_eq!(image_of(&header, &[0; 100]).unwrap().height(), 10);
    }

    #[test]
    fn a_region_of_interest_turns_with_its_neighbour() {
        let mut view =
            PlannedView { camera_from_view: [0.0, 0.0, 0.0, 1.0], ..PlannedView::default() };
        view.reference_ns = 1_000_000_000;
        view.rate_in_camera = [0.0, 0.0, 2.0];
        let turned = at_exposure(&view, 1_010_000_000).camera_from_view;
        let wanted = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.02);
        assert!(turned.angle_to(&wanted) < 1e-12);
        let far = at_exposure(&view, 9_000_000_000).camera_from_view;
        assert!(far.angle() < 1e-12, "a plan from another time is taken as it is");
    }
}
