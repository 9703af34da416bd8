//! Whether what was aligned is the body at all.
//!
//! All markers have a white margin and a black border, and a wrong body aligned with the right one's
//! borders agrees with 0.7 of its light. What tells markers apart are the cells within the border.
//! So margin, border and the mean of the cells are regressed out, and what is left of the image is
//! correlated with what is left of the cells' own pattern, facet by facet (a partial correlation).

use nalgebra::Matrix5;

use super::patch::Patch;
use super::solve::{Fit, Scene};
use crate::align::print::BodyPrint;

/// How well the cells of the facets that face the camera agree with the image.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Score {
    /// Mean partial correlation of the cells with the image, over facets, by what each is worth.
    pub correlation: f64,
    /// Logarithm of the likelihood of the cells over that of none, summed over facets; negative
    /// where the image is the cells' negative.
    pub log_ratio: f64,
    /// Facets whose own correlation is above 0.6.
    pub agreeing_facets: u32,
    /// Facets that were compared.
    pub facets: u32,
}

impl Score {
    /// Whether the body is there: the fewer the facets' cells agree on average (something hides part of
    /// it, say), the more they must say in all.
    pub fn is_accepted(&self) -> bool {
        // One facet far away is a handful of pixels, and may be anything chequered.
        let is_seen_twice = self.agreeing_facets >= 2 || self.log_ratio > ONE_FACET_LOG_RATIO;
        is_seen_twice
            && ACCEPTED.iter().any(|&(correlation, log_ratio)| {
                self.correlation > correlation && self.log_ratio > log_ratio
            })
    }
}

/// Least mean correlation with least logarithm of the likelihood ratio. On rendered flights wrong
/// bodies, and right ones at wrong poses, stay below 0.44 with 13 and below 0.2 with 90.
const ACCEPTED: [(f64, f64); 3] = [(0.7, 8.0), (0.47, 30.0), (0.27, 200.0)];

/// What a single facet must say.
const ONE_FACET_LOG_RATIO: f64 = 100.0;

/// Facets with fewer samples are not compared.
const MIN_SAMPLES: u32 = 16;
/// Correlation of a facet that agrees.
const AGREEING: f64 = 0.6;
/// Correlations are capped: no picture is worth more.
const MOST: f64 = 0.995;

/// Products of ones, border, inside and cells with each other and with the light.
#[derive(Default, Clone)]
struct Facet {
    products: Matrix5<f64>,
    count: u32,
}

/// Scores a fit. `samples_per_pixel`: samples that count as one.
pub(super) fn score(patch: &Patch, print: &BodyPrint, fit: &Fit, samples_per_pixel: f64) -> Score {
    let scene = Scene::new(print, &fit.state, patch, 0.0);
    let mut facets = vec![Facet::default(); print.facets.len()];
    for sample in fit.samples.iter().filter(|sample| sample.is_inside()) {
        let index = usize::from(sample.facet);
        if print.facets[index].cells.is_none() {
            continue;
        }
        let Some((seen, blurred)) = scene.facet(index) else { continue };
        let parts = blurred.parts(seen.seen(&sample.direction(patch)));
        let [black, square, inside] = [parts.black, parts.square, parts.inside].map(f64::from);
        let border = square - inside;
        let row =
            nalgebra::Vector5::new(1.0, border, inside, black - border, -f64::from(sample.light));
        facets[index].products += row * row.transpose();
        facets[index].count += 1;
    }
    let mut score = Score::default();
    let (mut sum, mut weights) = (0.0, 0.0);
    for facet in facets.iter().filter(|facet| facet.count >= MIN_SAMPLES) {
        let Some((correlation, worth)) = facet.partial_correlation() else { continue };
        let independent = f64::from(facet.count) / samples_per_pixel;
        let squared = correlation.abs().min(MOST).powi(2);
        score.log_ratio -= 0.5 * independent * (1.0 - squared).ln() * correlation.signum();
        score.facets += 1;
        score.agreeing_facets += u32::from(correlation >= AGREEING);
        let weight = worth.sqrt();
        sum += weight * correlation;
        weights += weight;
    }
    score.correlation = if weights > 0.0 { sum / weights } else { 0.0 };
    score
}

impl Facet {
    /// The partial correlation of light and cells, and how much of the cells' pattern the facet
    /// shows (its sum of squares). `None` where the blur leaves nothing of it.
    fn partial_correlation(&self) -> Option<(f64, f64)> {
        // The Schur complement of what is regressed out, one column after the other.
        let mut left: Matrix5<f64> = self.products;
        for k in 0..3 {
            let pivot = left[(k, k)];
            if pivot < 1e-9 * self.products[(k, k)].max(1e-12) {
                continue;
            }
            let column = left.column(k).into_owned();
            left -= column * column.transpose() / pivot;
        }
        let (cells, light) = (left[(3, 3)], left[(4, 4)]);
        let is_told = cells > 1e-3 * f64::from(self.count) && light > 0.0;
        is_told.then(|| (left[(3, 4)] / (cells * light).sqrt(), cells))
    }
}
