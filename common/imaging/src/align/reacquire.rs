//! Finding a body again that is not quite where it was predicted, without a decoded marker.
//!
//! The print is drawn in seven attitudes round the predicted one, with more blur, and moved over the
//! image within the view. What it explains of the image, over what facets of one plain light each
//! would, says how likely each place is; the best few are aligned. The drawing is made once for each
//! attitude, and its least squares solved once: moving it costs a product for each pixel.

use nalgebra::{DMatrix, DVector, Isometry3, UnitQuaternion, Vector3};

use super::levels::Row;
use super::patch::Patch;
use super::print::BodyPrint;
use super::samples::{self, Sample};
use super::solve::Scene;
use super::unknowns::State;

/// A body may have turned by this since, about any axis, radians.
const TURN_RAD: f64 = 0.14;
/// Samples of a drawing: more tell no more of where a blurred body is.
const SAMPLES: usize = 400;
/// Fewer say nothing.
const MIN_SAMPLES: usize = 40;
/// Places kept of each attitude, and in all.
const KEPT: usize = 3;
/// Light of a facet less certain than this share of a sample is no unknown of its own.
const RIDGE: f64 = 1e-3;

/// A place to begin from, in the patch's frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub patch_from_markers: Isometry3<f64>,
    /// Share of the light's variation that the print explains beyond plain facets.
    pub explained: f64,
}

/// The likeliest places of a body within `reach_px` of where `state` has it, best first.
pub(super) fn places(
    patch: &Patch,
    print: &BodyPrint,
    state: &State,
    extra_blur_px: f64,
    reach_px: f64,
) -> Vec<Place> {
    let mut found: Vec<Place> = Vec::new();
    for turn in attitudes() {
        let pose = &state.patch_from_markers;
        let turned = Isometry3::from_parts(pose.translation, turn * pose.rotation);
        let state = State { patch_from_markers: turned, ..state.clone() };
        if let Some(drawing) = Drawing::new(patch, print, &state, extra_blur_px) {
            // Half of what the extra blur smooths.
            let step = (extra_blur_px * 0.7).round().max(1.0) as isize;
            found.extend(drawing.places(patch, &state, step, (reach_px / step as f64) as isize));
        }
    }
    found.sort_by(|a, b| b.explained.total_cmp(&a.explained));
    found.truncate(KEPT);
    found
}

/// No turn, and one either way about each axis.
fn attitudes() -> impl Iterator<Item = UnitQuaternion<f64>> {
    let about = |axis: Vector3<f64>| [axis, -axis].map(UnitQuaternion::from_scaled_axis);
    let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
    std::iter::once(UnitQuaternion::identity())
        .chain(axes.into_iter().flat_map(move |axis| about(axis * TURN_RAD)))
}

/// A body drawn in one attitude.
struct Drawing {
    samples: Vec<Sample>,
    /// For each sample: slots of the facets that show in it, with their white and black.
    rows: Vec<Row>,
    full: nalgebra::Cholesky<f64, nalgebra::Dyn>,
    plain: nalgebra::Cholesky<f64, nalgebra::Dyn>,
    facets: usize,
}

impl Drawing {
    fn new(patch: &Patch, print: &BodyPrint, state: &State, extra_blur_px: f64) -> Option<Self> {
        let scene = Scene::new(print, state, patch, extra_blur_px);
        let all = samples::choose(patch, &print.facets, &scene.seen, &scene.blurred);
        let samples: Vec<Sample> =
            all.iter().step_by((all.len() / SAMPLES).max(1)).copied().collect();
        if samples.len() < MIN_SAMPLES {
            return None;
        }
        let facets = print.facets.len();
        let mut full = DMatrix::identity(2 * facets, 2 * facets) * RIDGE;
        let mut plain = DMatrix::identity(facets, facets) * RIDGE;
        let mut rows = Vec::with_capacity(samples.len());
        for sample in &samples {
            let direction = sample.direction(patch);
            let mut row = [(0, 0.0, 0.0); 3];
            let mut count = 0;
            for index in sample.facets() {
                let Some((seen, blurred)) = scene.facet(index) else { continue };
                let at = seen.seen(&direction);
                let black = f64::from(blurred.black(at).value);
                row[count] = (index, f64::from(blurred.coverage(at).value) - black, black);
                count += 1;
            }
            for &(a, a_white, a_black) in &row[..count] {
                for &(b, b_white, b_black) in &row[..count] {
                    for (i, one) in [a_white, a_black].into_iter().enumerate() {
                        for (j, other) in [b_white, b_black].into_iter().enumerate() {
                            full[(2 * a + i, 2 * b + j)] += one * other;
                        }
                    }
                    plain[(a, b)] += (a_white + a_black) * (b_white + b_black);
                }
            }
            rows.push((row, count));
        }
        Some(Self { samples, rows, full: full.cholesky()?, plain: plain.cholesky()?, facets })
    }

    /// The best places among shifts by whole steps, at most [`KEPT`].
    fn places(&self, patch: &Patch, state: &State, step: isize, most: isize) -> Vec<Place> {
        let mut found: Vec<Place> = Vec::new();
        for down in -most..=most {
            for right in -most..=most {
                let (dx, dy) = (right * step, down * step);
                let Some(explained) = self.explained(patch, dx, dy) else { continue };
                let pose = &state.patch_from_markers;
                let position = pose.translation.vector;
                let shift =
                    Vector3::new(dx as f64, dy as f64, 0.0) * (position.z / patch.pinhole.focal_px);
                let moved = Isometry3::from_parts((position + shift).into(), pose.rotation);
                found.push(Place { patch_from_markers: moved, explained });
            }
        }
        found.sort_by(|a, b| b.explained.total_cmp(&a.explained));
        found.truncate(KEPT);
        found
    }

    /// What the drawing, moved by so many pixels, explains beyond plain facets; `None` where too
    /// much of it leaves the patch.
    fn explained(&self, patch: &Patch, dx: isize, dy: isize) -> Option<f64> {
        let mut full = DVector::zeros(2 * self.facets);
        let mut plain = DVector::zeros(self.facets);
        let (mut squared, mut missing) = (0.0, 0);
        for (sample, (row, count)) in self.samples.iter().zip(&self.rows) {
            let x = usize::from(sample.x).checked_add_signed(dx).filter(|x| *x < patch.width);
            let y = usize::from(sample.y).checked_add_signed(dy).filter(|y| *y < patch.height);
            let light = match (x, y) {
                (Some(x), Some(y)) => f64::from(patch.at(x, y)),
                _ => f64::NAN,
            };
            if light.is_nan() {
                missing += 1;
                continue;
            }
            squared += light * light;
            for &(facet, white, black) in &row[..*count] {
                full[2 * facet] += white * light;
                full[2 * facet + 1] += black * light;
                plain[facet] += (white + black) * light;
            }
        }
        // Pixels that are missing count as if they were black: only a few may.
        if missing * 20 > self.samples.len() {
            return None;
        }
        let of_plain = plain.dot(&self.plain.solve(&plain));
        let of_full = full.dot(&self.full.solve(&full));
        let left = squared - of_plain;
        (left > 0.0).then(|| (of_full - of_plain) / left)
    }
}
