//! Proposals: measures their time in each frame, and the rank of the bodies among them. Prints a
//! table for simulated gusts and for each recording. `make results PARTS=proposals` keeps the
//! tables.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "shared/frames.rs"]
mod frames;

use flockeye_config::{Pipeline, Resolved};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::statistics::{median, quantile};
use flockeye_imaging::proposals::{Detail, MarkerSizes, Proposal, Proposer};
use flockeye_imaging::sphere::SphereImage;
use flockeye_simulator::{World, settings};
use flockeye_tables::TruthRow;
use flockeye_tests::recordings;
use nalgebra::{Unit, Vector3};
use rustix::time::{ClockId, clock_gettime};

const WIDTH: u32 = 3840;

/// Ranks up to which bodies are counted. Later proposals are ignored.
const PLACES: [usize; 5] = [4, 8, 12, 16, 24];

/// The body of the recordings and of the simulator: side of its markers and its radius, metres.
const SIDE_M: f64 = 0.05;
const RADIUS_M: f64 = 0.0817;

/// The seeds of the simulated frames, which were not used to choose parameters, and the frames of
/// each.
const SEEDS: std::ops::Range<u64> = 4201..4211;
const FRAMES: [u64; 4] = [0, 17, 34, 51];

/// Recordings, and the interval of their used frames.
const RECORDINGS: [(&str, &str, u64); 3] =
    [("flight1", "flight1.mp4", 15), ("flight4", "flight4.mp4", 4), ("stills", "images", 1)];

fn main() {
    // `cargo test` runs each benchmark once, without this argument.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    for detail in [Detail::Quick, Detail::Thorough] {
        print(detail);
    }
}

/// Prints a table for each kind of picture, with this detail.
fn print(detail: Detail) {
    let table_of = || Table { detail, ..Table::default() };
    println!("{detail:?} look");
    let mut table = table_of();
    SEEDS.for_each(|seed| simulated(seed, |image, shown| table.add(image, shown)));
    table.print("simulated gusts");
    let Some(data) = recordings() else { return println!("proposals: no recordings") };
    for (name, pictures, every) in RECORDINGS {
        let folder = data.join(name);
        let truth: Vec<TruthRow> = flockeye_tables::read(&folder.join("truth.csv")).unwrap();
        let mut table = table_of();
        let camera = Camera::equirectangular(WIDTH, WIDTH / 2);
        frames::each_frame(&folder.join(pictures), camera, |number, image| {
            let of_frame = truth.iter().filter(|row| row.frame == number);
            let eligible = of_frame.filter(|row| row.localisable == 1 && row.n_markers_vis90 >= 2);
            let shown = eligible.map(|row| (row.position(), row.blur_px));
            if number % every == 0 {
                table.add(image, &shown.collect::<Vec<Shown>>());
            }
        });
        table.print(name);
    }
}

/// Position of a body in the camera frame, metres, and its blur, pixels.
type Shown = (Vector3<f64>, f64);

/// Frames of a simulated flight in gusts, with the bodies that they show.
fn simulated(seed: u64, mut each: impl FnMut(&SphereImage<'_>, &[Shown])) {
    let overrides = [
        "simulator.tilt_deg=15".to_owned(),
        "simulator.yaw_deg_s=30".to_owned(),
        "simulator.yaw_swing_deg_s=60".to_owned(),
        "simulator.exposure_ms=10".to_owned(),
        "simulator.distance_m=[0.8,2.6]".to_owned(),
        format!("simulator.seed={seed}"),
    ];
    let resolved = Resolved::of(Pipeline::parse("", &overrides, "a benchmark").unwrap()).unwrap();
    let bodies = settings::flying_bodies(&resolved).unwrap().unwrap();
    let dictionary = Dictionary::of(&bodies).unwrap();
    let parameters = settings::parameters(&resolved).unwrap();
    let mut world = World::new(parameters, &bodies, &dictionary).unwrap();
    let mut luma = vec![0; (WIDTH * WIDTH / 2) as usize];
    for frame in FRAMES {
        let truth = world.render(frame, &mut luma, WIDTH as usize).unwrap();
        let eligible =
            truth.bodies.iter().filter(|body| body.localisable && body.markers_visible_90 >= 2);
        let shown =
            eligible.map(|body| (body.camera_from_markers.translation.vector, body.blur_px));
        let camera = Camera::equirectangular(WIDTH, WIDTH / 2);
        let image = SphereImage::new(&luma, WIDTH as usize, camera).unwrap();
        each(&image, &shown.collect::<Vec<Shown>>());
    }
}

/// Processor time of this thread, which does not include other work of the machine.
fn processor_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// The rank of a body among proposals: the first one whose view shows the body's middle.
fn place_of(position: &Vector3<f64>, proposals: &[Proposal]) -> Option<usize> {
    let (direction, range_m) = Unit::new_and_get(*position);
    let radius_rad = (RADIUS_M / range_m).asin();
    proposals.iter().position(|proposal| {
        let side = proposal.side_rad * range_m / SIDE_M;
        proposal.direction_in_camera.angle(&direction) < radius_rad && (0.4..2.5).contains(&side)
    })
}

#[derive(Default)]
struct Table {
    detail: Detail,
    proposer: Proposer,
    /// Distance, blur, and rank among the proposals.
    places: Vec<(f64, f64, Option<usize>)>,
    times_ms: Vec<f64>,
    proposals: Vec<f64>,
}

impl Table {
    fn add(&mut self, image: &SphereImage<'_>, shown: &[Shown]) {
        let least_px = match self.detail {
            Detail::Quick => 11.0,
            Detail::Thorough => 0.65 * 11.0,
        };
        let sizes = MarkerSizes {
            least_rad: least_px / image.camera().pixels_per_radian(),
            most_rad: SIDE_M / 0.4,
            radius_in_sides: RADIUS_M / SIDE_M,
        };
        let begun_ms = processor_ms();
        let found = self.proposer.propose(image, &sizes, self.detail, usize::MAX);
        self.times_ms.push(processor_ms() - begun_ms);
        self.proposals.push(found.len() as f64);
        let places = shown.iter().map(|(at, blur_px)| (at.norm(), *blur_px, place_of(at, &found)));
        self.places.extend(places);
    }

    fn print(mut self, name: &str) {
        self.times_ms.sort_by(f64::total_cmp);
        self.proposals.sort_by(f64::total_cmp);
        println!(
            "{name}: {} frames, processor time median {:.2} ms, 95 % {:.2} ms; {:.0} proposals median, {:.0} most",
            self.times_ms.len(),
            median(&self.times_ms).unwrap(),
            quantile(&self.times_ms, 0.95).unwrap(),
            median(&self.proposals).unwrap(),
            self.proposals.last().unwrap(),
        );
        for (near_m, far_m) in [(0.0, 1.5), (1.5, 2.2), (2.2, 3.0), (3.0, 4.0)] {
            for (least_px, most_px) in [(0.0, 2.0), (2.0, 4.0), (4.0, 99.0)] {
                let is_inside = |(m, px, _): &&(f64, f64, Option<usize>)| {
                    (near_m..far_m).contains(m) && (least_px..most_px).contains(px)
                };
                let inside: Vec<_> = self.places.iter().filter(is_inside).collect();
                let within = PLACES.map(|most| {
                    let is_within = |place: Option<usize>| place.is_some_and(|place| place < most);
                    let found = inside.iter().filter(|(_, _, place)| is_within(*place)).count();
                    format!("{found} in {most}")
                });
                if !inside.is_empty() {
                    println!(
                        "  {near_m} to {far_m} m, {least_px} to {most_px} px of blur: of {} bodies {}",
                        inside.len(),
                        within.join(", ")
                    );
                }
            }
        }
    }
}
