//! The back ends' common face, and the choice between them.

use flockeye_imaging::sphere::{Cut, SphereError, SphereImage};

use crate::cpu::CpuRectifier;
use crate::gpu::{FoundAdapter, GpuRectifier};

/// Cuts views from frames.
///
/// [`Rectifier::begin_frame`] once for each frame, then [`Rectifier::cut`] as often as wanted.
/// Both back ends give the same greys within 2.
pub trait Rectifier: Send {
    /// The back end and the device that works, for the log.
    fn name(&self) -> String;

    /// Takes up a frame: a graphics processor uploads it here, once.
    ///
    /// # Errors
    /// The device was lost or cannot hold the frame.
    fn begin_frame(&mut self, sphere: &SphereImage<'_>) -> Result<(), RectifyError>;

    /// Makes `cuts` of the frame that was begun last, which `sphere` must be, into `outputs`: one
    /// for each view, rows of `size_px` bytes without gaps.
    ///
    /// # Errors
    /// A view that shows nothing, an output that does not fit, another frame than the one begun,
    /// a lost device. After [`RectifyError::is_lost`] the rectifier is of no more use.
    fn cut(
        &mut self,
        sphere: &SphereImage<'_>,
        cuts: &[Cut],
        outputs: &mut [&mut [u8]],
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
        "{what} take {needed}, but '{adapter}' allows {limit}; cut fewer or smaller views at once, \
         or set the back end to 'cpu'"
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
    /// Views were asked of a frame that was not begun.
    #[error("views were asked of a frame that was not begun; begin_frame comes first")]
    NotBegun,
    /// The device stopped working.
    #[error("'{adapter}' was lost: {reason}; the processor must take over")]
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

/// The back end for `choice`, and in words why it is that one. The processor works with up to
/// `threads` threads.
///
/// # Errors
/// `Gpu` was asked for and there is none that works.
pub fn choose_backend(
    choice: BackendChoice,
    threads: usize,
) -> Result<(Box<dyn Rectifier>, String), RectifyError> {
    let cpu = |why: String| -> (Box<dyn Rectifier>, String) {
        (Box::new(CpuRectifier::new(threads)), why)
    };
    match choice {
        BackendChoice::Cpu => Ok(cpu("the configuration asks for it".into())),
        BackendChoice::Gpu => {
            let gpu = GpuRectifier::open(FoundAdapter::best()?)?;
            Ok((Box::new(gpu), "the configuration asks for it".into()))
        }
        BackendChoice::Auto => Ok(match FoundAdapter::best() {
            Err(_) => cpu("there is no Vulkan device".into()),
            Ok(found) if found.is_software() => {
                let name = found.name();
                cpu(format!("the only Vulkan device, '{name}', is software on this processor"))
            }
            Ok(found) => match GpuRectifier::open(found) {
                Err(error) => cpu(error.to_string()),
                Ok(gpu) => (Box::new(gpu), "there is a graphics processor".into()),
            },
        }),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn who_asks_for_the_processor_gets_it() {
        let (backend, why) = choose_backend(BackendChoice::Cpu, 2).unwrap();
        assert!(backend.name().starts_with("cpu"), "{}", backend.name());
        assert!(why.contains("asks"), "{why}");
    }

    #[test]
    fn auto_never_takes_a_software_device() {
        let (backend, why) = choose_backend(BackendChoice::Auto, 1).unwrap();
        let has_real = FoundAdapter::best().is_ok_and(|found| !found.is_software());
        // A real device may fail to open; a software one must not be taken.
        assert!(has_real || backend.name().starts_with("cpu"), "{}: {why}", backend.name());
    }
}
