//! Still images with ground truth: which markers are found, and the errors of their corners.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod shared;

use std::collections::BTreeMap;
use std::f64::consts::PI;

use flockeye_detection::{Detector, DetectorParameters};
use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Equirectangular, SpherePixel};
use flockeye_geometry::view::View;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Unit, Vector2, Vector3};
use serde::Deserialize;
use shared::{Picture, data, partitions};

#[derive(Deserialize)]
struct Truth {
    frame: u32,
    body: String,
    x: f64,
    y: f64,
    z: f64,
    dist_m: f64,
    n_markers_vis90: u32,
}

#[derive(Deserialize)]
struct Corners {
    frame: u32,
    body: String,
    markers: Vec<Marker>,
}

#[derive(Deserialize)]
struct Marker {
    id: u32,
    vis: f64,
    incidence_deg: f64,
    corners: [[f64; 2]; 4],
}

fn srgb() -> LinearLight {
    LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap()
}

/// Counts of visible and of found markers by their side in the view, and the errors of corners.
#[derive(Default)]
struct Tally {
    there: BTreeMap<u32, (u32, u32)>,
    /// Radial error of each corner, outwards, in pixels of the view; error over deviation, squared.
    radial: Vec<f64>,
    squared: Vec<f64>,
    errors: Vec<f64>,
    unrefined: u32,
    wrong: Vec<String>,
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn stills_near_the_observer() {
    let Some(data) = data() else { return };
    let folder = data.join("stills");
    let mut truth = csv::Reader::from_path(folder.join("truth.csv")).unwrap();
    let truth: Vec<Truth> = truth.deserialize().map(Result::unwrap).collect();
    let corners: Vec<Corners> = std::fs::read_to_string(folder.join("truth_corners.jsonl"))
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let mut detector = Detector::new("DICT_5X5_250", DetectorParameters::default()).unwrap();
    detector.set_magnification(2.0);
    let light = srgb();
    let mut tally = Tally::default();
    let mut pictures: BTreeMap<u32, Picture> = BTreeMap::new();
    for body in truth.iter().filter(|body| body.dist_m < 1.5 && body.n_markers_vis90 >= 2) {
        let picture = pictures.entry(body.frame).or_insert_with(|| {
            Picture::read(&folder.join(format!("images/{:03}.jpg", body.frame)))
        });
        let camera = Equirectangular { width: 3840, height: 1920 };
        let direction = Unit::new_normalize(Vector3::new(body.x, body.y, body.z));
        // All of the body, magnified twice.
        let focal = 2.0 * camera.pixels_per_radian();
        let size = (2.0 * focal * 0.12 / body.dist_m).ceil() as u32 + 20;
        let field = 2.0 * (f64::from(size) / (2.0 * focal)).atan();
        let view = View::looking_at(&direction, field, size);
        let cut = picture.cut(&view);
        let found = detector.detect(&cut.image(), &view, &light);
        let seen: Vec<&Marker> = corners
            .iter()
            .filter(|line| line.frame == body.frame)
            .flat_map(|line| &line.markers)
            .collect();
        for marker in &found {
            let of_truth = seen.iter().find(|truth| truth.id == marker.id);
            let Some(truth) = of_truth.filter(|truth| truth.vis > 0.05) else {
                tally.wrong.push(format!("frame {}: {marker:?}", body.frame));
                continue;
            };
            let rays = truth.corners.map(|[u, v]| camera.ray(SpherePixel::new(u, v)));
            compare(&mut tally, &view, marker, &rays, body.frame);
        }
        for line in corners.iter().filter(|l| l.frame == body.frame && l.body == body.body) {
            // Steeper ones show hardly any cells (and a body's edge may be one of theirs).
            for marker in line.markers.iter().filter(|m| m.vis >= 0.9 && m.incidence_deg < 65.0) {
                let pixels = marker.corners.map(|[u, v]| {
                    view.project(&camera.ray(SpherePixel::new(u, v))).map(|pixel| pixel.0)
                });
                let [Some(a), Some(b), Some(c), Some(d)] = pixels else { continue };
                // The side of a square of the same area: what a tilt leaves of it.
                let area = ((c - a).perp(&(d - b)) / 2.0).abs();
                let bin = (area.sqrt() / 10.0) as u32 * 10;
                let entry = tally.there.entry(bin).or_default();
                entry.0 += 1;
                entry.1 += u32::from(found.iter().any(|found| found.id == marker.id));
            }
        }
    }
    report(&mut tally);
    assert!(tally.wrong.is_empty(), "{:#?}", tally.wrong);
    let (there, found) =
        tally.there.range(40..).fold((0, 0), |sum, (_, entry)| (sum.0 + entry.0, sum.1 + entry.1));
    assert!(found * 100 >= there * MIN_RECALL_PERCENT, "{found} of {there}");
    assert!(median(&mut tally.radial).abs() < 0.15);
    let squared = median(&mut tally.squared).sqrt();
    assert!((0.5..2.0).contains(&squared), "deviations are off by {squared}");
}

/// Of markers whose sides have 40 px or more in the view magnified twice, and are seen at less than
/// 65 degrees.
const MIN_RECALL_PERCENT: u32 = 60;

fn compare(
    tally: &mut Tally,
    view: &View,
    marker: &flockeye_detection::MarkerInView,
    rays: &[Ray; 4],
    frame: u32,
) {
    let Some(truth): Option<Vec<Vector2<f64>>> =
        rays.iter().map(|ray| view.project(ray).map(|pixel| pixel.0)).collect()
    else {
        return;
    };
    let middle = truth.iter().sum::<Vector2<f64>>() / 4.0;
    tally.unrefined += u32::from(!marker.is_refined);
    for k in 0..4 {
        let error = marker.corners_in_view[k].0 - truth[k];
        if error.norm() > 6.0 {
            tally.wrong.push(format!("frame {frame}, corner {k} off by {error:?}: {marker:?}"));
        }
        tally.errors.push(error.norm());
        tally.radial.push(error.dot(&(truth[k] - middle).normalize()));
        let angle = marker.rays_in_camera[k].angle(&rays[k]);
        tally.squared.push((angle / marker.deviations_rad[k]).powi(2) / 2.0);
    }
}

fn report(tally: &mut Tally) {
    for (side, (there, found)) in &tally.there {
        println!("side {side:3} to {:3} px: {found:3} of {there:3}", side + 10);
    }
    let corners = tally.radial.len();
    println!(
        "{corners} corners ({} of unrefined markers): radial bias median {:+.3} px, mean {:+.3} px; \
         error median {:.3} px, 90 % {:.3} px; error/deviation median {:.2}, mean {:.2}",
        tally.unrefined * 4,
        median(&mut tally.radial),
        tally.radial.iter().sum::<f64>() / corners as f64,
        median(&mut tally.errors),
        tally.errors[corners * 9 / 10],
        median(&mut tally.squared).sqrt(),
        (tally.squared.iter().sum::<f64>() / corners as f64).sqrt(),
    );
}

const PANORAMAS: [&str; 3] = [
    "real/theta_s/eqrect_example.png",
    "real/theta_s/eqrect_example_good.png",
    "real/panorama/examplepano.jpg",
];

#[test]
fn real_panoramas_hold_no_marker() {
    let Some(data) = data() else { return };
    let light = srgb();
    for dictionary in ["DICT_5X5_250", "DICT_4X4_50", "DICT_6X6_250"] {
        let mut detector = Detector::new(dictionary, DetectorParameters::default()).unwrap();
        for file in PANORAMAS {
            let picture = Picture::read(&data.join(file));
            let focal = picture.width as f64 / (2.0 * PI);
            for magnified in [1.0, 2.0] {
                detector.set_magnification(magnified);
                for view in partitions(magnified * focal) {
                    let cut = picture.cut(&view);
                    let found = detector.detect(&cut.image(), &view, &light);
                    assert!(found.is_empty(), "{dictionary} in {file}: {found:#?}");
                }
            }
        }
    }
}

/// Where texture reads as a marker it does so in few views.
#[test]
fn real_panoramas_hold_no_marker_in_any_direction() {
    const VIEWS: usize = 60;
    let Some(data) = data() else { return };
    let light = srgb();
    let dictionaries = ["DICT_5X5_250", "DICT_4X4_50", "DICT_6X6_250"];
    let mut detectors =
        dictionaries.map(|name| Detector::new(name, DetectorParameters::default()).unwrap());
    for file in PANORAMAS {
        let picture = Picture::read(&data.join(file));
        for n in 0..VIEWS {
            // Directions spread evenly over the sphere by the golden angle.
            let z = (2 * n + 1) as f64 / VIEWS as f64 - 1.0;
            let (sin, cos) = (n as f64 * PI * (3.0 - 5f64.sqrt())).sin_cos();
            let across = (1.0 - z * z).sqrt();
            let direction = Vector3::new(across * cos, across * sin, z);
            let magnified = [1.0, 1.5, 2.0, 3.0][n % 4];
            let field = 50f64.to_radians();
            let focal = magnified * picture.width as f64 / (2.0 * PI);
            let size = (2.0 * focal * (field / 2.0).tan()).ceil() as u32;
            let view = View::looking_at(&Unit::new_normalize(direction), field, size);
            let cut = picture.cut(&view);
            for (detector, dictionary) in detectors.iter_mut().zip(dictionaries) {
                detector.set_magnification(magnified);
                let found = detector.detect(&cut.image(), &view, &light);
                assert!(found.is_empty(), "{dictionary} in {file}, {view:?}: {found:#?}");
            }
        }
    }
}

#[test]
fn a_real_print_is_read() {
    let Some(data) = data() else { return };
    let picture = Picture::read(&data.join("real/opencv_aruco/singlemarkersoriginal.jpg"));
    let view = View::looking_at(&Vector3::x_axis(), 1.0, picture.width as u32);
    let mut detector = Detector::new("DICT_6X6_250", DetectorParameters::default()).unwrap();
    let found = detector.detect(&picture.image(), &view, &srgb());
    let ids: Vec<u32> = found.iter().map(|marker| marker.id).collect();
    assert_eq!(ids, [23, 40, 62, 98, 124, 203]);
    assert!(found.iter().all(|marker| marker.is_refined), "{found:#?}");
}

#[test]
fn a_dictionary_file_is_read() {
    let Some(data) = data() else { return };
    let folder = data.join("real/opencv_aruco");
    let file = folder.join("tutorial_dict.yml");
    let picture = Picture::read(&folder.join("gboriginal.png"));
    let view = View::looking_at(&Vector3::x_axis(), 1.0, picture.width as u32);
    let parameters = DetectorParameters::default();
    let mut detector = Detector::new(file.to_str().unwrap(), parameters).unwrap();
    assert_eq!(detector.dictionary().marker_count(), 35);
    let found = detector.detect(&picture.image(), &view, &srgb());
    println!("{} of 35 of the board", found.len());
    assert!(found.len() >= 30);
}
