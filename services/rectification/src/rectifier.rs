//! The back ends' common face, and the choice between them.

use flockeye_geometry::camera::Camera;
use flockeye_imaging::sphere::{Cut, SphereError, SphereImage};

use crate::cpu::CpuRectifier;
use crate::gpu::{FoundAdapter, GpuRectifier};

/// What tells frames apart. Two images under one key are taken for the same.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct FrameKey {
    /// The source's process.
    pub source_generation: u32,
    /// Its run.
    pub epoch: u32,
    /// The frame's number in it.
    pub sequence: u64,
}

/// Cuts views from frames.
///
/// [`Rectifier::cut`] alone gives any view of any frame. A graphics processor works ahead if it is
/// told before: of a frame that will come next by [`Rectifier::prepare`], so that it is uploaded
/// while another is being cut, and of views that will be asked for by [`Rectifier::order`], so that
/// they are cut together. Both return at once, and whoever does not need them ignores them.
///
/// Both back ends give the same greys within 2, and each the same bytes whatever was prepared and
/// ordered.
pub trait Rectifier {
    /// The back end and the device that works, for the log.
    fn name(&self) -> String;

    /// Begins to take up a frame. One prepared before and not cut since may make room for it.
    ///
    /// # Errors
    /// The device was lost or cannot hold the frame.
    fn prepare(&mut self, frame: FrameKey, sphere: &SphereImage<'_>) -> Result<(), RectifyError>;

    /// Begins to make `cuts` of a frame. Those ordered before are made only once, those that show
    /// nothing are left to [`Rectifier::cut`] to refuse.
    ///
    /// # Errors
    /// The device was lost, or cannot hold the frame or a view.
    fn order(
        &mut self,
        frame: FrameKey,
        sphere: &SphereImage<'_>,
        cuts: &[Cut],
    ) -> Result<(), RectifyError>;

    /// Makes `cut` of a frame into `out`, rows of `size_px` bytes without gaps.
    ///
    /// # Errors
    /// A view that shows nothing, an output that is too short, a frame or a view that the device
    /// cannot hold, a lost device. After [`RectifyError::is_lost`] the rectifier is of no more use.
    fn cut(
        &mut self,
        frame: FrameKey,
        sphere: &SphereImage<'_>,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<(), RectifyError>;
}

/// Why no view was cut.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
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
    Device {
        /// The device's name.
        adapter: String,
        /// What its driver says.
        reason: String,
    },
    /// More than the device can hold.
    #[error(
        "the {what} are {needed}, but '{adapter}' allows {limit}; make it smaller or set \
         rectification.backend to 'cpu'"
    )]
    TooLarge {
        /// What does not fit, with its unit.
        what: &'static str,
        /// How much it takes.
        needed: u64,
        /// How much is allowed.
        limit: u64,
        /// The device's name.
        adapter: String,
    },
    /// The device stopped working.
    #[error("'{adapter}' was lost: {reason}")]
    Lost {
        /// The device's name.
        adapter: String,
        /// What its driver says.
        reason: String,
    },
}

impl RectifyError {
    /// Whether the device is gone, so that another rectifier must be made.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Lost { .. })
    }
}

/// Which back end a user asks for (`rectification.backend` in pipeline.yaml).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BackendChoice {
    /// A graphics processor if there is a real one, the processor otherwise.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// A graphics processor, be it a software one.
    Gpu,
}

/// The back end for `choice` and frames of `camera`, and in words why it is that one. The processor
/// works with up to `threads` threads.
///
/// # Errors
/// `Gpu` was asked for and there is none that works, or it cannot hold a frame.
pub fn choose_backend(
    choice: BackendChoice,
    threads: usize,
    camera: &Camera,
) -> Result<(Box<dyn Rectifier>, String), RectifyError> {
    let cpu = |why: String| -> (Box<dyn Rectifier>, String) {
        (Box::new(CpuRectifier::new(threads)), why)
    };
    let gpu = |found| -> Result<Box<dyn Rectifier>, RectifyError> {
        let gpu = GpuRectifier::open(found)?;
        gpu.check_frame(camera)?;
        Ok(Box::new(gpu))
    };
    match choice {
        BackendChoice::Cpu => Ok(cpu("the configuration asks for it".into())),
        BackendChoice::Gpu => {
            Ok((gpu(FoundAdapter::best()?)?, "the configuration asks for it".into()))
        }
        BackendChoice::Auto => Ok(match FoundAdapter::best() {
            Err(_) => cpu("there is no Vulkan device".into()),
            Ok(found) if found.is_software() => {
                let name = found.name();
                cpu(format!("the only Vulkan device, '{name}', is software on this processor"))
            }
            Ok(found) => match gpu(found) {
                Err(error) => cpu(error.to_string()),
                Ok(gpu) => (gpu, "there is a graphics processor".into()),
            },
        }),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    const CAMERA: Camera = Camera::equirectangular(3840, 1920);

    #[test]
    fn who_asks_for_the_processor_gets_it() {
        let (backend, why) = choose_backend(BackendChoice::Cpu, 2, &CAMERA).unwrap();
        assert!(backend.name().starts_with("cpu"), "{}", backend.name());
        assert!(why.contains("asks"), "{why}");
    }

    #[test]
    fn auto_never_takes_a_software_device() {
        let (backend, why) = choose_backend(BackendChoice::Auto, 1, &CAMERA).unwrap();
        let has_real = FoundAdapter::best().is_ok_and(|found| !found.is_software());
        // A real device may fail to open; a software one must not be taken.
        assert!(has_real || backend.name().starts_with("cpu"), "{}: {why}", backend.name());
    }
}
