//! Choice of the graphics processor.

use wgpu::{DeviceType, Features};

use crate::rectifier::RectifyError;

/// Kind of memory for the shader's buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Memory {
    /// Host memory: CPU and GPU access it in place.
    Shared,
    /// Device memory: data is copied through staging buffers.
    Apart,
}

/// A Vulkan device before it is opened.
#[derive(Debug)]
pub struct FoundAdapter {
    pub(super) adapter: wgpu::Adapter,
    info: wgpu::AdapterInfo,
    /// Number of other devices.
    others: usize,
}

impl FoundAdapter {
    /// The best Vulkan device of this machine. Order: discrete, integrated, virtual and unknown
    /// graphics processors, then software.
    pub fn best() -> Result<Self, RectifyError> {
        let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        descriptor.backends = wgpu::Backends::VULKAN;
        let instance = wgpu::Instance::new(descriptor);
        let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN));
        let others = adapters.len().saturating_sub(1);
        let kinds: Vec<_> = adapters.iter().map(|a| a.get_info().device_type).collect();
        let adapter = best_of(&kinds).and_then(|best| adapters.into_iter().nth(best));
        let adapter = adapter.ok_or(RectifyError::NoAdapter)?;
        Ok(Self { info: adapter.get_info(), adapter, others })
    }

    /// Name of the device, from its driver.
    pub(crate) fn name(&self) -> &str {
        &self.info.name
    }

    /// Whether the device is a software implementation on the CPU.
    pub fn is_software(&self) -> bool {
        self.info.device_type == DeviceType::Cpu
    }

    /// Best kind of memory for the shader: host memory, if the device has none of its own.
    pub(super) fn memory(&self) -> Memory {
        let is_shared =
            matches!(self.info.device_type, DeviceType::IntegratedGpu | DeviceType::Cpu);
        if is_shared && self.adapter.features().contains(Features::MAPPABLE_PRIMARY_BUFFERS) {
            Memory::Shared
        } else {
            Memory::Apart
        }
    }

    /// Description of the device and the reason of the choice, for the log.
    pub fn description(&self) -> String {
        let kind = kind_name(self.info.device_type);
        let why = match self.others {
            0 => "the only Vulkan device".to_owned(),
            others => format!("best of {} Vulkan devices", others + 1),
        };
        format!("'{}' ({kind}, driver {}; {why})", self.info.name, self.info.driver)
    }
}

/// Index of the best kind of device, the first of equals.
fn best_of(kinds: &[DeviceType]) -> Option<usize> {
    (0..kinds.len()).min_by_key(|&k| match kinds[k] {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    })
}

fn kind_name(kind: DeviceType) -> &'static str {
    match kind {
        DeviceType::DiscreteGpu => "discrete graphics processor",
        DeviceType::IntegratedGpu => "integrated graphics processor",
        DeviceType::VirtualGpu => "virtual graphics processor",
        DeviceType::Other => "device of unknown kind",
        DeviceType::Cpu => "software on the processor",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn real_devices_come_before_software() {
        use DeviceType::*;
        assert_eq!(best_of(&[Cpu, IntegratedGpu, DiscreteGpu, VirtualGpu]), Some(2));
        assert_eq!(best_of(&[Cpu, VirtualGpu, IntegratedGpu, IntegratedGpu]), Some(2));
        assert_eq!(best_of(&[Cpu, Other]), Some(1));
        assert_eq!(best_of(&[Cpu]), Some(0));
        assert_eq!(best_of(&[]), None);
    }
}
