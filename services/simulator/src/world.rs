//! The simulated world: built once, then rendered frame by frame.

use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::Bodies;
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

use crate::density::BodySight;
use crate::drawing::DroneDrawing;
use crate::drone::DroneShape;
use crate::drone_motion::{DroneMotion, STEP_S};
use crate::error::{RenderError, WorldError};
use crate::eyes::Eye;
use crate::gusts::Gusts;
use crate::moment::{Moment, Placement};
use crate::parameters::{SwarmPlace, WorldParameters};
use crate::picture::CameraPicture;
use crate::scene::FrameScene;
use crate::sensor::ImageSensor;
use crate::trajectory::{self, Trajectory};
use crate::truth::{self, FrameTruth};

/// Minimum distance at which a drone can be drawn, in radii of the drone.
const LEAST_DISTANCE: f64 = 1.2;

/// A synthetic world, seen by a spherical camera at its origin.
#[derive(Debug)]
pub struct World {
    parameters: WorldParameters,
    drones: Vec<DroneShape>,
    ways: Ways,
    /// Motion of the camera.
    pub(crate) motion: DroneMotion,
    sensor: ImageSensor,
    eyes: Vec<Eye>,
    picture: CameraPicture,
    /// Drawings of each body for each eye: kept between frames to reuse their memory.
    drawings: Vec<DroneDrawing>,
}

#[derive(Debug)]
enum Ways {
    /// Paths round the observer.
    Around {
        trajectories: Vec<Trajectory>,
        /// Gusts on each drone; empty in calm air.
        gusts: Vec<Gusts>,
    },
    /// Drones of the observer's swarm: motion of each, and pose of its markers on it.
    Swarm(Vec<(DroneMotion, Isometry3<f64>)>),
}

impl World {
    /// Builds the world: draws random paths and paints the panorama, which takes 1 to 2 s at
    /// 3840x1920.
    ///
    /// # Errors
    /// [`WorldError`]: parameters out of range, markers beyond the dictionary, bodies that are not
    /// convex or would collide.
    pub fn new(
        parameters: WorldParameters,
        bodies: &Bodies,
        dictionary: &Dictionary,
    ) -> Result<Self, WorldError> {
        if bodies.dictionary != dictionary.name() {
            return Err(WorldError::Dictionary {
                bodies: bodies.dictionary.clone(),
                given: dictionary.name().to_owned(),
            });
        }
        let drones = bodies
            .iter()
            .map(|body| DroneShape::new(body, dictionary, parameters.airframes))
            .collect::<Result<Vec<_>, _>>()?;
        let markers: Vec<_> = bodies.iter().map(|body| body.target_from_markers).collect();
        Self::with_drones(parameters, drones, &markers)
    }

    /// A world without bodies, in which nothing may be detected.
    pub fn empty(parameters: WorldParameters) -> Result<Self, WorldError> {
        Self::with_drones(parameters, Vec::new(), &[])
    }

    /// `drones_from_markers` are the poses of the bodies' markers on their drones.
    fn with_drones(
        parameters: WorldParameters,
        drones: Vec<DroneShape>,
        drones_from_markers: &[Isometry3<f64>],
    ) -> Result<Self, WorldError> {
        let mut problems = parameters.problems();
        if let Some(SwarmPlace { drones: all, .. }) = parameters.swarm
            && all as usize != drones.len() + 1
        {
            problems
                .push(format!("a swarm of {all} drones, and {} bodies of others", drones.len()));
        }
        if !problems.is_empty() {
            return Err(WorldError::Parameters(problems));
        }
        let eyes = Eye::all(&parameters.camera, parameters.stitch.as_ref());
        let near = parameters.distance_m[0];
        let [tilt, swing] = [parameters.tilt_deg, parameters.yaw_swing_deg_s].map(f64::to_radians);
        // Gusts displace both drones.
        let aside = eyes.iter().map(|eye| eye.position_m.norm()).fold(0.0, f64::max)
            + 2.0 * Gusts::reach_m(tilt);
        if let Some(drone) = drones.iter().find(|drone| near < least_distance(drone) + aside) {
            let least = least_distance(drone) + aside;
            return Err(WorldError::TooNear { body: drone.name.clone(), near, least });
        }
        let ways = match parameters.swarm {
            None => {
                let radii: Vec<f64> = drones.iter().map(|drone| drone.radius).collect();
                let trajectories = trajectory::draw(&parameters, &radii)?;
                // Number 0 is the observer.
                let gust = |drone| Gusts::draw(parameters.seed, drone, tilt, swing);
                let gusts = match parameters.is_calm() {
                    true => Vec::new(),
                    false => (1..=drones.len() as u64).map(gust).collect(),
                };
                Ways::Around { trajectories, gusts }
            }
            Some(swarm) => {
                let others = (0..swarm.drones).filter(|&drone| drone != swarm.drone);
                let drone = |(drone, &drone_from_markers)| {
                    (DroneMotion::of_drone(&parameters, drone), drone_from_markers)
                };
                Ways::Swarm(others.zip(drones_from_markers).map(drone).collect())
            }
        };
        let sensor = ImageSensor::new(&parameters);
        Ok(Self {
            motion: DroneMotion::of_observer(&parameters),
            picture: CameraPicture::new(&parameters, &eyes, &sensor),
            drawings: drones.iter().flat_map(|_| &eyes).map(|_| DroneDrawing::default()).collect(),
            parameters,
            drones,
            ways,
            sensor,
            eyes,
        })
    }

    /// Parameters of this world.
    pub fn parameters(&self) -> &WorldParameters {
        &self.parameters
    }

    /// Camera and bodies at a time, seconds since the middle of frame 0's exposure.
    pub fn moment(&self, time_s: f64) -> Moment {
        match &self.ways {
            Ways::Around { trajectories, .. } if self.parameters.is_calm() => {
                self.calm_moment(trajectories, time_s)
            }
            _ => self.moving_moment(time_s),
        }
    }

    fn calm_moment(&self, trajectories: &[Trajectory], time_s: f64) -> Moment {
        let camera = self.motion.attitude(time_s);
        let camera_from_world = camera.world_from_camera.inverse();
        let place = |way: &Trajectory| {
            let camera_from_markers = camera_from_world * way.world_from_markers(time_s);
            // In a rotating frame, points have an additional velocity in the opposite sense.
            let velocity_in_camera = camera_from_world * way.velocity(time_s)
                - camera.rate_in_camera.cross(&camera_from_markers.translation.vector);
            Placement { camera_from_markers, velocity_in_camera }
        };
        Moment { time_s, camera, placements: trajectories.iter().map(place).collect() }
    }

    /// The moment for an observer in gusts, in a swarm, or with a rolling shutter.
    fn moving_moment(&self, time_s: f64) -> Moment {
        let camera = self.motion.attitude(time_s);
        let height = f64::from(self.parameters.camera.height());
        let place = |target: usize| {
            let seen = |time_s: f64| self.camera_from_markers(target, time_s);
            // Rolling shutter: the body's rows are exposed before or after the middle row.
            let middle = Unit::new_normalize(seen(time_s).translation.vector);
            let share = self.parameters.camera.project(&middle).map_or(0.5, |at| at.0.y / height);
            let at_s = time_s + (share - 0.5) * self.parameters.readout_s;
            let [before, after] =
                [-STEP_S, STEP_S].map(|step| seen(at_s + step).translation.vector);
            Placement {
                camera_from_markers: seen(at_s),
                velocity_in_camera: (after - before) / (2.0 * STEP_S),
            }
        };
        Moment { time_s, camera, placements: (0..self.drones.len()).map(place).collect() }
    }

    /// The pose of a body's markers in the camera frame at a time.
    fn camera_from_markers(&self, target: usize, time_s: f64) -> Isometry3<f64> {
        let world_from_markers = match &self.ways {
            Ways::Around { trajectories, gusts } => {
                let steady = trajectories[target].world_from_markers(time_s);
                gusts.get(target).map_or(steady, |gusts| in_gusts(&steady, gusts, time_s))
            }
            Ways::Swarm(drones) => {
                let (motion, drone_from_markers) = &drones[target];
                motion.world_from_drone(time_s) * drone_from_markers
            }
        };
        self.motion.world_from_camera(time_s).inverse() * world_from_markers
    }

    /// Writes the luma plane of a frame (8 bit, the parameters' curve, full range) and returns its
    /// truth. Rows are `stride` bytes apart. Bytes between rows stay unchanged, and every pixel is
    /// written once.
    pub fn render(
        &mut self,
        frame: u64,
        luma: &mut [u8],
        stride: usize,
    ) -> Result<FrameTruth, RenderError> {
        let time_s = self.parameters.time_of(frame);
        let moment = self.moment(time_s);
        let mut truth = self.render_moment(frame, &moment, luma, stride)?;
        // The truth of a frame refers to the middle of its exposure, not to the exposure of a
        // body's rows.
        if self.parameters.readout_s > 0.0 {
            for body in &mut truth.bodies {
                body.camera_from_markers = self.camera_from_markers(body.target, time_s);
            }
        }
        Ok(truth)
    }

    /// Like [`World::render`], with camera and bodies as in `moment`. `frame` seeds the noise.
    pub fn render_moment(
        &mut self,
        frame: u64,
        moment: &Moment,
        luma: &mut [u8],
        stride: usize,
    ) -> Result<FrameTruth, RenderError> {
        self.check(moment, luma.len(), stride)?;
        let world_from_camera = Isometry3::from_parts(
            self.motion.world_from_camera(moment.time_s).translation,
            moment.camera.world_from_camera,
        );
        let sights = self.sights(moment);
        let bodies = self.drones.iter().zip(&sights);
        let mut layers = Vec::new();
        for (drawings, (drone, sights)) in self.drawings.chunks_mut(self.eyes.len()).zip(bodies) {
            for (eye, (drawing, sight)) in drawings.iter_mut().zip(sights).enumerate() {
                let Some(BodySight { placement, density }) = sight else { continue };
                let place = Translation3::from(self.eyes[eye].position_m);
                let world_from_eye = world_from_camera * place;
                drawing.draw(drone, placement, &world_from_eye, density, &self.parameters);
                layers.push((placement.position().norm(), (eye, &*drawing)));
            }
        }
        // Farthest first: nearer drawings cover it.
        layers.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let layers: Vec<(usize, &DroneDrawing)> =
            layers.into_iter().map(|(_, layer)| layer).collect();
        let scene = FrameScene { frame, camera: moment.camera, layers: &layers };
        self.sensor.adapt(self.parameters.exposure_swing_at(moment.time_s));
        self.picture.expose(scene, &self.sensor, luma, stride);
        Ok(FrameTruth {
            frame,
            time_s: moment.time_s,
            exposure_s: self.parameters.exposure_s,
            camera: moment.camera,
            bodies: truth::targets(&self.drones, moment, &sights, &self.eyes, &self.parameters),
        })
    }

    fn sights(&self, moment: &Moment) -> Vec<Vec<Option<BodySight>>> {
        let sight = |drone: &DroneShape, placement: &Placement, index: usize, eye: &Eye| {
            let placement = placement.seen_from(eye);
            let density =
                self.picture.density_at(index, &placement, drone.radius, &self.parameters)?;
            Some(BodySight { placement, density })
        };
        let pairs = self.drones.iter().zip(&moment.placements);
        pairs
            .map(|(drone, placement)| {
                let eyes = self.eyes.iter().enumerate();
                eyes.map(|(index, eye)| sight(drone, placement, index, eye)).collect()
            })
            .collect()
    }

    fn check(&self, moment: &Moment, given: usize, stride: usize) -> Result<(), RenderError> {
        let camera = &self.parameters.camera;
        let [width, height] = [camera.width(), camera.height()].map(|side| side as usize);
        if stride < width {
            return Err(RenderError::Stride { stride, width });
        }
        let needed = stride * (height - 1) + width;
        if given < needed {
            return Err(RenderError::Memory { needed, given });
        }
        let (placed, bodies) = (moment.placements.len(), self.drones.len());
        if placed != bodies {
            return Err(RenderError::Placements { placed, bodies });
        }
        for (drone, placement) in self.drones.iter().zip(&moment.placements) {
            let least = least_distance(drone);
            let distances = self.eyes.iter().map(|eye| placement.seen_from(eye).position().norm());
            let distance = distances.reduce(f64::min).unwrap_or(f64::NAN);
            if !(distance >= least && distance.is_finite()) {
                return Err(RenderError::TooNear { body: drone.name.clone(), distance, least });
            }
        }
        Ok(())
    }
}

/// The pose in the world with the effect of gusts.
fn in_gusts(steady: &Isometry3<f64>, gusts: &Gusts, time_s: f64) -> Isometry3<f64> {
    let sway = gusts.sway(time_s);
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), gusts.yaw(time_s));
    Isometry3::from_parts(
        (steady.translation.vector + sway.translation.vector).into(),
        sway.rotation * yaw * steady.rotation,
    )
}

fn least_distance(drone: &DroneShape) -> f64 {
    drone.radius * LEAST_DISTANCE
}
