//! The configuration as types. Their doc comments are the descriptions in the JSON Schema.

use flockeye_contract::{Projection, StageName};
use flockeye_geometry::filter::TrackPolicy;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

mod autopilot;
mod bodies;
mod camera;
mod costs;
mod gateway;
mod inertial;
mod mavlink;
mod metrics;
mod mount;
mod partition;
mod profile;
mod recording;
mod ros2;
mod search;
mod simulator;
mod source;
mod stages;

pub use autopilot::Autopilot;
pub use bodies::{BodySet, Preset, PresetBody};
pub use camera::{CameraSettings, FisheyeLens};
pub use costs::Costs;
pub use gateway::{Gateway, GatewayMode, Security};
pub use inertial::{Inertial, InertialSource};
pub use mavlink::MavlinkAddress;
pub use metrics::Metrics;
pub use mount::Mount;
pub use partition::{PartitionMethod, PartitionSettings};
pub use profile::{Flow, FrameLimit, Profile};
pub use recording::{RecordedFrames, Recording, RecordingTrigger};
pub use ros2::Ros2;
pub use search::SearchSettings;
pub use simulator::{SimulatedInertial, SimulatedStitch, SimulatedSun, SimulatedSwarm, Simulator};
pub use source::{AtEnd, Source};
pub use stages::{Restart, Scheduling, StageProcess, Stages, may_have_replicas, usual_nice};

/// A Flockeye pipeline.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Pipeline {
    /// Name of this pipeline on this machine: two run side by side under two names.
    pub instance: InstanceName,
    /// How it runs: flight, repeat, unlimited or stills.
    pub profile: Profile,
    /// This drone.
    pub observer: Observer,
    /// The spherical camera.
    pub camera: CameraSettings,
    /// What the neighbours carry.
    pub bodies: BodySet,
    /// Where frames come from.
    pub source: Source,
    /// The simulated world, for `source.input: sim`.
    pub simulator: Simulator,
    /// This drone's inertial sensor.
    pub inertial: Inertial,
    /// How the camera's own rotation is measured.
    pub egomotion: Egomotion,
    /// How the sphere is cut.
    pub partition: PartitionSettings,
    /// How views are cut from frames.
    pub rectification: Rectification,
    /// How markers are found in views.
    pub detection: Detection,
    /// How fusion searches.
    pub search: SearchSettings,
    /// How poses are solved and filtered.
    pub fusion: Fusion,
    /// What goes over the network.
    pub gateway: Gateway,
    /// How ROS 2 gets the neighbours' poses; left out: it does not.
    pub ros2: Option<Ros2>,
    /// How the drone's autopilot gets the neighbours' poses; left out: it does not.
    pub autopilot: Option<Autopilot>,
    /// What is recorded of every flight.
    pub recording: Recording,
    /// What is offered to Prometheus.
    pub metrics: Metrics,
    /// How the stages' processes are run.
    pub stages: Stages,
    /// How processes that fail are noticed.
    pub supervision: Supervision,
}

impl Pipeline {
    /// How many processes search views.
    pub fn detection_workers(&self) -> u32 {
        self.replicas(StageName::Detection)
    }

    /// How many processes run a stage, if it runs.
    pub fn replicas(&self, stage: StageName) -> u32 {
        let usual = if may_have_replicas(stage) { 2 } else { 1 };
        self.stages.of(stage).replicas.unwrap_or(usual)
    }

    /// How long a frame is exposed, seconds, if that is known.
    pub fn exposure_s(&self) -> Option<f64> {
        let exposure_ms = match self.source.stage() {
            StageName::Simulator => self.simulator.exposure_ms,
            _ => self.camera.exposure_ms,
        };
        (exposure_ms > 0.0).then_some(exposure_ms * 1e-3)
    }

    /// How far rays of the camera's model are off, in pixels of the picture's middle, one standard
    /// deviation.
    ///
    /// Where the setting is left out, a fisheye lens has 0.3. Published calibrations have residuals
    /// of 0.1 to 0.5 pixels. A stitched picture of lenses that nobody states has 0.15: its maker
    /// knows the lenses, but a stitcher bends pictures to make them fit.
    pub fn lens_error_px(&self) -> f64 {
        let is_simulated = self.source.stage() == StageName::Simulator;
        let usual = match self.camera.projection {
            Projection::DualFisheye if !is_simulated => 0.3,
            Projection::Equirectangular if self.learns_lenses() => 0.15,
            _ => 0.0,
        };
        self.camera.lens_error_px.unwrap_or(usual)
    }

    /// Whether the camera's response is learned, because nobody states it.
    pub fn learns_response(&self) -> bool {
        let is_as_stated =
            self.source.stage() == StageName::Simulator && self.simulator.stitch.is_none();
        !is_as_stated && self.camera.response.is_none()
    }

    /// Whether a stitched camera's lenses are learned: what nobody states, and how the halves of its
    /// pictures were joined. A distance of 0 states a camera with one centre.
    pub fn learns_lenses(&self) -> bool {
        let is_as_stated = self.source.stage() == StageName::Simulator
            && self.simulator.lens_distance_m.is_none()
            && self.simulator.stitch.is_none();
        let CameraSettings { projection, lens_distance_m, .. } = self.camera;
        projection == Projection::Equirectangular && !is_as_stated && lens_distance_m != Some(0.0)
    }

    /// Whether an inertial sensor is configured, wherever its samples come from.
    pub fn has_inertial_sensor(&self) -> bool {
        !matches!(self.inertial.parsed_source(), Ok(InertialSource::None) | Err(_))
    }

    /// Whether egomotion uses it.
    pub fn uses_inertial_sensor(&self) -> bool {
        self.inertial.used && self.has_inertial_sensor()
    }

    /// Whether pictures are taken to be coded as video: `fusion.coding`.
    pub fn is_coded_as_video(&self) -> bool {
        match self.fusion.coding {
            Coding::Images => false,
            Coding::Video => true,
            Coding::Auto => self.source.may_be_video(),
        }
    }
}

/// How processes that fail are noticed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Supervision {
    /// A process that works and sends no health for this long hangs: it is killed and started again,
    /// seconds; five times as long in a lossless run, and fifteen times for capture, inertial,
    /// autopilot, gateway and ros2, which open devices and links. Time in which it got no processor does not count.
    #[schemars(range(min = 0.5, max = 600.0))]
    pub heartbeat_s: f64,
    /// A process that is not ready after this long is named in the log, and the source starts without it,
    /// seconds.
    #[schemars(range(min = 0.1, max = 600.0))]
    pub start_s: f64,
}

impl Default for Supervision {
    fn default() -> Self {
        Self { heartbeat_s: 1.0, start_s: 10.0 }
    }
}

/// Name of a pipeline on a machine: letters, digits, `-` and `_`, at most 31.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
#[schemars(rename = "Instance")]
pub struct InstanceName(pub String);

impl Default for InstanceName {
    fn default() -> Self {
        Self("flockeye".into())
    }
}

/// This drone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Observer {
    /// Its name on the network.
    pub name: String,
    /// The swarm it flies in.
    pub swarm: String,
    /// Where the camera sits on the drone.
    pub observer_from_camera: Mount,
}

impl Default for Observer {
    fn default() -> Self {
        Self {
            name: "observer".into(),
            swarm: "swarm".into(),
            observer_from_camera: Mount::default(),
        }
    }
}

/// How the camera's own rotation is measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Egomotion {
    /// false: neighbours are tracked as if the camera did not turn.
    pub enabled: bool,
}

impl Default for Egomotion {
    fn default() -> Self {
        Self { enabled: true }
    }
}

/// How views are cut from frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Rectification {
    /// auto: the graphics processor if there is a real one, else the processor.
    pub backend: Backend,
    /// Threads of the processor back end.
    #[schemars(range(min = 1, max = 64))]
    pub threads: u32,
    /// Views in flight for each detection worker.
    #[schemars(range(min = 1, max = 16))]
    pub window: u32,
    /// If a worker does not answer for this long, its views go to another, milliseconds; ten times as long
    /// with `profile: stills`.
    #[schemars(range(min = 10.0, max = 60000.0))]
    pub overdue_ms: f64,
}

impl Default for Rectification {
    fn default() -> Self {
        Self { backend: Backend::Auto, threads: 1, window: 2, overdue_ms: 500.0 }
    }
}

/// What cuts views.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Backend {
    /// The graphics processor if there is a real one, else the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// The graphics processor, or Vulkan in software where there is none.
    Gpu,
}

/// How markers are found in views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Detection {
    /// Markers with shorter sides are not looked for, pixels of the view.
    #[schemars(range(min = 8.0, max = 200.0))]
    pub min_side_px: f64,
    /// Which detector searches the views.
    pub engine: DetectionEngine,
}

/// Which detector searches the views (docs/DETECTION.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum DetectionEngine {
    /// Ours.
    #[default]
    Own,
    /// OpenCV's, with its default parameters, to compare ours with.
    OpenCv,
}

impl Default for Detection {
    fn default() -> Self {
        Self { min_side_px: 11.0, engine: DetectionEngine::Own }
    }
}

/// How poses are solved and filtered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Fusion {
    /// How long a neighbour is predicted without a measurement, seconds.
    #[schemars(range(min = 0.0, max = 60.0))]
    pub coast_s: f64,
    /// How much neighbours manoeuvre: white-noise acceleration along each axis, m/s^2 per root Hz. After
    /// one second, a known velocity is uncertain by as many m/s.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub acceleration: f64,
    /// How long a frame is waited for when a stage has died, milliseconds; ten times as long
    /// with `profile: stills`.
    #[schemars(range(min = 10.0, max = 60000.0))]
    pub deadline_ms: f64,
    /// Whether bodies are aligned with the pixels of their views; if not, only corners are used.
    pub align: bool,
    /// How the source's pictures are coded. Video codecs shift copied blocks by a fraction of a pixel. Residuals do not
    /// show it, so covariances are larger.
    pub coding: Coding,
    /// Factor on the covariance of an aligned pose, for other errors that the pixels do not show: a lens or a body that
    /// differs from its description.
    #[schemars(range(min = 0.1, max = 1000.0))]
    pub covariance_scale: f64,
    /// Maximum tilt of a neighbour relative to its observer, degrees. It resolves the mirror ambiguity of a
    /// distant facet: the pose that is tilted by more is rejected. 0: no such limit.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub level_deg: f64,
    /// Threads on which the neighbours of a frame are aligned.
    #[schemars(range(min = 1, max = 64))]
    pub threads: u32,
}

impl Default for Fusion {
    fn default() -> Self {
        let policy = TrackPolicy::default();
        Self {
            coast_s: policy.coast_s,
            acceleration: policy.motion.acceleration,
            deadline_ms: 3000.0,
            align: true,
            coding: Coding::Auto,
            covariance_scale: 1.0,
            level_deg: 45.0,
            threads: 2,
        }
    }
}

/// How pictures are coded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Coding {
    /// As `images` from the simulator, an image or a folder of images, else as `video`.
    #[default]
    Auto,
    /// Each by itself: raw, or as a JPEG.
    Images,
    /// From the pictures before: H.264, H.265.
    Video,
}
