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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_config::Pipeline;
    use flockeye_geometry::camera::SpherePixel;
    use nalgebra::Vector3;

    const SIZE: [u32; 2] = [640, 320];

    fn core() -> Core {
        let size: Vec<String> = vec!["camera.width=640".into(), "camera.height=320".into()];
        let resolved = Resolved::of(Pipeline::parse("", &size, "x").unwrap()).unwrap();
        Core::new(&resolved, 3).unwrap()
    }

    /// What a camera that yaws shows of a world of waves, at a frame's time.
    fn picture(yaw: f64) -> Vec<u8> {
        let camera = Camera::equirectangular(SIZE[0], SIZE[1]);
        let world_from_camera = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        let light = |k: u32| {
            let pixel = SpherePixel::new(f64::from(k % SIZE[0]), f64::from(k / SIZE[0]));
            let ray = world_from_camera * *camera.ray(pixel).unwrap();
            let waves = (0..20).map(|k| {
                let of = |n: u32| f64::from((k * 7919 + n * 104_729) % 1000) / 500.0 - 1.0;
                let wave = Vector3::new(of(1), of(2), of(3)) * (3.0 + f64::from(k));
                (wave.dot(&ray) + 3.0 * of(4)).sin()
            });
            (128.0 + 12.0 * waves.sum::<f64>()).round().clamp(0.0, 255.0) as u8
        };
        (0..SIZE[0] * SIZE[1]).map(light).collect()
    }

    fn header(sequence: u64, epoch: u32) -> FrameHeader {
        let exposure_ns = sequence as i64 * 33_333_333;
        let stamp = FrameStamp { sequence, exposure_ns, epoch, ..FrameStamp::default() };
        FrameHeader {
            stamp,
            width: SIZE[0],
            height: SIZE[1],
            stride: SIZE[0],
            ..FrameHeader::default()
        }
    }

    fn is_known(rotation: &Rotation) -> bool {
        rotation.source != RotationSource::Nothing.code()
    }

    #[test]
    fn a_yaw_and_its_rate_are_found() {
        let mut core = core();
        let rate = 0.6;
        for sequence in 0..12 {
            let yaw = rate * sequence as f64 / 30.0;
            let found = core.on_frame(&header(sequence, 0), &picture(yaw)).unwrap();
            assert_eq!(is_known(&found), sequence > 0, "frame {sequence}");
            assert_eq!(found.generation, 3);
            if sequence > 5 {
                let off = Vector3::from(found.rate_in_camera) - Vector3::z() * rate;
                assert!(off.norm().to_degrees() < 1.0, "{off}");
                assert_eq!(found.earlier_exposure_ns, (sequence as i64 - 1) * 33_333_333);
            }
        }
    }

    #[test]
    fn black_frames_and_a_covered_camera_say_nothing_and_harm_nothing() {
        let mut core = core();
        let black = vec![16; (SIZE[0] * SIZE[1]) as usize];
        let mut known = |sequence: u64, pixels: &[u8]| {
            is_known(&core.on_frame(&header(sequence, 0), pixels).unwrap())
        };
        assert!(!known(0, &picture(0.0)));
        assert!(known(1, &picture(0.02)));
        // A white frame, two seconds of black ones, and fog.
        assert!(!known(2, &vec![255; black.len()]));
        (3..63).for_each(|sequence| assert!(!known(sequence, &black)));
        let fog: Vec<u8> = picture(0.1).iter().map(|value| 128 + value / 200).collect();
        assert!(!known(63, &fog));
        assert!(!known(64, &picture(0.5)), "there is nothing before it to compare with");
        assert!(known(65, &picture(0.52)));
    }

    #[test]
    fn frames_of_another_flight_or_too_far_apart_are_not_compared() {
        let mut core = core();
        let mut known = |sequence: u64, epoch: u32| {
            is_known(&core.on_frame(&header(sequence, epoch), &picture(0.0)).unwrap())
        };
        assert!(!known(0, 0));
        assert!(known(1, 0));
        assert!(!known(20, 0), "more than half a second");
        assert!(!known(0, 1), "the recording has begun anew");
        assert!(known(1, 1));
        assert!(!known(1, 1), "time does not go on");
    }

    #[test]
    fn a_frame_of_another_size_is_refused() {
        let mut core = core();
        let small = FrameHeader { stride: 320, ..header(0, 0) };
        assert!(core.on_frame(&small, &vec![0; 320 * 160]).is_err());
    }
}
