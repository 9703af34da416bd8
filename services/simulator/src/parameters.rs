//! The parameters of a synthetic world.

use std::path::PathBuf;

use flockeye_config::{SimulatedStitch, SimulatedSun};
use flockeye_geometry::camera::Camera;

use crate::response::CameraCurve;
use crate::sun;

/// Parameters of a synthetic world: camera, light and flight of the bodies.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldParameters {
    /// Folder in which the painted hall is kept for later processes; `None`: it is not kept.
    pub paint_folder: Option<PathBuf>,
    /// Seed of all random numbers: the same seed gives the same bytes.
    pub seed: u64,
    /// The camera. Distances of the bodies are measured from the origin of its frame.
    pub camera: Camera,
    /// The curve between light and code values.
    pub response: CameraCurve,
    /// Frames in each second; the middle of frame k's exposure is at k / `frames_per_second`.
    pub frames_per_second: f64,
    /// Exposure time of each frame, seconds.
    pub exposure_s: f64,
    /// Overexposure, stops; negative: underexposure. Motion blur depends on `exposure_s` alone.
    pub exposure_stops: f64,
    /// Amplitude of a slow exposure variation, stops: as with an auto-exposure that follows the
    /// backdrop, not the bodies.
    pub exposure_swing_stops: f64,
    /// Sun on the bodies; `None`: the hall's lamps alone.
    pub sun: Option<SimulatedSun>,
    /// How the picture of an equirectangular camera is stitched; `None`: it has one centre, or two lenses
    /// whose halves fit at infinity.
    pub stitch: Option<SimulatedStitch>,
    /// Sensitivity: shot noise is proportional to its square root, read noise to itself. 0: no
    /// noise.
    pub iso: u32,
    /// Standard deviation of the read noise at ISO 100, as a share of full scale in linear light.
    pub read_noise: f64,
    /// Standard deviation of the photon noise at full scale, at ISO 100, as a share of full scale.
    pub shot_noise: f64,
    /// Standard deviation of the lens's Gaussian point spread, pixels of the image at each body.
    /// For an equirectangular image: pixels at the equator.
    pub lens_blur_px: f64,
    /// Yaw rate of the observer, to the left, degrees per second.
    pub observer_yaw_rate_deg_s: f64,
    /// Maximum lean of all drones in gusts, degrees. 0: calm air.
    pub tilt_deg: f64,
    /// Maximum change of the drones' yaw rate by gusts, degrees per second.
    pub yaw_swing_deg_s: f64,
    /// Time between the exposures of the first and the last row, seconds. 0: a global shutter.
    pub readout_s: f64,
    /// Minimum and maximum distance of the bodies' centres from the camera, metres. In a swarm:
    /// distance between neighbours on its ring.
    pub distance_m: [f64; 2],
    /// Greatest speed of any body, metres per second.
    pub speed_m_s: f64,
    /// Whether the bodies and the camera are on drones with an airframe that hides objects.
    pub airframes: bool,
    /// Samples per pixel of a body's drawing, along a line, before the lens blur. 2: fast enough
    /// for real time. 4: for studies of accuracy.
    pub samples_per_px: f64,
    /// Swarm whose drones all fly in this world; `None`: the bodies fly round the observer.
    pub swarm: Option<SwarmPlace>,
}

/// The observer's place in a swarm. All its drones fly in the same world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SwarmPlace {
    /// Number of the observer. The bodies are the other drones, in the order of their numbers.
    pub drone: u32,
    /// Number of drones, with the observer.
    pub drones: u32,
    /// Start of the world's time, CLOCK_MONOTONIC, nanoseconds: equal for all observers.
    pub start_ns: i64,
    /// Position of the camera on the observer, metres.
    pub observer_from_camera_m: [f64; 3],
}

/// Longest side of an image, pixels.
const MAX_SIDE: u32 = 16_384;

impl Default for WorldParameters {
    fn default() -> Self {
        Self {
            paint_folder: None,
            seed: 1,
            camera: Camera::equirectangular(3840, 1920),
            response: CameraCurve::default(),
            frames_per_second: 30.0,
            exposure_s: 0.00625,
            exposure_stops: 0.0,
            exposure_swing_stops: 0.0,
            sun: None,
            stitch: None,
            iso: 400,
            read_noise: 0.0004,
            shot_noise: 0.0078,
            lens_blur_px: 0.8,
            observer_yaw_rate_deg_s: 12.0,
            tilt_deg: 0.0,
            yaw_swing_deg_s: 0.0,
            readout_s: 0.0,
            distance_m: [0.6, 2.0],
            speed_m_s: 0.8,
            airframes: true,
            samples_per_px: 2.0,
            swarm: None,
        }
    }
}

/// Period of the exposure variation, seconds: long compared to a frame, short compared to a flight.
const EXPOSURE_SWING_S: f64 = 2.5;

impl WorldParameters {
    /// Exposure variation at a time, stops, in addition to [`Self::exposure_stops`].
    pub(crate) fn exposure_swing_at(&self, time_s: f64) -> f64 {
        self.exposure_swing_stops * (std::f64::consts::TAU * time_s / EXPOSURE_SWING_S).sin()
    }

    /// Texts of all errors in the values; empty for a valid world.
    pub(crate) fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut refuse = |(is_bad, why): (bool, String)| {
            if is_bad {
                problems.push(why);
            }
        };
        let outside = |name: &str, value: f64, low: f64, high: f64| {
            (!(low..=high).contains(&value), format!("{name} {value}: must be {low} to {high}"))
        };
        let Self { frames_per_second: rate, exposure_s, .. } = *self;
        let (width, height) = (self.camera.width(), self.camera.height());
        refuse((
            [width, height].iter().any(|side| !(2..=MAX_SIDE).contains(side)),
            format!("size {width}x{height}: both sides must be 2 to {MAX_SIDE} pixels"),
        ));
        refuse(outside("frames_per_second", rate, 0.1, 1000.0));
        refuse((
            !(exposure_s >= 0.0 && exposure_s * rate <= 1.0),
            format!(
                "exposure_s {exposure_s}: must be 0 to one frame's time, {} s at {rate} frames/s",
                1.0 / rate
            ),
        ));
        refuse(outside("exposure_stops", self.exposure_stops, -8.0, 8.0));
        refuse(outside("exposure_swing_stops", self.exposure_swing_stops, 0.0, 4.0));
        for (name, value) in [("read_noise", self.read_noise), ("shot_noise", self.shot_noise)] {
            let (is_outside, why) = outside(name, value, 0.0, 1.0);
            refuse((is_outside, format!("{why}, as a share of full scale")));
        }
        for problem in [self.sun.and_then(|sun| sun::problem(&sun)), self.response.problem()] {
            refuse((problem.is_some(), problem.unwrap_or_default()));
        }
        refuse((self.iso > 102_400, format!("iso {}: must be 0 to 102400", self.iso)));
        refuse(outside("lens_blur_px", self.lens_blur_px, 0.3, 5.0));
        refuse(outside("observer_yaw_rate_deg_s", self.observer_yaw_rate_deg_s, -360.0, 360.0));
        refuse(outside("tilt_deg", self.tilt_deg, 0.0, 45.0));
        refuse(outside("yaw_swing_deg_s", self.yaw_swing_deg_s, 0.0, 360.0));
        refuse((
            !(self.readout_s >= 0.0 && self.readout_s * rate <= 1.0),
            format!("readout_s {}: must be 0 to one frame's time", self.readout_s),
        ));
        let [near, far] = self.distance_m;
        refuse((
            !(near > 0.0 && near <= far && far <= 100.0),
            format!("distance_m [{near}, {far}]: nearest first, above 0, at most 100 m"),
        ));
        refuse(outside("speed_m_s", self.speed_m_s, 0.0, 20.0));
        if let Some(SwarmPlace { drone, drones, .. }) = self.swarm {
            refuse((
                drone >= drones,
                format!("drone {drone} of a swarm of {drones}: counted from 0"),
            ));
        }
        problems
    }

    /// Exposure of a frame, seconds since the middle of frame 0's exposure. Cameras of a swarm are
    /// not synchronized: each is later than the one before by a share of a frame.
    pub(crate) fn time_of(&self, frame: u64) -> f64 {
        let share =
            self.swarm.map_or(0.0, |swarm| f64::from(swarm.drone) / f64::from(swarm.drones));
        (frame as f64 + share) / self.frames_per_second
    }

    /// Whether the observer is level, has a constant yaw rate and a global shutter.
    pub(crate) fn is_calm(&self) -> bool {
        self.tilt_deg == 0.0 && self.yaw_swing_deg_s == 0.0 && self.readout_s == 0.0
    }

    /// Yaw rate of the observer, radians per second.
    pub(crate) fn observer_yaw_rate(&self) -> f64 {
        self.observer_yaw_rate_deg_s.to_radians()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    fn refused(change: impl FnOnce(&mut WorldParameters)) -> String {
        let mut parameters = WorldParameters::default();
        change(&mut parameters);
        parameters.problems().join("; ")
    }

    #[test]
    fn the_defaults_are_a_world() {
        assert_eq!(refused(|_| ()), "");
    }

    #[test]
    fn what_cannot_be_is_refused_with_its_reason() {
        assert!(refused(|p| p.frames_per_second = 0.0).contains("frames_per_second 0"));
        assert!(refused(|p| p.frames_per_second = f64::NAN).contains("frames_per_second NaN"));
        let tall = Camera::equirectangular(64, 20_000);
        assert!(refused(|p| p.camera = tall).contains("64x20000: both sides must be 2 to 16384"));
        assert!(refused(|p| p.response = CameraCurve::Table([0.0; 256])).contains("must rise"));
        assert!(refused(|p| p.exposure_s = 0.05).contains("must be 0 to one frame's time"));
        assert!(refused(|p| p.exposure_s = -0.001).contains("exposure_s -0.001"));
        assert!(refused(|p| p.read_noise = -0.1).contains("read_noise -0.1"));
        assert!(refused(|p| p.shot_noise = f64::NAN).contains("shot_noise NaN"));
        assert!(refused(|p| p.lens_blur_px = 0.0).contains("lens_blur_px 0"));
        assert!(refused(|p| p.distance_m = [2.0, 1.0]).contains("distance_m [2, 1]"));
        assert!(refused(|p| p.speed_m_s = -1.0).contains("speed_m_s -1"));
        let nobody =
            SwarmPlace { drone: 3, drones: 3, start_ns: 0, observer_from_camera_m: [0.0; 3] };
        assert!(refused(|p| p.swarm = Some(nobody)).contains("drone 3 of a swarm of 3"));
    }

    #[test]
    fn everything_wrong_is_named_at_once() {
        let all = refused(|p| {
            (p.iso, p.speed_m_s, p.camera) = (1_000_000, 99.0, Camera::equirectangular(1, 1));
        });
        assert!(["iso", "speed_m_s", "size"].iter().all(|name| all.contains(name)), "{all}");
    }
}
