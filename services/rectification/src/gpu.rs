//! Views cut by the graphics processor: one dispatch for all views of a call.

mod adapter;
mod layout;

use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, SphereImage, check_outputs};
use wgpu::{BufferUsages, Limits};

pub use self::adapter::FoundAdapter;
use self::layout::{Layout, SphereUniform, ViewParameters};
use crate::rectifier::{Rectifier, RectifyError};

/// Views that take longer than this are not waited for: the device hangs.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Pixels along a side of a workgroup, in words across and rows down; as in the shader.
const WORKGROUP: u32 = 8;

/// Cuts views by a compute shader. The frame is uploaded once, and buffers are kept between calls.
#[derive(Debug)]
pub struct GpuRectifier {
    name: String,
    description: String,
    is_software: bool,
    device: wgpu::Device,
    queue: wgpu::Queue,
    pipeline: wgpu::ComputePipeline,
    sphere: wgpu::Buffer,
    views: wgpu::Buffer,
    luma: wgpu::Buffer,
    output: wgpu::Buffer,
    readback: wgpu::Buffer,
    /// The frame that was begun last.
    begun: Option<SphereUniform>,
    /// What the driver said first when something went wrong.
    failure: Arc<Mutex<Option<String>>>,
}

impl GpuRectifier {
    /// Opens the device and builds the shader.
    ///
    /// # Errors
    /// [`RectifyError::Device`] with the driver's words.
    pub fn open(found: FoundAdapter) -> Result<Self, RectifyError> {
        let name = found.name().to_owned();
        let refused = |reason: String| RectifyError::Device { adapter: name.clone(), reason };
        let offered = found.adapter.limits();
        // What every device has, but buffers as large as this one can have them.
        let required_limits = Limits {
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            max_buffer_size: offered.max_buffer_size,
            ..Limits::downlevel_defaults()
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("rectification"),
            required_limits,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(found.adapter.request_device(&descriptor))
            .map_err(|error| refused(error.to_string()))?;

        let failure = Arc::new(Mutex::new(None));
        let note = |failure: &Arc<Mutex<Option<String>>>, reason: String| {
            failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(reason);
        };
        let lost = Arc::clone(&failure);
        device.set_device_lost_callback(move |why, message| {
            note(&lost, format!("{why:?}: {message}"))
        });
        let uncaptured = Arc::clone(&failure);
        device.on_uncaptured_error(Arc::new(move |error| note(&uncaptured, error.to_string())));

        let shader = device.create_shader_module(wgpu::include_wgsl!("gpu/rectify.wgsl"));
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some("rectify"),
            layout: None,
            module: &shader,
            entry_point: Some("rectify"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        let buffer = |usage| {
            let size = size_of::<SphereUniform>() as u64;
            device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        let rectifier = Self {
            description: found.description(),
            is_software: found.is_software(),
            sphere: buffer(BufferUsages::UNIFORM | BufferUsages::COPY_DST),
            views: buffer(BufferUsages::STORAGE | BufferUsages::COPY_DST),
            luma: buffer(BufferUsages::STORAGE | BufferUsages::COPY_DST),
            output: buffer(BufferUsages::STORAGE | BufferUsages::COPY_SRC),
            readback: buffer(BufferUsages::MAP_READ | BufferUsages::COPY_DST),
            name: name.clone(),
            device,
            queue,
            pipeline,
            begun: None,
            failure,
        };
        match rectifier.failure() {
            None => Ok(rectifier),
            Some(reason) => Err(refused(reason)),
        }
    }

    /// Whether the device is a program on the processor.
    pub fn is_software(&self) -> bool {
        self.is_software
    }

    fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Fails if anything has gone wrong on the device so far.
    fn check_alive(&self) -> Result<(), RectifyError> {
        self.failure().map_or(Ok(()), |reason| Err(self.lost(reason)))
    }

    /// Gives the device up, for `reason` unless it has told one before.
    fn give_up(&self, reason: String) -> RectifyError {
        let mut failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        self.lost(failure.get_or_insert(reason).clone())
    }

    fn lost(&self, reason: String) -> RectifyError {
        RectifyError::Lost { adapter: self.name.clone(), reason }
    }

    fn check_fits(&self, what: &'static str, needed: u64, limit: u64) -> Result<(), RectifyError> {
        if needed > limit {
            let adapter = self.name.clone();
            return Err(RectifyError::TooLarge { what, needed, limit, adapter });
        }
        Ok(())
    }

    /// Bytes that one buffer of the shader may have.
    fn max_bytes(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// Queues the work and waits until its result can be read.
    fn run(&self, layout: &Layout) -> Result<(), RectifyError> {
        let entries: Vec<_> = [&self.sphere, &self.views, &self.luma, &self.output]
            .into_iter()
            .zip(0..)
            .map(|(buffer, binding)| wgpu::BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        let bind_group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.pipeline.get_bind_group_layout(0),
            entries: &entries,
        });
        let mut encoder = self.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &bind_group, &[]);
            let [words, rows] = layout.extent.map(|extent| extent.div_ceil(WORKGROUP));
            pass.dispatch_workgroups(words, rows, layout.views.len() as u32);
        }
        let bytes = 4 * layout.words;
        encoder.copy_buffer_to_buffer(&self.output, 0, &self.readback, 0, bytes);
        let submission = self.queue.submit([encoder.finish()]);
        let (sender, mapped) = mpsc::channel();
        self.readback.map_async(wgpu::MapMode::Read, ..bytes, move |result| {
            // Nobody receives any more only if the wait below was given up.
            let _ = sender.send(result);
        });
        let wait =
            wgpu::PollType::Wait { submission_index: Some(submission), timeout: Some(TIMEOUT) };
        self.device.poll(wait).map_err(|error| self.give_up(error.to_string()))?;
        self.check_alive()?;
        match mapped.try_recv() {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(self.give_up(error.to_string())),
            Err(_) => Err(self.give_up("its result did not come".into())),
        }
    }
}

impl Rectifier for GpuRectifier {
    fn name(&self) -> String {
        format!("gpu: {}", self.description)
    }

    fn begin_frame(&mut self, sphere: &SphereImage<'_>) -> Result<(), RectifyError> {
        self.check_alive()?;
        self.begun = None;
        let uniform = SphereUniform::new(sphere.camera(), sphere.stride());
        let rows = uniform.height as usize - 1;
        let pixels = &sphere.pixels()[..rows * sphere.stride() + uniform.width as usize];
        let bytes = (pixels.len() as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        self.check_fits("bytes of a frame", bytes, self.max_bytes())?;
        grow(&self.device, &mut self.luma, bytes);
        // Uploads are of whole words; the last one may have to be filled up.
        let (words, rest) = pixels.split_at(pixels.len() & !3);
        self.queue.write_buffer(&self.luma, 0, words);
        if !rest.is_empty() {
            let mut last = [0; 4];
            last[..rest.len()].copy_from_slice(rest);
            self.queue.write_buffer(&self.luma, words.len() as u64, &last);
        }
        self.queue.write_buffer(&self.sphere, 0, bytemuck::bytes_of(&uniform));
        self.begun = Some(uniform);
        self.check_alive()
    }

    fn cut(
        &mut self,
        sphere: &SphereImage<'_>,
        cuts: &[Cut],
        outputs: &mut [&mut [u8]],
    ) -> Result<(), RectifyError> {
        check_outputs(cuts, outputs)?;
        let views: Vec<View> = cuts.iter().map(|cut| cut.view).collect();
        self.check_alive()?;
        if self.begun != Some(SphereUniform::new(sphere.camera(), sphere.stride())) {
            return Err(RectifyError::NotBegun);
        }
        if views.is_empty() {
            return Ok(());
        }
        let layout = Layout::new(&views);
        let groups = u64::from(self.device.limits().max_compute_workgroups_per_dimension);
        self.check_fits("views of one call", views.len() as u64, groups)?;
        self.check_fits("bytes of the views of one call", 4 * layout.words, self.max_bytes())?;
        grow(&self.device, &mut self.views, (views.len() * size_of::<ViewParameters>()) as u64);
        grow(&self.device, &mut self.output, 4 * layout.words);
        grow(&self.device, &mut self.readback, 4 * layout.words);
        self.queue.write_buffer(&self.views, 0, bytemuck::cast_slice(&layout.views));
        self.run(&layout)?;
        {
            let bytes = self
                .readback
                .get_mapped_range(..4 * layout.words)
                .map_err(|error| self.give_up(error.to_string()))?;
            for (k, out) in outputs.iter_mut().enumerate() {
                layout.copy_out(k, &bytes, out);
            }
        }
        self.readback.unmap();
        self.check_alive()
    }
}

/// Replaces `buffer` by one of at least `bytes` if it is smaller; its contents are lost then.
fn grow(device: &wgpu::Device, buffer: &mut wgpu::Buffer, bytes: u64) {
    if buffer.size() < bytes {
        *buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: bytes,
            usage: buffer.usage(),
            mapped_at_creation: false,
        });
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_geometry::camera::Camera;
    use nalgebra::Vector3;

    #[test]
    fn a_lost_device_is_an_error_and_stays_one() {
        let Ok(found) = FoundAdapter::best() else {
            println!("skipped: this machine has no Vulkan device");
            return;
        };
        let mut gpu = GpuRectifier::open(found).unwrap();
        let camera = Camera::equirectangular(64, 32);
        let pixels = [70; 64 * 32];
        let sphere = SphereImage::new(&pixels, 64, camera).unwrap();
        let view = View::looking_at(&Vector3::x_axis(), 1.0, 33);
        let mut out = [0; 33 * 33];
        gpu.begin_frame(&sphere).unwrap();
        gpu.cut(&sphere, &[Cut::bilinear(view)], &mut [&mut out]).unwrap();
        assert_eq!(out, [70; 33 * 33]);
        gpu.device.destroy();
        let error = gpu.cut(&sphere, &[Cut::bilinear(view)], &mut [&mut out]).unwrap_err();
        assert!(error.is_lost(), "{error}");
        let error = gpu.begin_frame(&sphere).unwrap_err();
        assert!(
            error.is_lost() && error.to_string().contains("processor must take over"),
            "{error}"
        );
    }

    #[test]
    fn what_the_device_cannot_hold_is_refused() {
        let Ok(found) = FoundAdapter::best() else {
            println!("skipped: this machine has no Vulkan device");
            return;
        };
        let gpu = GpuRectifier::open(found).unwrap();
        let error = gpu.check_fits("bytes of a frame", gpu.max_bytes() + 1, gpu.max_bytes());
        assert!(matches!(error, Err(RectifyError::TooLarge { .. })), "{error:?}");
        gpu.check_fits("bytes of a frame", 3840 * 1920, gpu.max_bytes()).unwrap();
    }
}
