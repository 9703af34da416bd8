//! What egomotion does with frames: no port, no clock, no thread.

use flockeye_config::Resolved;
use flockeye_contract::{FrameHeader, FrameStamp, Rotation, RotationSource};
use flockeye_convert::rotation_message;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::ego_rotation::CameraTurn;
use flockeye_imaging::gyroscope::Gyroscope;
use flockeye_imaging::gyroscope::grid::Sampler;
use flockeye_imaging::sphere::{SphereError, SphereImage};
use nalgebra::UnitQuaternion;

use crate::rate::RateFilter;

/// Frames that lie farther apart are not compared, seconds: too little of what both show is the same.
const LONGEST_STEP_S: f64 = 0.3;

/// Follows the camera's rotation from frame to frame.
pub struct Core {
    camera: Camera,
    gyroscope: Gyroscope,
    sampler: Sampler,
    rate: RateFilter,
    /// The frame before.
    earlier: Option<FrameStamp>,
    generation: u32,
}

impl Core {
    /// No frame has come. This process was replaced `generation` times.
    ///
    /// # Errors
    /// A mask that cannot be read.
    pub fn new(resolved: &Resolved, generation: u32) -> anyhow::Result<Self> {
        let sampler = Sampler::new(&resolved.camera, resolved.mask()?);
        Ok(Self {
            camera: resolved.camera,
            gyroscope: Gyroscope::new(sampler.clone()),
            sampler,
            rate: RateFilter::new(),
            earlier: None,
            generation,
        })
    }

    /// How the camera has turned since the frame before.
    ///
    /// # Errors
    /// A frame of another size than the camera's.
    pub fn on_frame(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
    ) -> Result<Rotation, SphereError> {
        let frame = SphereImage::new(pixels, header.stride as usize, self.camera)?;
        let stamp = header.stamp;
        let earlier = self.earlier.replace(stamp).filter(|earlier| follows(&stamp, earlier));
        if earlier.is_none() {
            self.gyroscope = Gyroscope::new(self.sampler.clone());
            self.rate.forget();
        }
        let step_s = earlier.map_or(0.0, |earlier| stamp.exposure_s() - earlier.exposure_s());
        // The sphere turns the other way than the camera.
        let expected = self.rate.expected(step_s);
        let expected = expected.map(|turned| UnitQuaternion::from_scaled_axis(-turned));
        let found = self.gyroscope.next(&frame, expected);
        let (Some(earlier), Some(found)) = (earlier, found) else {
            self.rate.forget();
            return Ok(Rotation { stamp, generation: self.generation, ..Rotation::default() });
        };
        let turned = found.later_from_earlier.inverse().scaled_axis();
        let (rate_in_camera, rate_covariance) =
            self.rate.update(step_s, &turned, &found.covariance);
        let turn = CameraTurn {
            earlier_s: earlier.exposure_s(),
            later_s: stamp.exposure_s(),
            later_from_earlier: found.later_from_earlier,
            covariance: found.covariance,
            rate_in_camera,
            rate_covariance,
        };
        let source = RotationSource::Picture;
        Ok(rotation_message(&earlier, &stamp, &turn, source, self.generation))
    }
}

/// Whether a frame comes after another of the same flight, and soon enough.
fn follows(stamp: &FrameStamp, earlier: &FrameStamp) -> bool {
    let is_same_flight =
        (stamp.source_generation, stamp.epoch) == (earlier.source_generation, earlier.epoch);
    let step_s = stamp.exposure_s() - earlier.exposure_s();
    is_same_flight && step_s > 0.0 && step_s <= LONGEST_STEP_S
}
