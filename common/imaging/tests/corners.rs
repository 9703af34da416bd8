//! Corners of exactly rendered markers.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod drawn;

use drawn::{Dice, Scene, Stripes, encode};
use flockeye_geometry::camera::{Camera, Equirectangular, SpherePixel};
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::edges::{
    CornerFit, Grain, Lighting, MarkerPrint, RefinedCorners, refine_corners,
};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_imaging::sphere::{Cut, Interpolation, SphereImage, rectify_into};
use flockeye_imaging::square::mean_side_px;
use nalgebra::Vector2;

/// A scene as a camera shows it.
struct Shot {
    pixels: Vec<u8>,
    size: usize,
    curve: TransferCurve,
    grain: Grain,
    /// The true corners.
    corners: [ViewPixel; 4],
}

impl Shot {
    fn of(
        scene: &Scene,
        radiances: &[f64],
        curve: TransferCurve,
        noise: f64,
        dice: &mut Dice,
    ) -> Self {
        let pixels = encode(radiances, curve, noise, dice);
        let (size, corners) = (scene.size, scene.corners);
        Self { pixels, size, curve, grain: Grain::Pixels, corners }
    }

    /// A magnified view of a panorama that has the shot's pixels at its middle.
    fn cut(&self, magnification: f64, sphere: &mut [u8]) -> Self {
        let (width, height) = (PANORAMA.width as usize, PANORAMA.height as usize);
        let (left, top) = ((width - self.size) / 2, (height - self.size) / 2);
        for (y, row) in self.pixels.chunks(self.size).enumerate() {
            sphere[(top + y) * width + left..][..self.size].copy_from_slice(row);
        }
        let focal = magnification * PANORAMA.pixels_per_radian();
        // Without the shot's outermost pixels, because the panorama is black beside them.
        let size = (magnification * (self.size as f64 - 4.0)) as u32;
        let at = SpherePixel::new(
            left as f64 + (self.size as f64 - 1.0) / 2.0,
            top as f64 + (self.size as f64 - 1.0) / 2.0,
        );
        let field = 2.0 * (f64::from(size) / 2.0 / focal).atan();
        let view = View::looking_at(&PANORAMA.ray(at), field, size);
        let camera = Camera::equirectangular(PANORAMA.width, PANORAMA.height);
        let image = SphereImage::new(sphere, width, camera).unwrap();
        let interpolation = Interpolation::suited_to(&view, &camera);
        let cut = Cut { interpolation, ..Cut::bilinear(view) };
        let mut pixels = vec![0; (size * size) as usize];
        rectify_into(&image, &cut, &mut pixels, size as usize).unwrap();
        let corners = self.corners.map(|corner| {
            let at = SpherePixel::new(left as f64 + corner.0.x, top as f64 + corner.0.y);
            view.project(&PANORAMA.ray(at)).unwrap()
        });
        let grain = Grain::Resampled { magnification };
        Self { pixels, size: size as usize, grain, corners, ..*self }
    }

    fn refine(&self, guess: &[ViewPixel; 4], print: &MarkerPrint) -> Option<RefinedCorners> {
        self.refine_lit(guess, print, Lighting::Even)
    }

    fn refine_lit(
        &self,
        guess: &[ViewPixel; 4],
        print: &MarkerPrint,
        lighting: Lighting,
    ) -> Option<RefinedCorners> {
        let image = LumaImage::new(&self.pixels, self.size, self.size, self.size).unwrap();
        let light = LinearLight::new(self.curve, CodeRange::Full).unwrap();
        refine_corners(&image, &light, guess, print, self.grain, lighting, CornerFit::WholePrint)
    }

    fn middle(&self) -> Vector2<f64> {
        self.corners.iter().map(|corner| corner.0).sum::<Vector2<f64>>() / 4.0
    }

    /// A guess as by a contour: inside the corners, at whole pixels.
    fn guess(&self, dice: &mut Dice) -> [ViewPixel; 4] {
        let middle = self.middle();
        self.corners.map(|corner| {
            let inwards = (middle - corner.0).normalize() * dice.uniform(0.2, 1.2);
            ViewPixel((corner.0 + inwards).map(|x| (x + dice.uniform(-0.3, 0.3)).round()))
        })
    }
}

/// The image of a camera of 3840 x 1920.
const PANORAMA: Equirectangular = Equirectangular { width: 3840, height: 1920 };

/// Sums over many markers: shots and refined ones, radial errors (positive outwards), squared
/// errors along an axis, and stated variances.
#[derive(Default, Clone, Copy)]
struct Outcome {
    shots: usize,
    refined: usize,
    radial: f64,
    squares: f64,
    stated: f64,
}

impl Outcome {
    fn add(&mut self, shot: &Shot, scene: &Scene, dice: &mut Dice) {
        self.shots += 1;
        let guess = shot.guess(dice);
        let Some(found) = shot.refine(&guess, &scene.print()) else { return };
        self.refined += 1;
        let middle = shot.middle();
        for k in 0..4 {
            let error = found.corners_in_view[k].0 - shot.corners[k].0;
            self.radial += error.dot(&(shot.corners[k].0 - middle).normalize());
            self.squares += error.norm_squared() / 2.0;
            self.stated += found.sigmas_px[k].powi(2);
        }
    }

    fn bias(&self) -> f64 {
        self.radial / (4 * self.refined) as f64
    }

    fn scatter(&self) -> f64 {
        (self.squares / (4 * self.refined) as f64).sqrt()
    }

    /// True standard deviation relative to the stated one.
    fn excess(&self) -> f64 {
        (self.squares / self.stated).sqrt()
    }
}

/// Describes an outcome that is not good enough.
fn failure(what: &str, outcome: &Outcome, magnification: f64) -> Option<String> {
    let text = format!(
        "{what}: refined {:3} of {:3}, radial bias {:+.3} px, scatter {:.3} px, over stated {:.2}",
        outcome.refined,
        outcome.shots,
        outcome.bias(),
        outcome.scatter(),
        outcome.excess()
    );
    println!("{text}");
    let is_fine = outcome.refined * 100 >= outcome.shots * 80
        && outcome.bias().abs() <= 0.05 * magnification
        && (1.0 / 1.3..=1.3).contains(&outcome.excess());
    (!is_fine).then_some(text)
}

#[test]
fn corners_are_unbiased_and_their_standard_deviations_true() {
    let mut wrong = Vec::new();
    for (index, side) in [14.0, 20.0, 30.0, 60.0].into_iter().enumerate() {
        for tilt in [0.0, 30.0, 60.0f64] {
            for blur in [0.6, 1.0, 1.5] {
                let mut dice = Dice(77 + index as u64);
                let conditions = [
                    ("linear, noise 0.02", TransferCurve::Linear, 0.02),
                    ("sRGB, noise 0.02", TransferCurve::Srgb, 0.02),
                    ("sRGB, noise 0.05", TransferCurve::Srgb, 0.05),
                ];
                let mut outcomes = [Outcome::default(); 3];
                for _ in 0..if side > 50.0 { 6 } else { 10 } {
                    let scene = Scene::new(&mut dice, side, tilt.to_radians(), blur);
                    let radiances = scene.render();
                    for (outcome, (_, curve, noise)) in outcomes.iter_mut().zip(conditions) {
                        for _ in 0..2 {
                            let shot = Shot::of(&scene, &radiances, curve, noise, &mut dice);
                            outcome.add(&shot, &scene, &mut dice);
                        }
                    }
                }
                for (outcome, (name, ..)) in outcomes.iter().zip(conditions) {
                    let what = format!("side {side} tilt {tilt} blur {blur} {name}");
                    let wrongs = failure(&what, outcome, 1.0);
                    // Narrower cells, relative to the blur, cannot be read by eye either.
                    let cell = side * tilt.to_radians().cos() / 7.0;
                    wrong.extend(wrongs.filter(|_| cell > 1.2 * blur));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn corners_in_magnified_views_are_as_uncertain_as_in_their_image() {
    let mut sphere = vec![90; (PANORAMA.width * PANORAMA.height) as usize];
    let mut wrong = Vec::new();
    for (index, side) in [14.0, 20.0, 30.0].into_iter().enumerate() {
        for tilt in [0.0, 45.0f64] {
            for blur in [0.8, 1.2] {
                let mut dice = Dice(177 + index as u64);
                let magnifications = [1.0, 2.0, 3.0];
                let mut outcomes = [Outcome::default(); 3];
                for _ in 0..10 {
                    let scene = Scene::new(&mut dice, side, tilt.to_radians(), blur);
                    let radiances = scene.render();
                    for (outcome, magnification) in outcomes.iter_mut().zip(magnifications) {
                        for _ in 0..2 {
                            let shot =
                                Shot::of(&scene, &radiances, TransferCurve::Srgb, 0.02, &mut dice);
                            let cut = shot.cut(magnification, &mut sphere);
                            outcome.add(&cut, &scene, &mut dice);
                        }
                    }
                }
                for (outcome, magnification) in outcomes.iter().zip(magnifications) {
                    let what = format!("side {side} tilt {tilt} blur {blur} x {magnification}");
                    wrong.extend(failure(&what, outcome, magnification));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn an_occluded_part_of_a_side_moves_corners_little() {
    let mut dice = Dice(5);
    let mut errors = Vec::new();
    for _ in 0..30 {
        let mut scene = Scene::new(&mut dice, 36.0, 0.4, 0.9);
        scene.occluded = 0.2;
        let shot = Shot::of(&scene, &scene.render(), TransferCurve::Srgb, 0.005, &mut dice);
        if let Some(found) = shot.refine(&shot.guess(&mut dice), &scene.print()) {
            errors.extend((0..4).map(|k| (found.corners_in_view[k].0 - scene.corners[k].0).norm()));
        }
    }
    errors.sort_by(f64::total_cmp);
    println!("{} corners, median {:.3} px", errors.len(), errors[errors.len() / 2]);
    assert!(errors.len() > 60 && errors[errors.len() / 2] < 0.15);
}

#[test]
fn stripes_of_sun_move_corners_little() {
    let mut dice = Dice(15);
    let mut errors: Vec<(f64, f64)> = Vec::new();
    for _ in 0..60 {
        let mut scene = Scene::new(&mut dice, 50.0, 0.4, 0.9);
        scene.stripes = Some(Stripes::of_shade(0.2, &mut dice));
        let shot = Shot::of(&scene, &scene.render(), TransferCurve::Srgb, 0.005, &mut dice);
        let guess = shot.guess(&mut dice);
        if let Some(found) = shot.refine_lit(&guess, &scene.print(), Lighting::Uneven) {
            errors.extend((0..4).map(|k| {
                let error = (found.corners_in_view[k].0 - scene.corners[k].0).norm();
                (error, error / (2f64.sqrt() * found.sigmas_px[k]))
            }));
        }
    }
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (median, tail) = (errors[errors.len() / 2].0, errors[errors.len() * 9 / 10].0);
    let beyond = errors.iter().filter(|(_, sigmas)| *sigmas > 3.0).count();
    println!("{} corners, median {median:.3} px, 90 % {tail:.3} px, {beyond} beyond", errors.len());
    assert!(errors.len() > 180 && median < 0.15 && tail < 0.6 && beyond * 10 < errors.len());
}

#[test]
fn clipped_whites_do_not_move_the_edge() {
    let mut dice = Dice(9);
    let mut radial = Vec::new();
    for _ in 0..30 {
        let mut scene = Scene::new(&mut dice, 30.0, 0.5, 1.0);
        scene.white = 1.3;
        let shot = Shot::of(&scene, &scene.render(), TransferCurve::Srgb, 0.005, &mut dice);
        let guess = shot.guess(&mut dice);
        let Some(found) = shot.refine(&guess, &scene.print()) else { continue };
        let middle = shot.middle();
        radial.extend((0..4).map(|k| {
            let error = found.corners_in_view[k].0 - scene.corners[k].0;
            error.dot(&(scene.corners[k].0 - middle).normalize())
        }));
    }
    let mean = radial.iter().sum::<f64>() / radial.len() as f64;
    println!("{} corners, mean radial error {mean:+.3} px", radial.len());
    assert!(radial.len() > 60 && mean.abs() < 0.1);
}

#[test]
fn images_without_a_marker_are_refused() {
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let guess = [(10.0, 10.0), (30.0, 10.0), (30.0, 30.0), (10.0, 30.0)];
    let guess = guess.map(|(x, y)| ViewPixel::new(x, y));
    let print = MarkerPrint::of_bits(&[true; 25]).unwrap();
    let assert_refused = |image: &LumaImage<'_>, guess: &[ViewPixel; 4]| {
        for lighting in [Lighting::Even, Lighting::Uneven] {
            let corner_fit = CornerFit::WholePrint;
            let found =
                refine_corners(image, &light, guess, &print, Grain::Pixels, lighting, corner_fit);
            assert_eq!(found, None, "{lighting:?}, {guess:?}");
        }
    };
    let mut dice = Dice(3);
    for flat in [0u8, 90, 255] {
        let pixels = [flat; 1600];
        assert_refused(&LumaImage::new(&pixels, 40, 40, 40).unwrap(), &guess);
    }
    let pixels: Vec<u8> = (0..1600).map(|_| dice.uniform(0.0, 255.0) as u8).collect();
    let image = LumaImage::new(&pixels, 40, 40, 40).unwrap();
    let shifted =
        |scale: f64, by: f64| guess.map(|p| ViewPixel(p.0 * scale + Vector2::new(by, by)));
    let mut counterclockwise = guess;
    counterclockwise.reverse();
    let [small, outside, not_finite] =
        [shifted(0.3, 0.0), shifted(1.0, 100.0), shifted(1.0, f64::NAN)];
    for guess in [small, outside, not_finite, counterclockwise] {
        assert_refused(&image, &guess);
    }
    assert_refused(&LumaImage::new(&pixels[..1], 1, 1, 1).unwrap(), &guess);
}

#[test]
fn guesses_off_by_a_pixel_and_a_half_lead_to_the_same_corners() {
    let mut dice = Dice(21);
    for _ in 0..20 {
        let scene = Scene::new(&mut dice, 28.0, 0.5, 0.9);
        let shot = Shot::of(&scene, &scene.render(), TransferCurve::Srgb, 0.0, &mut dice);
        let print = scene.print();
        let exact = shot.refine(&scene.corners, &print).expect("from the truth");
        let middle = shot.middle();
        let inside = scene.corners.map(|p| ViewPixel(p.0 + (middle - p.0).normalize() * 1.5));
        assert!(mean_side_px(&inside) < mean_side_px(&scene.corners));
        let found = shot.refine(&inside, &print).expect("from inside");
        for k in 0..4 {
            let apart = (found.corners_in_view[k].0 - exact.corners_in_view[k].0).norm();
            assert!(apart < 0.05, "corner {k}: {apart} px apart");
        }
    }
}
