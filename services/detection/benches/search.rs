//! The time of searching views that are full of texture and hold no marker: ours and OpenCV's,
//! measured alternately.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "../tests/shared/mod.rs"]
mod shared;

use std::time::Instant;

use criterion::{Criterion, criterion_group};
use flockeye_detection::candidates::Finder;
use flockeye_detection::{DarkerBy, Detector, DetectorParameters, Threshold};
use flockeye_geometry::view::View;
use flockeye_imaging::edges::CornerFit;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use opencv::aruco::{self, PREDEFINED_DICTIONARY_NAME};
use opencv::core::{Mat, Point, Vector};
use opencv::imgproc::{
    ADAPTIVE_THRESH_MEAN_C, CHAIN_APPROX_NONE, RETR_LIST, THRESH_BINARY_INV, adaptive_threshold,
    approx_poly_dp, find_contours,
};
use opencv::prelude::*;
use shared::{Picture, data, partitions};

const DICTIONARY: &str = "DICT_5X5_250";
/// The shortest outline of a marker with sides of 11 px, as in our search.
const SHORTEST: usize = 26;
/// How often each way is measured for the table.
const ROUNDS: usize = 15;

/// The stage's parameters for a tile in flight, where fusion aligns whole bodies: its windows are
/// those that OpenCV's function has too.
fn parameters() -> DetectorParameters {
    let mut parameters =
        DetectorParameters { corner_fit: CornerFit::Edges, ..DetectorParameters::default() };
    parameters.thresholds.retain(|threshold| matches!(threshold.darker_by, DarkerBy::Codes(_)));
    parameters
}

/// Squares, as OpenCV's functions find them with the same windows.
fn their_squares(image: &Mat) -> usize {
    let mut squares = 0;
    for Threshold { window_px, darker_by } in parameters().thresholds {
        let DarkerBy::Codes(codes) = darker_by else { continue };
        let (mut dark, method) = (Mat::default(), ADAPTIVE_THRESH_MEAN_C);
        adaptive_threshold(
            image,
            &mut dark,
            255.0,
            method,
            THRESH_BINARY_INV,
            window_px as i32,
            codes.into(),
        )
        .unwrap();
        let mut outlines = Vector::<Vector<Point>>::new();
        find_contours(&dark, &mut outlines, RETR_LIST, CHAIN_APPROX_NONE, Point::new(0, 0))
            .unwrap();
        let mut polygon = Vector::<Point>::new();
        // This copies each outline, as any user of the binding must.
        for outline in outlines.iter().filter(|outline| outline.len() >= SHORTEST) {
            approx_poly_dp(&outline, &mut polygon, 0.05 * outline.len() as f64, true).unwrap();
            squares += usize::from(polygon.len() == 4);
        }
    }
    squares
}

fn their_markers(image: &Mat) -> usize {
    let dictionary =
        aruco::get_predefined_dictionary(PREDEFINED_DICTIONARY_NAME::DICT_5X5_250).unwrap();
    let (mut corners, mut ids) = (Vector::<Mat>::new(), Vector::<i32>::new());
    let parameters = aruco::DetectorParameters::create().unwrap();
    let mut rejected = Vector::<Mat>::new();
    aruco::detect_markers(image, &dictionary, &mut corners, &mut ids, &parameters, &mut rejected)
        .unwrap();
    ids.len()
}

/// A view and its image, also as OpenCV's matrix.
struct Scene {
    view: View,
    picture: Picture,
    mat: Mat,
}

/// Views of a real panorama if the recordings are there, else of random blocks.
fn scenes() -> (Vec<Scene>, &'static str) {
    let focal = 3840.0 / std::f64::consts::TAU;
    let panorama = data().map(|data| data.join("real/panorama/examplepano.jpg"));
    let sphere = panorama.filter(|path| path.is_file()).map(|path| Picture::read(&path));
    let name = if sphere.is_some() { "real/panorama" } else { "random blocks" };
    let cut = |view: View| {
        let size = view.size_px as usize;
        let block = |at: usize| {
            let dice = (at % size / 24) * 7919 + (at / size / 24) * 104_729;
            (dice * dice % 251) as u8
        };
        let picture = sphere.as_ref().map_or_else(
            || Picture { pixels: (0..size * size).map(block).collect(), width: size, height: size },
            |sphere| sphere.cut(&view),
        );
        let mat = Mat::new_rows_cols_with_data(size as i32, size as i32, &picture.pixels);
        let mat = mat.unwrap().try_clone().unwrap();
        Scene { view, picture, mat }
    };
    (partitions(focal).into_iter().map(cut).collect(), name)
}

fn search(criterion: &mut Criterion) {
    opencv::core::set_num_threads(1).unwrap();
    let (scenes, name) = scenes();
    let scene = &scenes[0];
    let mut detector = Detector::new(DICTIONARY, parameters()).unwrap();
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let mut group = criterion.benchmark_group(format!("a tile of {name}"));
    group.bench_function("ours", |b| {
        b.iter(|| detector.detect(&scene.picture.image(), &scene.view, &light));
    });
    group.bench_function("OpenCV", |b| b.iter(|| their_markers(&scene.mat)));
}

/// Prints the time of all twelve tiles, the median of several rounds.
fn table() {
    let (scenes, name) = scenes();
    let (mut finder, parameters) = (Finder::default(), parameters());
    let mut detector = Detector::new(DICTIONARY, parameters.clone()).unwrap();
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let mut times = [const { Vec::<f64>::new() }; 4];
    for _ in 0..ROUNDS {
        let mut ways: [&mut dyn FnMut(&Scene) -> usize; 4] = [
            &mut |scene| finder.find(&scene.picture.image(), &parameters).whole.len(),
            &mut |scene| their_squares(&scene.mat),
            &mut |scene| detector.detect(&scene.picture.image(), &scene.view, &light).len(),
            &mut |scene| their_markers(&scene.mat),
        ];
        for (times, way) in times.iter_mut().zip(&mut ways) {
            let before = Instant::now();
            for scene in &scenes {
                std::hint::black_box(way(scene));
            }
            times.push(before.elapsed().as_secs_f64() * 1e3);
        }
    }
    let [our_squares, their_squares, ours, theirs] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    });
    let size = scenes[0].view.size_px;
    println!("\ntwelve tiles of {size} px of {name}, one thread, ms");
    println!("| | ours | OpenCV | ratio |\n| --- | --- | --- | --- |");
    for (what, ours, theirs) in [
        ("squares, two windows each", our_squares, their_squares),
        ("markers (OpenCV: its three windows)", ours, theirs),
    ] {
        println!("| {what} | {ours:.0} | {theirs:.0} | {:.2} |", theirs / ours);
    }
}

criterion_group!(search_group, search);

fn main() {
    search_group();
    Criterion::default().configure_from_args().final_summary();
    // Run as a test, the benchmark only shows that it works.
    if std::env::args().any(|argument| argument == "--bench") {
        table();
    }
}
