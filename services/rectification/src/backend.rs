//! Choice of the back end.

use flockeye_config::Backend;
use flockeye_geometry::camera::Camera;
use flockeye_runtime::findings::Finding;

use crate::cpu::CpuRectifier;
use crate::gpu::{FoundAdapter, GpuRectifier};
use crate::rectifier::{Rectifier, RectifyError};

/// Findings about this machine's graphics processors, for `flockeye doctor`.
pub(crate) fn examine(choice: Backend) -> Vec<Finding> {
    const TOPIC: &str = "graphics";
    const CURE: &str = "install the driver (mesa-vulkan-drivers for Intel and AMD), and let the user be in the \
                        groups video and render";
    let is_asked_for = choice == Backend::Gpu;
    let without = |what: String| match is_asked_for {
        true => Finding::problem(TOPIC, what, CURE),
        false => {
            Finding::note(TOPIC, format!("{what}; views are cut by the processor")).with_cure(CURE)
        }
    };
    vec![match FoundAdapter::best() {
        _ if choice == Backend::Cpu => {
            Finding::fine(TOPIC, "views are cut by the processor, as configured")
        }
        Err(error) => without(error.to_string()),
        Ok(found) => {
            let (description, is_software) = (found.description(), found.is_software());
            match GpuRectifier::open(found) {
                Err(error) => without(format!("{description}: {error}")),
                Ok(_) if is_software && is_asked_for => Finding::warning(
                    TOPIC,
                    format!(
                        "{description} is software, and slower than cutting views on the processor"
                    ),
                    "rectification.backend: auto",
                ),
                Ok(_) if is_software => without(format!("{description} is software")),
                Ok(_) => Finding::fine(TOPIC, description),
            }
        }
    }]
}

/// The back end for `choice` and frames of `camera`, and the reason as text. The CPU back end uses
/// up to `threads` threads.
///
/// # Errors
/// `Gpu` was configured, but no device works, or its memory is too small for a frame.
pub(crate) fn choose_backend(
    choice: Backend,
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
        Backend::Cpu => Ok(cpu("the configuration asks for it".into())),
        Backend::Gpu => Ok((gpu(FoundAdapter::best()?)?, "the configuration asks for it".into())),
        Backend::Auto => Ok(match FoundAdapter::best() {
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
        let (backend, why) = choose_backend(Backend::Cpu, 2, &CAMERA).unwrap();
        assert!(backend.name().starts_with("cpu"), "{}", backend.name());
        assert!(why.contains("asks"), "{why}");
    }

    #[test]
    fn what_is_asked_for_is_not_there_or_works() {
        use flockeye_runtime::findings::Gravity;
        let has_any = FoundAdapter::best().is_ok();
        let gravity = |choice| examine(choice)[0].gravity;
        assert_eq!(gravity(Backend::Cpu), Gravity::Fine);
        assert!(gravity(Backend::Auto) <= Gravity::Note);
        assert_eq!(gravity(Backend::Gpu) == Gravity::Problem, !has_any);
    }

    #[test]
    fn auto_never_takes_a_software_device() {
        let (backend, why) = choose_backend(Backend::Auto, 1, &CAMERA).unwrap();
        let has_real = FoundAdapter::best().is_ok_and(|found| !found.is_software());
        // A real device may fail to open; a software one must not be taken.
        assert!(has_real || backend.name().starts_with("cpu"), "{}: {why}", backend.name());
    }
}
