//! GPU back end: cuts the views of a frame together, while the next frame is uploaded.

mod adapter;
mod batch;
mod device;
mod layout;
mod shader;
mod slot;

use flockeye_contract::FrameOrder;
use flockeye_geometry::camera::Camera;
use flockeye_imaging::sphere::{Cut, SphereImage, check_outputs};

pub use self::adapter::FoundAdapter;
use self::device::Device;
use self::slot::FrameSlot;
use crate::rectifier::{Rectifier, RectifyError};

/// Frames on the device at once: the last (for repeated cuts), the one being cut, and the next.
const FRAMES: usize = 3;

/// Cuts views by a compute shader. A frame is uploaded once, and buffers are kept from frame to
/// frame.
#[derive(Debug)]
pub struct GpuRectifier {
    device: Device,
    description: String,
    slots: [FrameSlot; FRAMES],
    /// Counter of calls, for the order of use of the slots.
    now: u64,
}

impl GpuRectifier {
    /// Opens the device and builds the shader.
    pub fn open(found: FoundAdapter) -> Result<Self, RectifyError> {
        let device = Device::open(&found, None)?;
        Ok(Self::on(device, &found))
    }

    fn on(device: Device, found: &FoundAdapter) -> Self {
        Self {
            description: found.description(),
            slots: std::array::from_fn(|_| FrameSlot::new(&device)),
            device,
            now: 0,
        }
    }

    /// Checks that the device has room for the camera's frames.
    pub(crate) fn check_frame(&self, camera: &Camera) -> Result<(), RectifyError> {
        let bytes = u64::from(camera.width()) * u64::from(camera.height());
        self.device.check_fits(slot::FRAME, bytes)
    }

    /// The slot of a frame. Uploads the frame if it is in no slot.
    fn slot_of(
        &mut self,
        frame: FrameOrder,
        sphere: &SphereImage<'_>,
    ) -> Result<usize, RectifyError> {
        self.device.check_alive()?;
        let index = match self.slots.iter().position(|slot| slot.holds(frame, sphere)) {
            Some(index) => index,
            None => {
                let index = self.replaceable();
                self.slots[index].upload(&self.device, frame, sphere)?;
                index
            }
        };
        self.now += 1;
        self.slots[index].used = self.now;
        Ok(index)
    }

    /// The slot to reuse: one with a frame that was prepared but never cut, or else the least
    /// recently used.
    fn replaceable(&self) -> usize {
        let order = |slot: &FrameSlot| (!slot.is_untouched(), slot.used);
        (0..FRAMES).min_by_key(|&index| order(&self.slots[index])).unwrap_or(0)
    }
}

impl Rectifier for GpuRectifier {
    fn name(&self) -> String {
        format!("gpu: {}", self.description)
    }

    fn prepare(&mut self, frame: FrameOrder, sphere: &SphereImage<'_>) -> Result<(), RectifyError> {
        self.slot_of(frame, sphere).map(|_| ())
    }

    fn order(
        &mut self,
        frame: FrameOrder,
        sphere: &SphereImage<'_>,
        cuts: &[Cut],
    ) -> Result<(), RectifyError> {
        let slot = self.slot_of(frame, sphere)?;
        let sound = cuts.iter().copied().filter(|cut| cut.check().is_ok());
        self.slots[slot].order(&self.device, sphere, sound)
    }

    fn cut(
        &mut self,
        frame: FrameOrder,
        sphere: &SphereImage<'_>,
        cut: &Cut,
        out: &mut [u8],
    ) -> Result<(), RectifyError> {
        check_outputs(std::slice::from_ref(cut), &[&mut *out])?;
        let slot = self.slot_of(frame, sphere)?;
        let slot = &mut self.slots[slot];
        if slot.copy_out(&self.device, cut, out)? {
            return Ok(());
        }
        slot.order(&self.device, sphere, [*cut])?;
        slot.copy_out(&self.device, cut, out)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
