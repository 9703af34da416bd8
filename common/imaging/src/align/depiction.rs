//! A body's pixels beside those of its model, so that people can check an alignment.

use nalgebra::{Isometry3, Vector2};

use super::alignment::{AlignError, AlignOptions};
use super::evidence::{Evidence, compare};
use super::model::Scene;
use super::patch::{Patch, Picture};
use super::print::BodyPrint;
use super::solve;
use super::state::State;
use super::{PreparedView, blur_margin_px};
use crate::light::LinearLight;

/// The part of a picture that shows a body, and the picture that the model predicts.
///
/// Rows of `width` values follow each other, as radiance.
#[derive(Debug, Clone, PartialEq)]
pub struct Depiction {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels of the picture, at the resolution of the alignment.
    pub picture: Vec<f32>,
    /// The picture with the body drawn over it. Lens and motion blur the body, and its facets have
    /// the levels that explain the picture best.
    pub model: Vec<f32>,
    /// Agreement of both at this pose, which is not fitted.
    pub evidence: Evidence,
}

impl Depiction {
    /// Picture, model and residual side by side, as code values: rows of three times `width`
    /// values. The residual is grey where both are equal.
    pub fn panels(&self, light: &LinearLight) -> Vec<u8> {
        let code = |radiance: f32| light.code_of(f64::from(radiance)).clamp(0.0, 255.0);
        let row = |row: usize| {
            let place = row * self.width..(row + 1) * self.width;
            let (picture, model) = (&self.picture[place.clone()], &self.model[place]);
            let residual = picture
                .iter()
                .zip(model)
                .map(move |(picture, model)| (127.5 + (code(*picture) - code(*model))) as u8);
            let shown = picture.iter().chain(model).map(move |radiance| code(*radiance) as u8);
            shown.chain(residual).collect::<Vec<u8>>()
        };
        (0..self.height).flat_map(row).collect()
    }
}

/// Draws `print` at a pose beside `picture`. Only the facets' white and black levels are fitted.
pub fn depict(
    print: &BodyPrint,
    picture: &Picture<'_>,
    camera_from_markers: &Isometry3<f64>,
    options: &AlignOptions,
) -> Result<Depiction, AlignError> {
    let view = PreparedView::new(print, picture, camera_from_markers, options, 0.0)?;
    let mut state = view.state(print, camera_from_markers);
    let PreparedView { patch, prior, .. } = view;
    let samples = solve::fit_levels_alone(&patch, print, &mut state).ok_or(AlignError::Nothing)?;
    let (evidence, _) = compare(&patch, print, &state, &samples, prior.samples_per_pixel());
    let model = draw(&patch, print, &state);
    let Patch { width, height, radiance, .. } = patch;
    Ok(Depiction { width, height, picture: radiance, model, evidence })
}

/// The patch with the body drawn over it.
fn draw(patch: &Patch, print: &BodyPrint, state: &State) -> Vec<f32> {
    let scene = Scene::new(print, state, patch);
    let margin_px = blur_margin_px(&state.spread.whole());
    let mut model = patch.radiance.clone();
    let halves = (0..).zip(&scene.halves);
    let facets = halves
        .flat_map(|(half, seen)| (0..print.facets.len()).map(move |index| (half, seen, index)));
    for (half, seen, index) in facets {
        let Some((visible, blurred)) = seen.facet(index) else { continue };
        let [white, black] = state.levels[index];
        let bounds = |axis: usize, size: usize| {
            let (low, high) = visible.span_px(axis);
            let end = (high + margin_px).ceil().max(0.0) as usize;
            (low - margin_px).floor().max(0.0) as usize..end.saturating_add(1).min(size)
        };
        let columns = bounds(0, patch.width);
        for y in bounds(1, patch.height) {
            for x in columns.clone() {
                let pixel = Vector2::new(x as f64, y as f64);
                let at = visible.point(&patch.pinhole.direction(pixel));
                let covered = blurred.coverage(at).value;
                // False for a NaN, as where the plane is seen edge-on.
                let is_covered = covered > 0.0;
                if !is_covered || !patch.shows_half(half, x, y) {
                    continue;
                }
                let place = y * patch.width + x;
                let shown = blurred.black(at).value;
                let behind = patch.radiance[place];
                model[place] +=
                    (white as f32 - behind) * covered + (black as f32 - white as f32) * shown;
            }
        }
    }
    model
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::light::{CodeRange, TransferCurve};

    #[test]
    fn panels_lie_side_by_side_and_what_agrees_is_grey() {
        let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        let shown = Depiction {
            width: 2,
            height: 2,
            picture: vec![0.0, 1.0, 0.5, 0.5],
            model: vec![0.0, 0.0, 0.5, 1.0],
            evidence: Evidence::default(),
        };
        let panels = shown.panels(&light);
        let (first, second) = panels.split_at(6);
        assert_eq!(first, [0, 255, 0, 0, 127, 255]);
        let half = second[0];
        assert!((180..196).contains(&half), "half the light has code {half}");
        assert_eq!(second[1..5], [half, half, 255, 127]);
        assert!(second[5] < 127, "the model is brighter");
    }
}
