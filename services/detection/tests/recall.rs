//! How many of drawn markers are found.

#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "../../../common/imaging/tests/drawn/mod.rs"]
#[allow(dead_code, reason = "not all of it is needed here")]
mod drawn;

use drawn::{Dice, Glove, Scene, Stripes, encode};
use flockeye_detection::{Detector, DetectorParameters, MarkerInView};
use flockeye_geometry::view::View;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::Vector3;

struct Recall {
    detector: Detector,
    light: LinearLight,
    dice: Dice,
    /// How much more light there is than the sensor was set for.
    gain: f64,
}

impl Recall {
    fn new() -> Self {
        let detector = Detector::new("DICT_5X5_250", DetectorParameters::default()).unwrap();
        let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        Self { detector, light, dice: Dice(99), gain: 1.0 }
    }

    /// One marker with a side of `side` px before it is tilted, and its id.
    fn scene(&mut self, side: f64, tilt_deg: f64, blur: f64) -> (Scene, u32) {
        let id = self.dice.uniform(0.0, 34.0) as u32;
        let mut scene = Scene::new(&mut self.dice, side, tilt_deg.to_radians(), blur);
        let print = self.detector.dictionary().print(id).unwrap();
        for (row, cells) in (0..).zip(&mut scene.cells) {
            for (column, cell) in (0..).zip(cells) {
                *cell = print.is_white(row, column);
            }
        }
        (scene, id)
    }

    fn find(&mut self, scene: &Scene) -> Vec<MarkerInView> {
        let rendered: Vec<f64> = scene.render().iter().map(|light| light * self.gain).collect();
        let pixels = encode(&rendered, TransferCurve::Srgb, 0.01, &mut self.dice);
        let image = LumaImage::new(&pixels, scene.size, scene.size, scene.size).unwrap();
        let view = View::looking_at(&Vector3::x_axis(), 0.2, scene.size as u32);
        self.detector.detect(&image, &view, &self.light)
    }

    /// Draws 40 markers. Returns how many are found, percent.
    fn measure(
        &mut self,
        side: f64,
        tilt_deg: f64,
        blur: f64,
        change: impl Fn(&mut Scene, &mut Dice),
    ) -> u32 {
        const MARKERS: u32 = 40;
        let mut found = 0;
        for _ in 0..MARKERS {
            let (mut scene, id) = self.scene(side, tilt_deg, blur);
            change(&mut scene, &mut self.dice);
            let markers = self.find(&scene);
            let is_right = |marker: &&MarkerInView| {
                marker.id == id
                    && (0..4).all(|k| {
                        let error = marker.corners_in_view[k].0 - scene.corners[k].0;
                        error.norm() < 0.2 * side
                    })
            };
            let wrong = markers.iter().find(|m| !is_right(m));
            // A marker whose cells are hardly wider than the blur may be misread. So a pose needs
            // two markers that agree.
            let is_read = cell_in_blurs(side, tilt_deg, blur) > 2.0;
            assert!(
                wrong.is_none() || !is_read,
                "a marker that is not there: side {side} tilt {tilt_deg} blur {blur}, {id} at {:?}: {wrong:?}",
                scene.corners
            );
            found += u32::from(markers.iter().any(|m| is_right(&m)));
        }
        println!("side {side} tilt {tilt_deg} blur {blur}: {found} of {MARKERS}");
        100 * found / MARKERS
    }
}

/// Width of a cell where the marker is narrowest, in standard deviations of the blur, to which a
/// pixel's own width adds.
fn cell_in_blurs(side: f64, tilt_deg: f64, blur: f64) -> f64 {
    side * tilt_deg.to_radians().cos() / 7.0 / blur.hypot(0.29)
}

#[test]
fn markers_are_found_where_cells_are_wider_than_the_blur() {
    let mut recall = Recall::new();
    let mut shares = Vec::new();
    for side in [14.0, 16.0, 20.0, 30.0, 60.0] {
        for tilt in [0.0, 30.0, 50.0] {
            for blur in [0.6, 0.9, 1.2] {
                let found = recall.measure(side, tilt, blur, |_, _| {});
                shares.push((side, tilt, blur, found));
            }
        }
    }
    for (side, tilt, blur, found) in shares {
        let least = if cell_in_blurs(side, tilt, blur) > 2.0 { 90 } else { 0 };
        assert!(found >= least, "side {side} tilt {tilt} blur {blur}: {found} %");
    }
}

/// White grows over black where the sensor clips it, so the more light there is, the wider cells
/// must be.
#[test]
fn markers_that_saturate_the_sensor_are_found() {
    let mut recall = Recall::new();
    let mut shares = Vec::new();
    for (gain, least_blurs) in [(2.0, 2.0), (4.0, 2.8), (8.0, 5.5)] {
        recall.gain = gain;
        for side in [16.0, 20.0, 25.0, 30.0, 40.0, 60.0] {
            for tilt in [0.0, 40.0] {
                let found = recall.measure(side, tilt, 0.9, |_, _| {});
                shares.push((
                    gain,
                    side,
                    tilt,
                    found,
                    cell_in_blurs(side, tilt, 0.9) > least_blurs,
                ));
            }
        }
    }
    for (gain, side, tilt, found, is_wide) in shares {
        let least = if is_wide { 90 } else { 0 };
        assert!(found >= least, "gain {gain} side {side} tilt {tilt}: {found} %");
    }
}

/// Shadows as narrow as half a marker, with a quarter and with an eighth of the sun's light.
#[test]
fn markers_in_stripes_of_sun_are_found() {
    let mut recall = Recall::new();
    for (side, shade, least) in [(30.0, 0.25, 50), (60.0, 0.25, 85), (60.0, 0.125, 40)] {
        for tilt in [0.0, 40.0] {
            let found = recall.measure(side, tilt, 0.9, |scene, dice| {
                scene.stripes = Some(Stripes::of_shade(shade, dice));
            });
            assert!(found >= least, "side {side} tilt {tilt} shade {shade}: {found} %");
        }
    }
}

#[test]
fn markers_with_a_strut_across_one_corner_are_found() {
    let mut recall = Recall::new();
    for side in [20.0, 30.0, 60.0] {
        for tilt in [0.0, 30.0] {
            let found = recall.measure(side, tilt, 0.9, |scene, dice| {
                scene.strut = Some(dice.uniform(0.0, 4.0) as usize);
            });
            assert!(found >= 90, "side {side} tilt {tilt}: {found} %");
        }
    }
}

/// Markers as a view magnified twice shows them at 3.5 m: blurred by 0.8 of a cell.
#[test]
fn markers_at_long_range_are_found_although_blurred_by_a_cell() {
    let mut recall = Recall::new();
    for (side, blur) in [(16.0, 1.8), (18.0, 2.0)] {
        let found = recall.measure(side, 0.0, blur, |_, _| {});
        assert!(found >= 40, "side {side} blur {blur}: {found} %");
    }
}

/// Something grey that covers 5 to 35 % of both sides at any corner.
fn glove(dice: &mut Dice) -> Glove {
    Glove {
        corner: dice.uniform(0.0, 4.0) as usize,
        covered: [0, 1].map(|_| dice.uniform(0.05, 0.35)),
        radiance: dice.uniform(0.02, 0.7),
    }
}

/// Fingers that hold a marker hide a corner, and their edges look like its sides.
#[test]
fn hidden_corners_are_within_their_stated_deviations() {
    let mut recall = Recall::new();
    for side in [30.0, 60.0, 120.0] {
        let (mut errors, mut drawn) = (Vec::new(), 0);
        for tilt in [0.0, 20.0, 40.0] {
            for _ in 0..40 {
                let (mut scene, id) = recall.scene(side, tilt, 0.9);
                let glove = glove(&mut recall.dice);
                scene.glove = Some(glove);
                drawn += 1;
                let found = recall.find(&scene);
                let Some(marker) = found.iter().find(|marker| marker.id == id) else { continue };
                let corner = glove.corner;
                let error = marker.corners_in_view[corner].0 - scene.corners[corner].0;
                let view = View::looking_at(&Vector3::x_axis(), 0.2, scene.size as u32);
                let sigma_px = marker.deviations_rad[corner] * view.focal_px;
                // One standard deviation along each of two axes.
                errors.push(error.norm() / (sigma_px * 2f64.sqrt()));
            }
        }
        errors.sort_by(f64::total_cmp);
        let at = |share: f64| errors[((errors.len() - 1) as f64 * share) as usize];
        println!("side {side}: {} of {drawn}, {:.2} {:.2}", errors.len(), at(0.5), at(0.95));
        assert!(10 * errors.len() > 6 * drawn, "side {side}: {} of {drawn}", errors.len());
        // Of normal errors half are below 0.83, and 95 % below 1.73.
        assert!(at(0.5) < 1.5 && at(0.95) < 4.0, "side {side}: {} and {}", at(0.5), at(0.95));
    }
}
