//! Measures the time of each part of the work on a frame on this machine, in the fields of `Costs`,
//! the virtual clock of lossless runs. `make results PARTS=costs` keeps its table.
//!
//! The simulated world shows one body at several distances. Each cost is the median over distances
//! and rounds, on one thread of an idle machine.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use std::time::Instant;

use flockeye_contract::FrameOrder;
use flockeye_detection::{Detector, DetectorParameters, MarkerInView};
use flockeye_dictionary::Dictionary;
use flockeye_fusion::{Aligner, Sought, Start, StartSource, TimeBudget};
use flockeye_geometry::body::{Bodies, Body, squares};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::partition::Partition;
use flockeye_geometry::pose::{CornerRay, PoseEstimate, PoseSolution, solve};
use flockeye_geometry::view::View;
use flockeye_imaging::align::Picture;
use flockeye_imaging::edges::CornerFit;
use flockeye_imaging::gyroscope::Gyroscope;
use flockeye_imaging::gyroscope::grid::Sampler;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_imaging::proposals::{Detail, MarkerSizes, Proposer};
use flockeye_imaging::sphere::{Cut, SphereImage};
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::rectifier::Rectifier as _;
use flockeye_simulator::{Attitude, Moment, Placement, World, WorldParameters};
use nalgebra::{Isometry3, Matrix6, Translation3, Unit, UnitQuaternion, Vector3};

const DICTIONARY: &str = "DICT_5X5_250";
const WIDTH: u32 = 3840;
const DISTANCES_M: [f64; 4] = [0.7, 1.0, 1.5, 2.0];

fn main() {
    // `cargo test` runs each benchmark once, without this argument.
    let rounds = if std::env::args().any(|argument| argument == "--bench") { 15 } else { 1 };
    let mut costs = Costs::default();
    for distance_m in DISTANCES_M {
        measure(distance_m, rounds, &mut costs);
    }
    println!("| cost | median ms | most ms |\n| --- | --- | --- |");
    for (name, times_ms) in costs.rows() {
        times_ms.sort_by(f64::total_cmp);
        let (median, most) = (times_ms[times_ms.len() / 2], times_ms[times_ms.len() - 1]);
        println!("| `{name}` | {median:.2} | {most:.2} |");
    }
}

/// Times in milliseconds.
#[derive(Default)]
struct Costs {
    source: Vec<f64>,
    egomotion: Vec<f64>,
    proposals: Vec<f64>,
    cut: Vec<f64>,
    window: Vec<f64>,
    direct_pass: Vec<f64>,
    corner_pass: Vec<f64>,
    initiation: Vec<f64>,
    background_pass: Vec<f64>,
}

impl Costs {
    fn rows(&mut self) -> [(&'static str, &mut Vec<f64>); 9] {
        [
            ("source_ms", &mut self.source),
            ("egomotion_ms", &mut self.egomotion),
            ("proposals_ms", &mut self.proposals),
            ("cut_ms_per_megapixel", &mut self.cut),
            ("window_ms_per_megapixel", &mut self.window),
            ("direct_pass_ms", &mut self.direct_pass),
            ("corner_pass_ms", &mut self.corner_pass),
            ("initiation_ms", &mut self.initiation),
            ("background_pass_ms", &mut self.background_pass),
        ]
    }
}

fn timed<T>(times_ms: &mut Vec<f64>, per: f64, work: impl FnOnce() -> T) -> T {
    let begun = Instant::now();
    let result = work();
    times_ms.push(begun.elapsed().as_secs_f64() * 1e3 / per);
    result
}

fn measure(distance_m: f64, rounds: u64, costs: &mut Costs) {
    let body = squares("alpha", 0.0625, 0.05, 0);
    let bodies = Bodies::new(DICTIONARY.into(), vec![body.clone()]).unwrap();
    let dictionary = Dictionary::of(&bodies).unwrap();
    let camera = Camera::equirectangular(WIDTH, WIDTH / 2);
    let mut world =
        World::new(WorldParameters { camera, ..WorldParameters::default() }, &bodies, &dictionary)
            .unwrap();
    let placement = Placement {
        camera_from_markers: Isometry3::from_parts(
            Translation3::from(Vector3::new(0.8, 0.5, 0.1).normalize() * distance_m),
            UnitQuaternion::from_euler_angles(0.05, -0.1, 0.9),
        ),
        velocity_in_camera: Vector3::new(-0.2, 0.3, 0.1),
    };
    let moment = Moment { time_s: 0.0, camera: Attitude::level(0.7), placements: vec![placement] };
    let mut luma = vec![0; (WIDTH * WIDTH / 2) as usize];
    let mut proposer = Proposer::default();
    let side_m = bodies.largest_side();
    let sizes = MarkerSizes {
        least_rad: 11.0 / camera.pixels_per_radian(),
        most_rad: side_m / 0.4,
        radius_in_sides: body.radius() / side_m,
    };
    let mut gyroscope = Gyroscope::new(Sampler::new(&camera, &Mask::nothing_hidden(camera)));
    for frame in 0..rounds {
        timed(&mut costs.source, 1.0, || {
            world.render_moment(frame, &moment, &mut luma, WIDTH as usize).unwrap();
        });
        let sphere = SphereImage::new(&luma, WIDTH as usize, camera).unwrap();
        timed(&mut costs.egomotion, 1.0, || gyroscope.next(&sphere, None));
        timed(&mut costs.proposals, 1.0, || proposer.propose(&sphere, &sizes, Detail::Quick, 24));
    }
    let sphere = SphereImage::new(&luma, WIDTH as usize, camera).unwrap();
    tiles(&sphere, camera, costs);
    region(&sphere, camera, &body, &bodies, &placement.camera_from_markers, rounds, costs);
}

/// Cuts all tiles, and searches each with one window.
fn tiles(sphere: &SphereImage<'_>, camera: Camera, costs: &mut Costs) {
    let parameters =
        DetectorParameters { corner_fit: CornerFit::Edges, ..DetectorParameters::default() };
    let windows = parameters.thresholds.clone();
    let mut detector = Detector::new(DICTIONARY, parameters).unwrap();
    let light = light();
    let views = Partition::icosahedron().views(0.1, camera.pixels_per_radian()).unwrap();
    let mut cpu = CpuRectifier::new(1);
    for (view, window) in views.iter().zip((0..windows.len()).cycle()) {
        let (pixels, megapixels) = cut(&mut cpu, sphere, *view, &mut costs.cut);
        let size = view.size_px as usize;
        let image = LumaImage::new(&pixels, size, size, size).unwrap();
        detector.set_thresholds([windows[window]].into_iter()).unwrap();
        timed(&mut costs.window, megapixels, || detector.detect(&image, view, &light));
    }
}

/// Measures the body in its region of interest by each pass.
fn region(
    sphere: &SphereImage<'_>,
    camera: Camera,
    body: &Body,
    bodies: &Bodies,
    truth: &Isometry3<f64>,
    rounds: u64,
    costs: &mut Costs,
) {
    let dictionary = Dictionary::of(bodies).unwrap();
    let direction = Unit::new_normalize(truth.translation.vector);
    let distance_m = truth.translation.vector.norm();
    // The region has the size of a tracked body's: magnified until a marker of 5 cm has 80 px, at
    // most three times.
    let focal_px = (80.0 * distance_m / 0.05).min(3.0 * camera.pixels_per_radian());
    let field_rad = 0.4 / distance_m;
    let size_px = (2.0 * focal_px * (field_rad / 2.0).tan()).ceil() as u32;
    let view = View::looking_at(&direction, field_rad, size_px);
    let (pixels, _) = cut(&mut CpuRectifier::new(1), sphere, view, &mut Vec::new());
    let size = view.size_px as usize;
    let image = LumaImage::new(&pixels, size, size, size).unwrap();
    let light = light();
    let picture = Picture::still(image, view, &light, camera.pixels_per_radian());
    let aligner =
        Aligner::new(bodies, |id| dictionary.print(id), camera.pixels_per_radian()).unwrap();
    let mut detector = Detector::new(DICTIONARY, DetectorParameters::default()).unwrap();
    let found = detector.detect(&picture.image, &view, &light);
    let rays: Vec<CornerRay> = found.iter().flat_map(rays_of).collect();
    let predicted = Isometry3::from_parts(
        Translation3::from(truth.translation.vector * 1.003),
        UnitQuaternion::from_euler_angles(0.005, 0.004, -0.006) * truth.rotation,
    );
    let unknown = |_: &Isometry3<f64>| false;
    for _ in 0..rounds {
        timed(&mut costs.direct_pass, 1.0, || aligner.align(0, &picture, &Start::Fine(predicted)));
        let from_corners = || -> Vec<(StartSource, Start)> {
            let solutions = solve(body, &rays).unwrap_or_default();
            let start = |found: &PoseSolution| Start::Fine(found.camera_from_markers);
            solutions.iter().take(3).map(|found| (StartSource::Corners, start(found))).collect()
        };
        let (picture, budget) = (&picture, TimeBudget::OneFrame);
        let prior =
            PoseEstimate { camera_from_markers: predicted, covariance: Matrix6::identity() * 1e-4 };
        timed(&mut costs.corner_pass, 1.0, || {
            let sought = Sought { target: 0, picture, starts: &from_corners(), budget };
            aligner.confirm(&sought, &prior, unknown, &mut Vec::new())
        });
        timed(&mut costs.initiation, 1.0, || {
            let sought = Sought { target: 0, picture, starts: &from_corners(), budget };
            aligner.initiate(&sought, unknown, &mut Vec::new())
        });
        // With a confirmed track. Without one it has the starts of an initiation, too.
        timed(&mut costs.background_pass, 1.0, || {
            let starts = [(StartSource::RoughPrediction, Start::Rough(predicted))];
            let sought = Sought { target: 0, picture, starts: &starts, budget };
            aligner.confirm(&sought, &prior, unknown, &mut Vec::new())
        });
    }
}

fn rays_of(found: &MarkerInView) -> impl Iterator<Item = CornerRay> {
    (0..4).map(|corner| CornerRay {
        marker_id: found.id,
        corner,
        ray_in_camera: found.rays_in_camera[corner],
        deviation_rad: found.deviations_rad[corner],
    })
}

fn light() -> LinearLight {
    LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap()
}

/// Cuts a view, and returns its number of pixels in millions.
fn cut(
    cpu: &mut CpuRectifier,
    sphere: &SphereImage<'_>,
    view: View,
    times_ms: &mut Vec<f64>,
) -> (Vec<u8>, f64) {
    let mut out = vec![0; (view.size_px as usize).pow(2)];
    let megapixels = out.len() as f64 * 1e-6;
    let key = FrameOrder::default();
    timed(times_ms, megapixels, || cpu.cut(key, sphere, &Cut::bilinear(view), &mut out)).unwrap();
    (out, megapixels)
}
