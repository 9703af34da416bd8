//! The back ends' common face.

use flockeye_contract::FrameOrder;
use flockeye_imaging::sphere::{Cut, SphereError, SphereImage};

/// Cuts views from frames. Two images of one [`FrameOrder`] are taken for the same.
///
/// [`Rectifier::cut`] alone gives any view of any frame. A graphics processor works ahead if it is
/// informed before. [`Rectifier::prepare`] names the frame that comes next, which is uploaded while
/// another is being cut. [`Rectifier::order`] names views that will be asked for, which are cut
/// together. Both return at once; a back end that does not need them ignores them.
///
/// Both back ends give the same greys within 2, and each the same bytes whatever was prepared and
/// ordered.
pub trait Rectifier {
    /// The back end and the device that works, for the log.
    fn name(&self) -> String;

    /// Begins to take up a frame. One prepared before and not cut since may make room for it.
    ///
    /// # Errors
    /// The device was lost or has no room for the frame.
    fn prepare(&mut self, _: FrameOrder, _: &SphereImage<'_>) -> Result<(), RectifyError> {
        Ok(())
    }

    /// Begins to make `cuts` of a frame. Those ordered before are made only once, those that show
    /// nothing are left to [`Rectifier::cut`] to refuse.
    ///
    /// # Errors
    /// The device was lost, or has no room for the frame or a view.
    fn order(&mut self, _: FrameOrder, _: &SphereImage<'_>, _: &[Cut]) -> Result<(), RectifyError> {
        Ok(())
    }

    /// Makes `cut` of a frame into `out`, rows of `size_px` bytes without gaps.
    ///
    /// # Errors
    /// A view that shows nothing, an output that is too short, a frame or a view that the device
    /// cannot hold, a lost device. After [`RectifyError::is_lost`] the rectifier is of no more use.
    fn cut(
        &mut self,
        frame: FrameOrder,
        sphere: &SphereImage<'_>,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<(), RectifyError>;
}

/// Why no view was cut.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum RectifyError {
    /// The sphere image, a view or an output is at fault.
    #[error(transparent)]
    Sphere(#[from] SphereError),
    /// No driver offers a device.
    #[error(
        "no Vulkan device was found; install the driver of the graphics processor (Debian: \
         mesa-vulkan-drivers) or set the back end to 'cpu'"
    )]
    NoAdapter,
    /// The device is there, but gives no access.
    #[error("'{adapter}' cannot be used: {reason}; set the back end to 'cpu' to go without it")]
    Device { adapter: String, reason: String },
    /// More than the device has room for.
    #[error(
        "the {what} are {needed}, but '{adapter}' allows {limit}; make it smaller or set \
         rectification.backend to 'cpu'"
    )]
    TooLarge { what: &'static str, needed: u64, limit: u64, adapter: String },
    /// The device stopped working.
    #[error("'{adapter}' was lost: {reason}")]
    Lost { adapter: String, reason: String },
}

impl RectifyError {
    /// Whether the device is gone, so that another rectifier must be made.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Lost { .. })
    }
}
