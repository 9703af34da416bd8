//! A frame on the device, and the views cut from it.

use flockeye_contract::FrameOrder;
use flockeye_imaging::sphere::{Cut, SphereImage};
use wgpu::{Buffer, BufferUsages, MapMode, SubmissionIndex};

use super::adapter::Memory;
use super::batch::Batch;
use super::device::Device;
use super::layout::SphereUniform;
use crate::rectifier::RectifyError;

/// Name of a frame's buffer in errors.
pub(super) const FRAME: &str = "bytes of a frame";

/// A frame and its buffers, which are reused for later frames.
#[derive(Debug)]
pub(super) struct FrameSlot {
    frame: Option<(FrameOrder, SphereUniform)>,
    /// Last use, by the rectifier's call counter.
    pub used: u64,
    sphere: Buffer,
    luma: Buffer,
    /// Staging buffer to which the CPU writes the pixels, if it cannot write in place.
    staging: Option<Buffer>,
    batches: Vec<Batch>,
    /// Number of batches with views of this frame.
    pub(super) filled: usize,
    /// Last submission that uses the frame's buffers.
    work: Option<SubmissionIndex>,
}

impl FrameSlot {
    pub(super) fn new(device: &Device) -> Self {
        let luma = match device.memory {
            Memory::Shared => BufferUsages::STORAGE | BufferUsages::MAP_WRITE,
            Memory::Apart => BufferUsages::STORAGE | BufferUsages::COPY_DST,
        };
        let staging = BufferUsages::MAP_WRITE | BufferUsages::COPY_SRC;
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        Self {
            frame: None,
            used: 0,
            sphere: device.buffer(size_of::<SphereUniform>() as u64, uniform),
            luma: device.buffer(4, luma),
            staging: (device.memory == Memory::Apart).then(|| device.buffer(4, staging)),
            batches: Vec::new(),
            filled: 0,
            work: None,
        }
    }

    pub(super) fn holds(&self, frame: FrameOrder, sphere: &SphereImage<'_>) -> bool {
        self.frame == Some((frame, SphereUniform::new(sphere.camera(), sphere.stride())))
    }

    /// Whether the slot has a frame without ordered views.
    pub(super) fn is_untouched(&self) -> bool {
        self.frame.is_some() && self.filled == 0
    }

    /// Uploads another frame. The pixels are copied before this returns. A device with its own
    /// memory copies them from the staging buffer later.
    pub(super) fn upload(
        &mut self,
        device: &Device,
        frame: FrameOrder,
        sphere: &SphereImage<'_>,
    ) -> Result<(), RectifyError> {
        self.frame = None;
        for batch in &mut self.batches[..self.filled] {
            batch.clear();
        }
        self.filled = 0;
        let camera = sphere.camera();
        let length = (camera.height() as usize - 1) * sphere.stride() + camera.width() as usize;
        let pixels = &sphere.pixels()[..length];
        let bytes = (length as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        device.check_fits(FRAME, bytes)?;
        if device.grow(&mut self.luma, bytes) {
            self.batches.iter_mut().for_each(|batch| batch.bind_group = None);
        }
        if let Some(staging) = &mut self.staging {
            device.grow(staging, bytes);
        }
        let target = self.staging.as_ref().unwrap_or(&self.luma);
        let mapped = device.map(target, MapMode::Write, bytes);
        device.wait(&mapped, self.work.as_ref())?;
        let range = target.get_mapped_range_mut(..bytes);
        range
            .map_err(|error| device.give_up(error.to_string()))?
            .slice(..length)
            .copy_from_slice(pixels);
        target.unmap();

        let uniform = SphereUniform::new(camera, sphere.stride());
        device.queue.write_buffer(&self.sphere, 0, bytemuck::bytes_of(&uniform));
        if let Some(staging) = &self.staging {
            let mut encoder = device.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(staging, 0, &self.luma, 0, bytes);
            self.work = Some(device.queue.submit([encoder.finish()]));
        }
        self.frame = Some((frame, uniform));
        device.check_alive()
    }

    /// Submits those of `cuts` that were not ordered before: in one batch, unless the output is too
    /// large.
    pub(super) fn order(
        &mut self,
        device: &Device,
        sphere: &SphereImage<'_>,
        cuts: impl IntoIterator<Item = Cut>,
    ) -> Result<(), RectifyError> {
        let cuts: Vec<Cut> = cuts.into_iter().filter(|cut| self.find(cut).is_none()).collect();
        let mut rest = cuts.as_slice();
        while !rest.is_empty() {
            if self.filled == self.batches.len() {
                self.batches.push(Batch::new(device));
            }
            let batch = &mut self.batches[self.filled];
            let taken = batch.fill(device, rest, sphere.camera())?;
            self.work = Some(batch.submit(device, sphere.camera(), &self.sphere, &self.luma));
            self.filled += 1;
            rest = &rest[taken..];
        }
        device.check_alive()
    }

    /// Copies an ordered view to `out`. Returns false if it was not ordered.
    pub(super) fn copy_out(
        &mut self,
        device: &Device,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<bool, RectifyError> {
        let Some((batch, index)) = self.find(cut) else { return Ok(false) };
        self.batches[batch].copy_out(device, index, out)?;
        Ok(true)
    }

    fn find(&self, cut: &Cut) -> Option<(usize, usize)> {
        self.batches[..self.filled].iter().enumerate().find_map(|(batch, held)| {
            let index = held.cuts.iter().position(|other| other == cut)?;
            Some((batch, index))
        })
    }
}
