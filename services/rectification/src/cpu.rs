//! Views cut by the processor.

use flockeye_imaging::sphere::{Cut, SphereImage, rectify_all};

use crate::rectifier::{Rectifier, RectifyError};

/// Cuts views with the kernel of [`flockeye_imaging::sphere`], straight from the frame.
#[derive(Debug, Clone, Copy)]
pub struct CpuRectifier {
    threads: usize,
}

impl CpuRectifier {
    /// With up to `threads` threads at once, one at least.
    pub fn new(threads: usize) -> Self {
        Self { threads: threads.max(1) }
    }
}

impl Rectifier for CpuRectifier {
    fn name(&self) -> String {
        match self.threads {
            1 => "cpu: 1 thread".into(),
            threads => format!("cpu: {threads} threads"),
        }
    }

    fn begin_frame(&mut self, _sphere: &SphereImage<'_>) -> Result<(), RectifyError> {
        Ok(())
    }

    fn cut(
        &mut self,
        sphere: &SphereImage<'_>,
        cuts: &[Cut],
        outputs: &mut [&mut [u8]],
    ) -> Result<(), RectifyError> {
        Ok(rectify_all(sphere, cuts, outputs, self.threads)?)
    }
}
