//! The core of egomotion, without port, clock or thread.

use flockeye_config::Resolved;
use flockeye_contract::{FrameHeader, FrameStamp, ImuHeader, ImuSample, Rotation, RotationSource};
use flockeye_convert::{rate_sample, rotation, rotation_message};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::ego_rotation::{CameraTurn, TurnAhead, Turned};
use flockeye_geometry::inertial::errors::Corrected;
use flockeye_imaging::gyroscope::Gyroscope;
use flockeye_imaging::gyroscope::grid::Sampler;
use flockeye_imaging::sphere::{SphereError, SphereImage};
use nalgebra::UnitQuaternion;

use crate::inertial::{SensorNotice, SensorWatch};
use crate::rate::RateFilter;

/// Longest time between compared frames, seconds. Beyond it, too little is visible in both.
const LONGEST_STEP_S: f64 = 0.3;

/// Time over which the inertial sensor's rate is averaged where the exposure is not known, seconds.
const RATE_WIDTH_S: f64 = 0.01;

/// Follows the camera's rotation from frame to frame.
pub(crate) struct Core {
    camera: Camera,
    gyroscope: Gyroscope,
    sampler: Sampler,
    /// The filter of the rate, while it is known.
    rate: Option<RateFilter>,
    /// `None` without an inertial sensor in the configuration.
    sensor: Option<SensorWatch>,
    /// Configuration of the inertial sensor.
    camera_from_sensor: UnitQuaternion<f64>,
    time_offset_s: f64,
    /// Generation and epoch of the inertial sensor's last samples.
    sensor_run: (u32, u32),
    exposure_s: f64,
    earlier: Option<FrameStamp>,
    generation: u32,
}

impl Core {
    /// Creates the core before the first frame. This process was replaced `generation` times.
    ///
    /// # Errors
    /// A mask that cannot be read.
    pub(crate) fn new(resolved: &Resolved, generation: u32) -> anyhow::Result<Self> {
        let sampler = Sampler::new(&resolved.camera, resolved.mask()?);
        let inertial = &resolved.pipeline.inertial;
        Ok(Self {
            camera: resolved.camera,
            gyroscope: Gyroscope::new(sampler.clone()),
            sampler,
            rate: None,
            sensor: resolved.pipeline.uses_inertial_sensor().then(SensorWatch::new),
            camera_from_sensor: rotation(inertial.camera_from_sensor),
            time_offset_s: inertial.time_offset_ms * 1e-3,
            sensor_run: (0, 0),
            exposure_s: resolved.pipeline.exposure_s().unwrap_or(RATE_WIDTH_S),
            earlier: None,
            generation,
        })
    }

    /// Handles samples of the inertial sensor.
    pub(crate) fn on_samples(&mut self, header: &ImuHeader, samples: &[ImuSample]) {
        let Some(sensor) = &mut self.sensor else { return };
        let run = (header.generation, header.epoch);
        if run != self.sensor_run {
            self.sensor_run = run;
            sensor.begin_epoch();
        }
        for sample in samples {
            let sample = rate_sample(sample, &self.camera_from_sensor, self.time_offset_s);
            sensor.push(sample);
        }
    }

    /// Returns the inertial sensor's notices since the last call.
    pub(crate) fn take_notices(&mut self) -> Vec<SensorNotice> {
        self.sensor.as_mut().map(SensorWatch::take_notices).unwrap_or_default()
    }

    /// Returns the rotation of the camera since the frame before.
    ///
    /// # Errors
    /// A frame whose size differs from the camera's.
    pub(crate) fn on_frame(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
    ) -> Result<Rotation, SphereError> {
        let frame = SphereImage::new(pixels, header.stride as usize, self.camera)?;
        let stamp = header.stamp;
        let earlier = self.earlier.replace(stamp).filter(|earlier| follows(&stamp, earlier));
        if earlier.is_none() {
            self.gyroscope = Gyroscope::new(self.sampler.clone());
            self.rate = None;
        }
        let times = earlier.map(|earlier| (earlier.exposure_s(), stamp.exposure_s()));
        let by_sensor = times
            .zip(self.sensor.as_mut())
            .and_then(|((from_s, to_s), sensor)| sensor.between(from_s, to_s));
        let expected = self.expected(times, by_sensor.as_ref());
        let by_picture = self.gyroscope.next(&frame, expected);
        let unknown = Rotation { stamp, generation: self.generation, ..Rotation::default() };
        let Some(earlier) = earlier else { return Ok(unknown) };
        let Some((turned, source)) = self.turned(&earlier, &stamp, by_picture, by_sensor) else {
            self.rate = None;
            return Ok(unknown);
        };
        let turn = self.turn(&earlier, &stamp, &turned);
        Ok(rotation_message(&earlier, &stamp, &turn, source, self.generation))
    }

    fn sensor_counts(&self) -> bool {
        self.sensor.as_ref().is_some_and(SensorWatch::counts)
    }

    /// Start of the search for the picture's rotation: from the sensor, or else from the rate.
    fn expected(
        &self,
        times: Option<(f64, f64)>,
        by_sensor: Option<&Corrected>,
    ) -> Option<UnitQuaternion<f64>> {
        if let Some(corrected) = by_sensor.filter(|_| self.sensor_counts()) {
            return Some(corrected.turned.later_from_earlier);
        }
        let (from_s, to_s) = times?;
        // The sphere rotates opposite to the camera.
        let expected = self.rate.as_ref()?.expected(to_s - from_s);
        Some(UnitQuaternion::from_scaled_axis(-expected))
    }

    /// The rotation between two frames from every available source.
    fn turned(
        &mut self,
        earlier: &FrameStamp,
        stamp: &FrameStamp,
        by_picture: Option<Turned>,
        by_sensor: Option<Corrected>,
    ) -> Option<(Turned, RotationSource)> {
        let step_s = stamp.exposure_s() - earlier.exposure_s();
        match (by_picture, by_sensor) {
            (Some(picture), Some(corrected)) => {
                let sensor = self.sensor.as_mut();
                let both =
                    sensor.and_then(|sensor| sensor.with_picture(&corrected, &picture, step_s));
                Some(match both {
                    Some(both) => (both, RotationSource::PictureAndInertial),
                    None => (picture, RotationSource::Picture),
                })
            }
            (Some(picture), None) => Some((picture, RotationSource::Picture)),
            (None, Some(corrected)) if self.sensor_counts() => {
                Some((corrected.turned, RotationSource::Inertial))
            }
            (None, _) => None,
        }
    }

    /// The rotation with the rate at the exposure, and the sensor's rotation beyond it.
    fn turn(&mut self, earlier: &FrameStamp, stamp: &FrameStamp, turned: &Turned) -> CameraTurn {
        let (earlier_s, later_s) = (earlier.exposure_s(), stamp.exposure_s());
        let vector = turned.later_from_earlier.inverse().scaled_axis();
        let step_s = later_s - earlier_s;
        let mut rate = RateFilter::updated(self.rate.take(), step_s, &vector, &turned.covariance);
        let sensor = self.sensor.as_ref();
        let by_sensor = sensor.and_then(|sensor| sensor.rate(later_s, self.exposure_s));
        if let Some((by_sensor, covariance)) = by_sensor {
            rate.observe(&by_sensor, &covariance);
        }
        let ahead = sensor.and_then(|sensor| {
            let (until_s, turned) = sensor.ahead(later_s)?;
            let (rate_in_camera, rate_covariance) = sensor.rate(until_s, 0.0)?;
            Some(TurnAhead {
                until_s,
                ahead_from_later: turned.later_from_earlier,
                covariance: turned.covariance,
                rate_in_camera,
                rate_covariance,
            })
        });
        let (rate_in_camera, rate_covariance) = rate.now();
        self.rate = Some(rate);
        CameraTurn {
            earlier_s,
            later_s,
            later_from_earlier: turned.later_from_earlier,
            covariance: turned.covariance,
            rate_in_camera,
            rate_covariance,
            ahead,
        }
    }
}

/// Whether a frame follows another of the same flight soon enough.
fn follows(stamp: &FrameStamp, earlier: &FrameStamp) -> bool {
    let is_same_flight =
        (stamp.source_generation, stamp.epoch) == (earlier.source_generation, earlier.epoch);
    let step_s = stamp.exposure_s() - earlier.exposure_s();
    is_same_flight && step_s > 0.0 && step_s <= LONGEST_STEP_S
}

#[cfg(test)]
mod tests;
