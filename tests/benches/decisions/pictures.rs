//! Pictures with known bodies: simulated ones with any exposure, and recorded ones.

use crate::frames::each_frame;
use flockeye_config::{Pipeline, Resolved};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::Bodies;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::align::BodyPrint;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::sphere::{Cut, SphereImage, rectify_into};
use flockeye_simulator::{World, settings};
use flockeye_tables::TruthRow;
use flockeye_tests::recordings;
use nalgebra::{Isometry3, Quaternion, Unit, UnitQuaternion};

const WIDTH: u32 = 3840;
/// The seeds of the simulated frames, which were not used to choose parameters, and the frames of
/// each.
const SEEDS: std::ops::Range<u64> = 5201..5213;
const FRAMES: [u64; 4] = [0, 40, 80, 120];
/// Recordings, and the interval of their used frames.
const RECORDINGS: [(&str, &str, u64); 3] =
    [("flight1", "flight1.mp4", 6), ("flight4", "flight4.mp4", 3), ("stills", "images", 1)];
/// Half of a view's field, in radii of the body.
const AROUND: f64 = 2.5;
const RADIUS_M: f64 = 0.09;
/// Magnification of views, as for regions of interest of distant bodies.
const MAGNIFICATION: f64 = 2.0;

/// A body that a picture shows.
pub struct Shown {
    pub camera_from_markers: Isometry3<f64>,
    /// Index of the body.
    pub body: usize,
    pub blur_px: f64,
}

/// A picture of the sphere.
pub struct Still {
    /// Source of the picture.
    pub origin: &'static str,
    pub luma: Vec<u8>,
    pub bodies: Vec<Shown>,
    pub prints: std::rc::Rc<Vec<BodyPrint>>,
}

/// A view, with its pixels.
pub struct Cutting {
    pub view: View,
    pixels: Vec<u8>,
}

impl Cutting {
    pub fn image(&self) -> LumaImage<'_> {
        let size = self.view.size_px as usize;
        LumaImage::new(&self.pixels, size, size, size).unwrap()
    }
}

fn camera() -> Camera {
    Camera::equirectangular(WIDTH, WIDTH / 2)
}

impl Still {
    pub fn pixels_per_radian(&self) -> f64 {
        camera().pixels_per_radian()
    }

    /// The view of a body at a pose.
    pub fn view_of(&self, camera_from_markers: &Isometry3<f64>) -> Cutting {
        let (direction, range_m) = Unit::new_and_get(camera_from_markers.translation.vector);
        let focal_px = MAGNIFICATION * self.pixels_per_radian();
        let size_px = (2.0 * focal_px * AROUND * RADIUS_M / range_m).ceil() as u32 + 16;
        let field_rad = 2.0 * (f64::from(size_px) / (2.0 * focal_px)).atan();
        let view = View::looking_at(&direction, field_rad, size_px);
        let mut pixels = vec![0; (size_px * size_px) as usize];
        let sphere = SphereImage::new(&self.luma, WIDTH as usize, camera()).unwrap();
        rectify_into(&sphere, &Cut::cubic(view), &mut pixels, size_px as usize).unwrap();
        Cutting { view, pixels }
    }

    /// The same picture with an exposure that is longer by `stops`. The blur is in linear light,
    /// and clipping follows it.
    pub fn exposed(&self, stops: f64) -> Self {
        let decode = |code: f64| {
            if code <= 0.04045 { code / 12.92 } else { ((code + 0.055) / 1.055).powf(2.4) }
        };
        let encode = |light: f64| {
            if light <= 0.003_130_8 { light * 12.92 } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
        };
        let table: Vec<u8> = (0..256)
            .map(|code| {
                let light = (decode(f64::from(code) / 255.0) * stops.exp2()).min(1.0);
                (255.0 * encode(light)).round() as u8
            })
            .collect();
        let luma = self.luma.iter().map(|code| table[usize::from(*code)]).collect();
        let bodies = self.bodies.iter().map(|shown| Shown { ..*shown }).collect();
        Self { luma, bodies, prints: self.prints.clone(), ..*self }
    }
}

fn prints_of(bodies: &Bodies) -> std::rc::Rc<Vec<BodyPrint>> {
    let dictionary = Dictionary::of(bodies).unwrap();
    let print = |body| BodyPrint::new(body, |id| dictionary.print(id)).unwrap();
    std::rc::Rc::new(bodies.iter().map(print).collect())
}

/// Simulated pictures.
pub fn simulated(mut each: impl FnMut(&Still)) {
    for seed in SEEDS {
        let overrides = [
            "simulator.tilt_deg=15".to_owned(),
            "simulator.yaw_deg_s=30".to_owned(),
            "simulator.exposure_ms=5".to_owned(),
            "simulator.distance_m=[0.7,4.0]".to_owned(),
            format!("simulator.seed={seed}"),
        ];
        let pipeline = Pipeline::parse("", &overrides, "a benchmark").unwrap();
        let resolved = Resolved::of(pipeline).unwrap();
        let bodies = settings::flying_bodies(&resolved).unwrap().unwrap();
        let prints = prints_of(&bodies);
        let dictionary = Dictionary::of(&bodies).unwrap();
        let parameters = settings::parameters(&resolved).unwrap();
        let mut world = World::new(parameters, &bodies, &dictionary).unwrap();
        for frame in FRAMES {
            let mut luma = vec![0; (WIDTH * WIDTH / 2) as usize];
            let truth = world.render(frame, &mut luma, WIDTH as usize).unwrap();
            let visible = truth.bodies.iter().filter(|body| body.localisable);
            let bodies = visible
                .map(|body| Shown {
                    camera_from_markers: body.camera_from_markers,
                    body: body.target,
                    blur_px: body.blur_px,
                })
                .collect();
            let still = Still { origin: "simulated", luma, bodies, prints: prints.clone() };
            each(&still);
        }
    }
}

/// Pictures of the available recordings.
pub fn recorded(mut each: impl FnMut(&Still)) {
    let Some(data) = recordings() else { return println!("decisions: no recordings") };
    let overrides = [format!("bodies.file={}", data.join("bodies.json").display())];
    let pipeline = Pipeline::parse("", &overrides, "a benchmark").unwrap();
    let bodies = Resolved::of(pipeline).unwrap().bodies;
    let prints = prints_of(&bodies);
    for (origin, pictures, every) in RECORDINGS {
        let folder = data.join(origin);
        let truth: Vec<TruthRow> = flockeye_tables::read(&folder.join("truth.csv")).unwrap();
        each_frame(&folder.join(pictures), camera(), |number, image| {
            if number % every != 0 {
                return;
            }
            let of_frame = truth.iter().filter(|row| row.frame == number && row.localisable == 1);
            let shown = of_frame.filter_map(|row| {
                let body = bodies.iter().position(|body| body.name == row.body)?;
                let markers = &bodies.get(body)?.target_from_markers;
                let rotation = UnitQuaternion::from_quaternion(Quaternion::new(
                    row.qw, row.qx, row.qy, row.qz,
                ));
                let camera_from_target = Isometry3::from_parts(row.position().into(), rotation);
                let camera_from_markers = camera_from_target * markers;
                Some(Shown { camera_from_markers, body, blur_px: row.blur_px })
            });
            let bodies = shown.collect();
            let rows = image.pixels().chunks(image.stride());
            let luma = rows.flat_map(|row| &row[..WIDTH as usize]).copied().collect();
            each(&Still { origin, luma, bodies, prints: prints.clone() });
        });
    }
}
