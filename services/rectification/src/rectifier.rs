//! Interface of the back ends.

use flockeye_contract::FrameOrder;
use flockeye_imaging::sphere::{Cut, SphereError, SphereImage};

/// Cuts views from frames. A [`FrameOrder`] identifies a frame: images with equal order are taken
/// as equal.
///
/// [`Rectifier::cut`] alone is sufficient for any view of any frame. The other two calls let a GPU
/// work ahead. [`Rectifier::prepare`] announces the next frame, which is uploaded while another is
/// being cut. [`Rectifier::order`] announces views, which are cut together. Both return at once,
/// and may do nothing.
///
/// The pixels of both back ends differ by at most 2. The bytes of a back end do not depend on
/// earlier calls.
pub trait Rectifier {
    /// Name of the back end and its device, for the log.
    fn name(&self) -> String;

    /// Begins the upload of a frame. It may replace a prepared frame that was never cut.
    ///
    /// # Errors
    /// The device was lost or has no room for the frame.
    fn prepare(&mut self, _: FrameOrder, _: &SphereImage<'_>) -> Result<(), RectifyError> {
        Ok(())
    }

    /// Begins to make `cuts` of a frame. Repeated cuts are made once. Invalid cuts are skipped;
    /// [`Rectifier::cut`] refuses them.
    ///
    /// # Errors
    /// The device was lost, or has no room for the frame or a view.
    fn order(&mut self, _: FrameOrder, _: &SphereImage<'_>, _: &[Cut]) -> Result<(), RectifyError> {
        Ok(())
    }

    /// Writes a cut of a frame into `out`, rows of `size_px` bytes without gaps.
    ///
    /// # Errors
    /// An invalid view, a short output, a frame or view too large for the device, or a lost device.
    /// After [`RectifyError::is_lost`] the rectifier cannot be used.
    fn cut(
        &mut self,
        frame: FrameOrder,
        sphere: &SphereImage<'_>,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<(), RectifyError>;
}

/// Errors of a back end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum RectifyError {
    /// The sphere image, a view or an output is invalid.
    #[error(transparent)]
    Sphere(#[from] SphereError),
    /// No driver offers a device.
    #[error(
        "no Vulkan device was found; install the driver of the graphics processor (Debian: \
         mesa-vulkan-drivers) or set the back end to 'cpu'"
    )]
    NoAdapter,
    /// The device exists, but cannot be opened.
    #[error("'{adapter}' cannot be used: {reason}; set the back end to 'cpu' to go without it")]
    Device { adapter: String, reason: String },
    /// A buffer exceeds the device's limit.
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
    /// Whether the device is lost, so that another rectifier must be created.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Lost { .. })
    }
}
