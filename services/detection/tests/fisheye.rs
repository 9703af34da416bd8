//! Real pictures of a 195-degree fisheye before a board of AprilTags, whose corners touch black
//! squares: markers found, and errors of their corners.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod shared;

use std::collections::BTreeMap;
use std::path::Path;

use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{Search, ViewKind};
use flockeye_detection::windows::thresholds;
use flockeye_detection::{Detector, DetectorParameters, MarkerInView};
use flockeye_geometry::camera::SpherePixel;
use flockeye_imaging::edges::CornerFit;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_imaging::sphere::{Cut, SphereImage, rectify_into};
use nalgebra::Vector2;
use serde::Deserialize;
use shared::{Picture, data};

/// A corner in the camera's own picture, by the published calibration and the board's pose from the
/// saddle points where corners touch.
#[derive(Deserialize)]
struct ReferenceCorner {
    frame: u32,
    id: u32,
    corner: usize,
    projected_u: f64,
    projected_v: f64,
    off_axis_deg: f64,
}

/// Columns and rows from the camera's own picture to the frame that it lies in.
const OFFSET_PX: f64 = 128.0;

/// Markers beyond this are not wholly in the lens's circle.
const LARGEST_OFF_AXIS_DEG: f64 = 90.5;

/// Distance of a corner from its reference beyond which the marker is a wrong one, pixels.
const WRONG_PX: f64 = 8.0;

/// The reference corners of each marker that is wholly in sight, by frame and id.
fn references(folder: &Path) -> BTreeMap<(u32, u32), Vec<ReferenceCorner>> {
    let mut references: BTreeMap<(u32, u32), Vec<ReferenceCorner>> = BTreeMap::new();
    let mut reader = csv::Reader::from_path(folder.join("reference_corners.csv")).unwrap();
    for corner in reader.deserialize().map(Result::<ReferenceCorner, _>::unwrap) {
        references.entry((corner.frame, corner.id)).or_default().push(corner);
    }
    let is_in_sight = |corner: &ReferenceCorner| corner.off_axis_deg < LARGEST_OFF_AXIS_DEG;
    references.retain(|_, corners| corners.iter().all(is_in_sight));
    references
}

/// What was found in all pictures.
#[derive(Default)]
struct Found {
    /// Errors of the corners of each right marker, pixels of the camera's picture.
    errors_px: BTreeMap<(u32, u32), Vec<f64>>,
    /// Markers that are not there.
    wrong: Vec<(u32, u32, Vec<f64>)>,
}

impl Found {
    fn note(
        &mut self,
        frame: u32,
        marker: &MarkerInView,
        references: &[ReferenceCorner],
        resolved: &Resolved,
    ) {
        let error_px = |reference: &ReferenceCorner| {
            let at = Vector2::new(reference.projected_u, reference.projected_v);
            let SpherePixel(seen) =
                resolved.camera.project(&marker.rays_in_camera[reference.corner]).unwrap();
            (seen - at.add_scalar(OFFSET_PX)).norm()
        };
        let errors_px: Vec<f64> = references.iter().map(error_px).collect();
        if !errors_px.is_empty() && errors_px.iter().all(|error_px| *error_px < WRONG_PX) {
            self.errors_px.insert((frame, marker.id), errors_px);
        } else {
            self.wrong.push((frame, marker.id, errors_px));
        }
    }
}

#[test]
fn a_board_whose_markers_touch_black_squares_is_read() {
    let Some(data) = data() else { return };
    let folder = data.join("real/tumvi");
    let bodies = folder.join("bodies.json");
    let overrides = [format!("bodies.file={}", bodies.display()), "profile=stills".to_owned()];
    let text = std::fs::read_to_string(folder.join("lens.yaml")).unwrap();
    let pipeline = Pipeline::parse(&text, &overrides, "lens.yaml").unwrap();
    let resolved = Resolved::of(pipeline).unwrap();
    let references = references(&folder);
    let dictionary = folder.join("kalibr_36h11_border2.yml");
    let parameters = DetectorParameters { corner_fit: CornerFit::Edges, ..Default::default() };
    let mut detector = Detector::new(dictionary.to_str().unwrap(), parameters).unwrap();
    let magnification = resolved.partition_views[0].focal_px / resolved.camera.pixels_per_radian();
    detector.set_magnification(magnification);
    let windows = thresholds(ViewKind::Partition, Search::AllWindows, magnification);
    detector.set_thresholds(windows).unwrap();
    // The camera is a machine-vision camera, whose code values are proportional to light.
    let light = LinearLight::new(TransferCurve::Linear, CodeRange::Full).unwrap();
    let mut found = Found::default();
    for frame in 0..6 {
        let picture = Picture::read(&folder.join(format!("images/{frame:03}.png")));
        let sphere = SphereImage::new(&picture.pixels, picture.width, resolved.camera).unwrap();
        for view in &resolved.partition_views {
            let size = view.size_px as usize;
            let mut pixels = vec![0; size * size];
            rectify_into(&sphere, &Cut::bilinear(*view), &mut pixels, size).unwrap();
            let cut = Picture { pixels, width: size, height: size };
            for marker in detector.detect(&cut.image(), view, &light) {
                let references = references.get(&(frame, marker.id)).map_or(&[][..], |r| r);
                found.note(frame, &marker, references, &resolved);
            }
        }
    }
    let Found { errors_px, wrong } = found;
    let markers = errors_px.len();
    let mut errors_px: Vec<f64> = errors_px.into_values().flatten().collect();
    errors_px.sort_by(f64::total_cmp);
    let at = |share: f64| errors_px[((errors_px.len() - 1) as f64 * share) as usize];
    println!(
        "{markers} of {}, {:.2} {:.2} {:.2} px",
        references.len(),
        at(0.5),
        at(0.95),
        at(0.99)
    );
    assert!(markers >= 196, "{markers} of {}", references.len());
    // The reference itself is known to 0.1 to 0.26 px.
    assert!(at(0.5) < 0.19 && at(0.95) < 0.45, "{} and {}", at(0.5), at(0.95));
    assert!(wrong.is_empty(), "{wrong:?}");
}
