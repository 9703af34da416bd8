//! The opened device: its queue, its limits and its failure state.

use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use flockeye_runtime::lock::lock;
use wgpu::{BufferAsyncError, BufferUsages, Features, Limits, MapMode, SubmissionIndex};

use super::adapter::{FoundAdapter, Memory};
use super::shader::Shader;
use crate::rectifier::RectifyError;

/// Timeout of submitted work: after it the device counts as hung.
const TIMEOUT: Duration = Duration::from_secs(5);

/// An opened device with its shader.
#[derive(Debug)]
pub(super) struct Device {
    name: String,
    pub memory: Memory,
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub shader: Shader,
    /// Maximum size of a buffer of the shader, bytes.
    pub max_bytes: u64,
    /// First error message of the driver.
    failure: Arc<Mutex<Option<String>>>,
}

/// Receiver of the result of a buffer mapping.
pub(super) type Mapped = mpsc::Receiver<Result<(), BufferAsyncError>>;

impl Device {
    /// Opens the device and builds the shader, for `memory`, or for the device's best kind of
    /// memory.
    pub(super) fn open(found: &FoundAdapter, memory: Option<Memory>) -> Result<Self, RectifyError> {
        let name = found.name().to_owned();
        let refused = |reason: String| RectifyError::Device { adapter: name.clone(), reason };
        let memory = memory.unwrap_or_else(|| found.memory());
        let offered = found.adapter.limits();
        // Minimum limits of all devices, but this device's maximum buffer sizes.
        let required_limits = Limits {
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            max_buffer_size: offered.max_buffer_size,
            ..Limits::downlevel_defaults()
        };
        let required_features = match memory {
            Memory::Shared => Features::MAPPABLE_PRIMARY_BUFFERS,
            Memory::Apart => Features::empty(),
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("rectification"),
            required_features,
            required_limits,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(found.adapter.request_device(&descriptor))
            .map_err(|error| refused(error.to_string()))?;

        let failure = Arc::new(Mutex::new(None));
        let note = |failure: &Arc<Mutex<Option<String>>>, reason: String| {
            lock(failure).get_or_insert(reason);
        };
        let lost = Arc::clone(&failure);
        device.set_device_lost_callback(move |why, message| {
            note(&lost, format!("{why:?}: {message}"))
        });
        let uncaptured = Arc::clone(&failure);
        device.on_uncaptured_error(Arc::new(move |error| note(&uncaptured, error.to_string())));

        let shader = Shader::new(&device);
        let limits = device.limits();
        // Round down to whole words.
        let max_bytes = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) & !3;
        let opened = Self { name: name.clone(), memory, device, queue, shader, max_bytes, failure };
        match opened.failure() {
            None => Ok(opened),
            Some(reason) => Err(refused(reason)),
        }
    }

    fn failure(&self) -> Option<String> {
        lock(&self.failure).clone()
    }

    /// Fails if the device has failed.
    pub(super) fn check_alive(&self) -> Result<(), RectifyError> {
        self.failure().map_or(Ok(()), |reason| Err(self.lost(reason)))
    }

    /// Marks the device as lost, for `reason` if it is the first failure.
    pub(super) fn give_up(&self, reason: String) -> RectifyError {
        let mut failure = lock(&self.failure);
        self.lost(failure.get_or_insert(reason).clone())
    }

    fn lost(&self, reason: String) -> RectifyError {
        RectifyError::Lost { adapter: self.name.clone(), reason }
    }

    /// Checks a buffer size against the device's limit.
    pub(super) fn check_fits(&self, what: &'static str, needed: u64) -> Result<(), RectifyError> {
        let limit = self.max_bytes;
        if needed > limit {
            let adapter = self.name.clone();
            return Err(RectifyError::TooLarge { what, needed, limit, adapter });
        }
        Ok(())
    }

    pub(super) fn buffer(&self, bytes: u64, usage: BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: bytes,
            usage,
            mapped_at_creation: false,
        })
    }

    /// Replaces `buffer` if it is smaller than `bytes`, without its contents. Returns whether it
    /// was replaced.
    pub(super) fn grow(&self, buffer: &mut wgpu::Buffer, bytes: u64) -> bool {
        let is_smaller = buffer.size() < bytes;
        if is_smaller {
            *buffer = self.buffer(bytes, buffer.usage());
        }
        is_smaller
    }

    /// Requests a mapping of the first `bytes` of a buffer, after the device's work on it.
    pub(super) fn map(&self, buffer: &wgpu::Buffer, mode: MapMode, bytes: u64) -> Mapped {
        let (sender, mapped) = mpsc::channel();
        buffer.map_async(mode, ..bytes, move |result| {
            // The receiver may be dropped; the result is not needed then.
            let _ = sender.send(result);
        });
        mapped
    }

    /// Waits until a requested mapping is ready. `work`: last submission that uses the buffer.
    pub(super) fn wait(
        &self,
        mapped: &Mapped,
        work: Option<&SubmissionIndex>,
    ) -> Result<(), RectifyError> {
        let poll = match work {
            None => wgpu::PollType::Poll,
            Some(work) => wgpu::PollType::Wait {
                submission_index: Some(work.clone()),
                timeout: Some(TIMEOUT),
            },
        };
        self.device.poll(poll).map_err(|error| self.give_up(error.to_string()))?;
        self.check_alive()?;
        match mapped.try_recv() {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(self.give_up(error.to_string())),
            Err(_) => Err(self.give_up("memory that it shares could not be had".into())),
        }
    }
}
