//! The parameters of a synthetic world.

use std::path::PathBuf;

use flockeye_config::SimulatedSun;
use flockeye_geometry::camera::Camera;

use crate::response::CameraCurve;
use crate::sun;

/// A synthetic world: its camera, its light and how its bodies fly.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldParameters {
    /// Where the painted hall is kept for later processes; `None`: nowhere.
    pub paint_folder: Option<PathBuf>,
    /// Everything random follows from it: the same seed gives the same bytes.
    pub seed: u64,
    /// The camera that sees it, in the frame whose origin the bodies' distances count from.
    pub camera: Camera,
    /// The curve between light and code values.
    pub response: CameraCurve,
    /// Frames in each second; the middle of frame k's exposure is at k / `frames_per_second`.
    pub frames_per_second: f64,
    /// How long each frame is exposed, seconds.
    pub exposure_s: f64,
    /// By how many stops pictures are brighter than they should be; darker if negative. Motion blur
    /// is that of `exposure_s` all the same.
    pub exposure_stops: f64,
    /// By how many stops pictures become brighter and darker in turn, as an auto-exposure makes
    /// them that follows the backdrop and knows nothing of the bodies.
    pub exposure_swing_stops: f64,
    /// Shines on the bodies; `None`: the hall's lamps alone.
    pub sun: Option<SimulatedSun>,
    /// Sensitivity: shot noise grows with its root, read noise with itself. 0 is a picture without
    /// noise.
    pub iso: u32,
    /// Standard deviation of the noise that is there without light, at ISO 100, as a share of full
    /// scale in linear light.
    pub read_noise: f64,
    /// Standard deviation of the photon noise at full scale, at ISO 100, as a share of full scale.
    pub shot_noise: f64,
    /// Standard deviation of the lens's Gaussian point spread, pixels of the image: as
    /// they are round each body, and on an equirectangular image as they are at the equator.
    pub lens_blur_px: f64,
    /// Rate at which the observer turns to its left, degrees per second.
    pub observer_yaw_rate_deg_s: f64,
    /// Farthest that gusts make drones lean, the observer and all others, degrees. 0: calm air.
    pub tilt_deg: f64,
    /// By how much gusts turn drones faster or slower than they would, degrees per second.
    pub yaw_swing_deg_s: f64,
    /// Time between the exposures of the first and the last row, seconds. 0: a global shutter.
    pub readout_s: f64,
    /// Nearest and farthest distance of the bodies' centres from the camera, metres. In a swarm: of
    /// drones that are side by side on its ring from each other.
    pub distance_m: [f64; 2],
    /// Greatest speed of any body, metres per second.
    pub speed_m_s: f64,
    /// Whether the bodies sit on drones, and the camera on one, that hide things.
    pub airframes: bool,
    /// Samples of a body's drawing for each pixel of the image, along a line, before the lens blurs
    /// it. 2 takes a fraction of a frame's time; 4 is for work on accuracy, not in real time.
    pub samples_per_px: f64,
    /// The observer's place in a swarm whose drones all fly in this world; `None`: the bodies fly
    /// round it.
    pub swarm: Option<SwarmPlace>,
}

/// Which drone of a swarm looks at the world that all of them fly in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SwarmPlace {
    /// The observer's number. The bodies are the other drones, in the order of their numbers.
    pub drone: u32,
    /// How many drones there are.
    pub drones: u32,
    /// When the world's time was 0, CLOCK_MONOTONIC, nanoseconds: one time for all who look at it.
    pub start_ns: i64,
    /// Where the camera sits on the observer, metres.
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

/// An auto-exposure swings once in this time, seconds: slowly beside a frame, and several times in
/// a flight.
const EXPOSURE_SWING_S: f64 = 2.5;

impl WorldParameters {
    /// Stops by which the auto-exposure makes a picture brighter at a time than
    /// [`Self::exposure_stops`].
    pub(crate) fn exposure_swing_at(&self, time_s: f64) -> f64 {
        self.exposure_swing_stops * (std::f64::consts::TAU * time_s / EXPOSURE_SWING_S).sin()
    }

    /// Everything that is wrong with the values, in words; empty for a world that can be made.
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

    /// When a frame is exposed, seconds since the middle of frame 0's exposure. Cameras of a swarm
    /// are not synchronized: each is a share of a frame later than the one before it.
    pub(crate) fn time_of(&self, frame: u64) -> f64 {
        let share =
            self.swarm.map_or(0.0, |swarm| f64::from(swarm.drone) / f64::from(swarm.drones));
        (frame as f64 + share) / self.frames_per_second
    }

    /// Whether the observer stays level and turns evenly, and all rows are exposed at once.
    pub(crate) fn is_calm(&self) -> bool {
        self.tilt_deg == 0.0 && self.yaw_swing_deg_s == 0.0 && self.readout_s == 0.0
    }

    /// Rate at which the observer turns, radians per second.
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
