//! A back end, and the processor in its place once it is lost.

use flockeye_imaging::sphere::{Cut, SphereImage};
use flockeye_runtime::health::SharedCounters;

use crate::cpu::CpuRectifier;
use crate::rectifier::{FrameKey, Rectifier, RectifyError};

/// Hands everything on to a back end. When that is lost, be it in the middle of a frame, the
/// processor does what the back end could not, and all that comes after; one warning reports it.
pub struct Standby {
    active: Box<dyn Rectifier>,
    threads: usize,
    counters: SharedCounters,
}

impl Standby {
    /// Stands by for `active` with up to `threads` threads of the processor. The health reports of
    /// `counters` name whoever works.
    pub fn new(active: Box<dyn Rectifier>, threads: usize, counters: SharedCounters) -> Self {
        counters.set_detail(active.name());
        Self { active, threads, counters }
    }

    fn attempt(
        &mut self,
        mut work: impl FnMut(&mut dyn Rectifier) -> Result<(), RectifyError>,
    ) -> Result<(), RectifyError> {
        match work(self.active.as_mut()) {
            Err(error) if error.is_lost() => {
                tracing::warn!(
                    "{error}; the processor takes over. Cure: look into the kernel's log for what the \
                     driver says; the device is tried again when this stage is started again"
                );
                self.active = Box::new(CpuRectifier::new(self.threads));
                self.counters.set_detail(self.active.name());
                work(self.active.as_mut())
            }
            other => other,
        }
    }
}

impl Rectifier for Standby {
    fn name(&self) -> String {
        self.active.name()
    }

    fn prepare(&mut self, frame: FrameKey, sphere: &SphereImage<'_>) -> Result<(), RectifyError> {
        self.attempt(|active| active.prepare(frame, sphere))
    }

    fn order(
        &mut self,
        frame: FrameKey,
        sphere: &SphereImage<'_>,
        cuts: &[Cut],
    ) -> Result<(), RectifyError> {
        self.attempt(|active| active.order(frame, sphere, cuts))
    }

    fn cut(
        &mut self,
        frame: FrameKey,
        sphere: &SphereImage<'_>,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<(), RectifyError> {
        self.attempt(|active| active.cut(frame, sphere, cut, out))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_geometry::camera::Camera;
    use flockeye_geometry::view::View;
    use nalgebra::Vector3;

    /// A device that is lost after it has cut so many views.
    struct Mortal(usize);

    impl Rectifier for Mortal {
        fn name(&self) -> String {
            "mortal".into()
        }

        fn prepare(&mut self, _: FrameKey, _: &SphereImage<'_>) -> Result<(), RectifyError> {
            Ok(())
        }

        fn order(
            &mut self,
            _: FrameKey,
            _: &SphereImage<'_>,
            _: &[Cut],
        ) -> Result<(), RectifyError> {
            Ok(())
        }

        fn cut(
            &mut self,
            _: FrameKey,
            _: &SphereImage<'_>,
            _: &Cut,
            out: &mut [u8],
        ) -> Result<(), RectifyError> {
            let lost =
                || RectifyError::Lost { adapter: "mortal".into(), reason: "it is gone".into() };
            self.0 = self.0.checked_sub(1).ok_or_else(lost)?;
            out.fill(1);
            Ok(())
        }
    }

    #[test]
    fn the_processor_goes_on_in_the_middle_of_a_frame() {
        let mut rectifier = Standby::new(Box::new(Mortal(2)), 1, SharedCounters::default());
        let pixels = [70; 64 * 32];
        let sphere = SphereImage::new(&pixels, 64, Camera::equirectangular(64, 32)).unwrap();
        let cut = Cut::bilinear(View::looking_at(&Vector3::x_axis(), 1.0, 4));
        let mut greys = Vec::new();
        for _ in 0..4 {
            let mut out = [0; 16];
            rectifier.cut(FrameKey::default(), &sphere, &cut, &mut out).unwrap();
            greys.push(out[0]);
        }
        assert_eq!(greys, [1, 1, 70, 70]);
        assert!(rectifier.name().starts_with("cpu: 1 thread"));
    }

    #[test]
    fn what_is_no_loss_is_passed_on() {
        let mut rectifier =
            Standby::new(Box::new(CpuRectifier::new(1)), 1, SharedCounters::default());
        let pixels = [70; 64 * 32];
        let sphere = SphereImage::new(&pixels, 64, Camera::equirectangular(64, 32)).unwrap();
        let cut = Cut::bilinear(View::looking_at(&Vector3::x_axis(), 1.0, 4));
        let error = rectifier.cut(FrameKey::default(), &sphere, &cut, &mut [0; 3]).unwrap_err();
        assert!(matches!(error, RectifyError::Sphere(_)), "{error}");
    }
}
