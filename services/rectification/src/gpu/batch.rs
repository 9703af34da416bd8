//! A batch of views of a frame that are cut together.

use flockeye_geometry::camera::Camera;
use flockeye_imaging::sphere::Cut;
use wgpu::{BindGroup, Buffer, BufferUsages, BufferView, MapMode, SubmissionIndex};

use super::adapter::Memory;
use super::device::{Device, Mapped};
use super::layout::{BatchLayout, ViewParameters};
use crate::rectifier::RectifyError;

/// Views of a frame, and their buffers, which are reused for later frames.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) cuts: Vec<Cut>,
    layout: BatchLayout,
    views: Buffer,
    output: Buffer,
    /// Buffer to which the output is copied, if it cannot be read in place.
    readback: Option<Buffer>,
    /// `None` if a buffer has been replaced since it was bound.
    pub(super) bind_group: Option<BindGroup>,
    result: CutOutput,
}

/// State of the output.
#[derive(Debug)]
enum CutOutput {
    None,
    Awaited { mapped: Mapped, work: SubmissionIndex },
    There(BufferView),
}

impl Batch {
    pub(super) fn new(device: &Device) -> Self {
        let small = size_of::<[u32; 4]>() + size_of::<ViewParameters>();
        let buffer = |usage| device.buffer(small as u64, usage);
        let (output, readback) = match device.memory {
            Memory::Shared => (buffer(BufferUsages::STORAGE | BufferUsages::MAP_READ), None),
            Memory::Apart => (
                buffer(BufferUsages::STORAGE | BufferUsages::COPY_SRC),
                Some(buffer(BufferUsages::MAP_READ | BufferUsages::COPY_DST)),
            ),
        };
        Self {
            cuts: Vec::new(),
            layout: BatchLayout::default(),
            views: buffer(BufferUsages::STORAGE | BufferUsages::COPY_DST),
            output,
            readback,
            bind_group: None,
            result: CutOutput::None,
        }
    }

    /// Removes all views.
    pub(super) fn clear(&mut self) {
        self.cuts.clear();
        self.layout = BatchLayout::default();
        // The mapped view must be dropped before the buffer is unmapped.
        match std::mem::replace(&mut self.result, CutOutput::None) {
            CutOutput::None => return,
            CutOutput::Awaited { .. } => {}
            CutOutput::There(bytes) => drop(bytes),
        }
        self.readable().unmap();
    }

    fn readable(&self) -> &Buffer {
        self.readback.as_ref().unwrap_or(&self.output)
    }

    /// Fills an empty batch with as many of `cuts` as fit into one output. Returns their number.
    pub(super) fn fill(
        &mut self,
        device: &Device,
        cuts: &[Cut],
        camera: &Camera,
    ) -> Result<usize, RectifyError> {
        let most = device.max_bytes;
        let fitting = cuts.iter().take_while(|cut| self.layout.add(cut, camera, most)).count();
        self.cuts.extend_from_slice(&cuts[..fitting]);
        if let (0, Some(cut)) = (fitting, cuts.first()) {
            device.check_fits("bytes of a view", BatchLayout::bytes_alone(cut.view.size_px))?;
        }
        Ok(fitting)
    }

    /// Submits the cuts of its views from the frame in `sphere` and `luma`, of this camera. Does
    /// not wait for them.
    pub(super) fn submit(
        &mut self,
        device: &Device,
        camera: &Camera,
        sphere: &Buffer,
        luma: &Buffer,
    ) -> SubmissionIndex {
        let bytes = self.layout.bytes();
        let parameters: &[u8] = bytemuck::cast_slice(&self.layout.views);
        let header = self.layout.header();
        let header = bytemuck::bytes_of(&header);
        let mut has_grown = device.grow(&mut self.views, (header.len() + parameters.len()) as u64);
        has_grown |= device.grow(&mut self.output, bytes);
        if let Some(readback) = &mut self.readback {
            device.grow(readback, bytes);
        }
        if has_grown {
            self.bind_group = None;
        }
        device.queue.write_buffer(&self.views, 0, header);
        device.queue.write_buffer(&self.views, header.len() as u64, parameters);
        let bind_group = self
            .bind_group
            .get_or_insert_with(|| bind(device, [sphere, &self.views, luma, &self.output]));
        let mut encoder = device.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_bind_group(0, &*bind_group, &[]);
            let most = device.device.limits().max_compute_workgroups_per_dimension;
            let [across, down] = self.layout.workgroups(most);
            pass.set_pipeline(device.shader.pipeline(camera, &self.cuts));
            pass.dispatch_workgroups(across, down, 1);
        }
        if let Some(readback) = &self.readback {
            encoder.copy_buffer_to_buffer(&self.output, 0, readback, 0, bytes);
        }
        let work = device.queue.submit([encoder.finish()]);
        let mapped = device.map(self.readable(), MapMode::Read, bytes);
        self.result = CutOutput::Awaited { mapped, work: work.clone() };
        work
    }

    /// Waits for a view, and copies it to `out`.
    pub(super) fn copy_out(
        &mut self,
        device: &Device,
        index: usize,
        out: &mut [u8],
    ) -> Result<(), RectifyError> {
        if let CutOutput::Awaited { mapped, work } = &self.result {
            device.wait(mapped, Some(work))?;
            let bytes = self.readable().get_mapped_range(..self.layout.bytes());
            self.result =
                CutOutput::There(bytes.map_err(|error| device.give_up(error.to_string()))?);
        }
        match &self.result {
            CutOutput::There(bytes) => self.layout.copy_out(index, bytes, out),
            CutOutput::None | CutOutput::Awaited { .. } => {
                return Err(device.give_up("it was given no work".into()));
            }
        }
        Ok(())
    }
}

fn bind(device: &Device, buffers: [&Buffer; 4]) -> BindGroup {
    let entries: Vec<_> = buffers
        .into_iter()
        .zip(0..)
        .map(|(buffer, binding)| wgpu::BindGroupEntry {
            binding,
            resource: buffer.as_entire_binding(),
        })
        .collect();
    device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &device.shader.bindings,
        entries: &entries,
    })
}
