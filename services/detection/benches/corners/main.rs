//! The time of finding a marker's corners, and their errors: ours and OpenCV's four refinements.
//! Ends with a table of both.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "../../../../common/imaging/tests/drawn/mod.rs"]
#[allow(dead_code, reason = "not all of it is needed here")]
mod drawn;
mod theirs;

use std::time::Instant;

use criterion::{Criterion, criterion_group};
use drawn::{CELLS, Dice, Scene, encode};
use flockeye_detection::{Detector, DetectorParameters};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Vector2, Vector3};

use self::theirs::Theirs;

const DICTIONARY: &str = "DICT_5X5_250";
/// Markers for each row of the table.
const MARKERS: usize = 150;
/// Standard deviation of the lens's blur, pixels. The box of a pixel adds to it.
const BLUR_PX: f64 = 0.9;
const NOISE: f64 = 0.01;

/// One marker of the dictionary, tilted by up to 60 degrees, as an image.
struct Picture {
    scene: Scene,
    pixels: Vec<u8>,
    id: u32,
}

impl Picture {
    fn new(dictionary: &Dictionary, side: f64, dice: &mut Dice) -> Self {
        let id = dice.uniform(0.0, dictionary.marker_count() as f64) as u32;
        let tilt = dice.uniform(0.0, 60f64.to_radians());
        let mut scene = Scene::new(dice, side, tilt, BLUR_PX);
        let print = dictionary.print(id).unwrap();
        for (row, cells) in (0..).zip(&mut scene.cells) {
            for (column, cell) in (0..).zip(cells) {
                *cell = print.is_white(row, column);
            }
        }
        assert_eq!(print.cells(), CELLS);
        let pixels = encode(&scene.render(), TransferCurve::Srgb, NOISE, dice);
        Self { scene, pixels, id }
    }

    fn image(&self) -> LumaImage<'_> {
        let size = self.scene.size;
        LumaImage::new(&self.pixels, size, size, size).unwrap()
    }
}

/// Our detector, with its defaults.
struct Ours {
    detector: Detector,
    light: LinearLight,
}

impl Ours {
    fn new() -> Self {
        let detector = Detector::new(DICTIONARY, DetectorParameters::default()).unwrap();
        Self { detector, light: LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap() }
    }

    fn corners(&mut self, picture: &Picture) -> Option<[ViewPixel; 4]> {
        let view = View::looking_at(&Vector3::x_axis(), 0.2, picture.scene.size as u32);
        let found = self.detector.detect(&picture.image(), &view, &self.light);
        let marker = found.iter().find(|marker| marker.id == picture.id && marker.is_refined);
        marker.map(|marker| marker.corners_in_view)
    }
}

fn one_marker(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("one marker of 30 px");
    let dictionary = Dictionary::load(DICTIONARY).unwrap();
    let picture = Picture::new(&dictionary, 30.0, &mut Dice(31));
    let mut ours = Ours::new();
    group.bench_function("ours", |b| b.iter(|| ours.corners(&picture)));
    for theirs in Theirs::all() {
        group.bench_function(theirs.name, |b| b.iter(|| theirs.corners(&picture)));
    }
}

/// Prints, for each size and each method, the mean radial error, the scatter, and the time.
fn table() {
    println!(
        "\nmarkers of {DICTIONARY} tilted by 0 to 60 degrees, blur {BLUR_PX} px, sRGB, noise {NOISE}; \
         {MARKERS} each; px of the view; time of the whole search in an image of one marker"
    );
    println!("| side | corners | radial bias | scatter | found and refined | time |");
    println!("| --- | --- | --- | --- | --- | --- |");
    let dictionary = Dictionary::load(DICTIONARY).unwrap();
    for side in [14.0, 20.0, 30.0, 60.0] {
        let mut dice = Dice(1000 + side as u64);
        let pictures: Vec<Picture> =
            (0..MARKERS).map(|_| Picture::new(&dictionary, side, &mut dice)).collect();
        let mut ours = Ours::new();
        row(side, "ours", &pictures, |picture| ours.corners(picture));
        for theirs in Theirs::all() {
            row(side, theirs.name, &pictures, |picture| theirs.corners(picture));
        }
    }
}

fn row(
    side: f64,
    name: &str,
    pictures: &[Picture],
    mut corners: impl FnMut(&Picture) -> Option<[ViewPixel; 4]>,
) {
    let (mut radial, mut squares, mut times) = (Vec::new(), 0.0, Vec::new());
    let mut found = 0;
    for picture in pictures {
        let before = Instant::now();
        let corners = corners(picture);
        times.push(before.elapsed().as_secs_f64() * 1e6);
        let Some(corners) = corners else { continue };
        found += 1;
        let truth = picture.scene.corners;
        let middle = truth.iter().map(|corner| corner.0).sum::<Vector2<f64>>() / 4.0;
        for (corner, truth) in corners.iter().zip(&truth) {
            let error = corner.0 - truth.0;
            radial.push(error.dot(&(truth.0 - middle).normalize()));
            squares += error.norm_squared() / 2.0;
        }
    }
    times.sort_by(f64::total_cmp);
    let count = radial.len().max(1) as f64;
    println!(
        "| {side} | {name} | {:+.3} | {:.3} | {:.0} % | {:.0} us |",
        radial.iter().sum::<f64>() / count,
        (squares / count).sqrt(),
        100.0 * f64::from(found) / pictures.len() as f64,
        times[times.len() / 2],
    );
}

criterion_group!(corners, one_marker);

fn main() {
    corners();
    Criterion::default().configure_from_args().final_summary();
    // Run as a test, the benchmark only shows that it works.
    if std::env::args().any(|argument| argument == "--bench") {
        table();
    }
}
