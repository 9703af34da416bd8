//! CPU back end.

use flockeye_contract::FrameOrder;
use flockeye_imaging::sphere::{Cut, SphereImage, rectify_all};

use crate::rectifier::{Rectifier, RectifyError};

/// Cuts views on request with the kernel of [`flockeye_imaging::sphere`], directly from the frame.
#[derive(Debug, Clone, Copy)]
pub struct CpuRectifier {
    threads: usize,
}

impl CpuRectifier {
    /// A back end with up to `threads` threads, at least one.
    pub fn new(threads: usize) -> Self {
        Self { threads: threads.max(1) }
    }
}

impl Rectifier for CpuRectifier {
    fn name(&self) -> String {
        let instructions = flockeye_imaging::sphere::instructions();
        match self.threads {
            1 => format!("cpu: 1 thread, {instructions}"),
            threads => format!("cpu: {threads} threads, {instructions}"),
        }
    }

    fn cut(
        &mut self,
        _: FrameOrder,
        sphere: &SphereImage<'_>,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<(), RectifyError> {
        Ok(rectify_all(sphere, std::slice::from_ref(cut), &mut [out], self.threads)?)
    }
}
