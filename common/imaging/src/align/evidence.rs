//! The evidence in the image for an aligned body, without decisions.
//!
//! All markers have a white margin and a black border, so a wrong body that is aligned with the
//! right one's borders correlates with 0.7 of the image. Only the cells within the border
//! distinguish markers. So margin, border and the mean of the cells are regressed out. The rest of
//! the image is correlated with the rest of the cells' pattern, facet by facet. This is a partial
//! correlation.
//!
//! # Log odds
//!
//! Two explanations compete for each facet. With the body there, its radiance is that of white
//! paper, reduced by print. Something else may have any margin, border and mean, and the rest is
//! noise. Both leave residuals of unknown variance, so with n independent values the log of their
//! likelihood ratio is n/2 ln(q), with q the ratio of the sums of squares. A facet may also be
//! hidden. So a facet without its pattern in the picture counts against the body only up to a
//! limit.
//!
//! A marker has as many values as cells, and they are not independent: textures are smooth, and
//! alignment has chosen the pose that fits best. The number of independent values comes from a
//! curve ([`INDEPENDENT_SHARE`]).

use nalgebra::{Matrix5, Vector5};

use super::model::Scene;
use super::patch::Patch;
use super::print::{BodyPrint, PrintedFacet};
use super::samples::Sample;
use super::state::State;

/// Least coverage of a compared pixel by its facet: two blurs inside its edges.
const MIN_COVERAGE: f32 = 0.977;
/// Least variance of the cells' pattern per pixel after the blur, with black as 1.
const MIN_PATTERN: f64 = 1e-3;

/// Least share of white paper's radiance that print removes. Black print reflects a twentieth of
/// the light. Stray light or a wrong tone curve may add several times as much.
const MIN_PRINT_CONTRAST: f64 = 0.5;
/// Largest share that print removes: a fit may give less than zero radiance to black.
const MAX_PRINT_CONTRAST: f64 = 1.1;
/// Error even of a right model, share of white: light changes along a facet.
const MODEL_ERROR: f64 = 0.03;
/// Prior probability that a facet of a body is hidden, so that its pixels contain no information.
const HIDDEN: f64 = 0.1;
/// Independent values for each cell of a marker.
///
/// It comes from pictures without bodies (docs/results/constants.md#evidence). Of 17,203 poses that
/// alignment found there, the number above x fell by e for each 5.3 of the log odds with one value
/// for each cell. With this share it falls as e^-x.
const INDEPENDENT_SHARE: f64 = 0.19;

/// Agreement with the image of the cells on the facets that face the camera.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Evidence {
    /// Mean normalized correlation of the cells with the image over the facets, weighted by the
    /// visible part of each facet's pattern.
    pub correlation: f64,
    /// Log of the likelihood ratio of the body against something else, summed over facets.
    pub log_odds: f64,
    /// Part of the log odds from the facets other than the most informative one. Two poses that are
    /// mirror images by that facet differ in this.
    pub log_odds_of_others: f64,
    /// Number of facets with positive log odds.
    pub agreeing_facets: u32,
    /// The facet with the largest log odds, if any are positive.
    pub most_informative_facet: Option<u32>,
}

impl Evidence {
    /// Sums up the facets, in their order; `None` stands for a facet that was not compared.
    fn of_facets(facets: &[Option<FacetFit>]) -> Self {
        let mut evidence = Self::default();
        let (mut sum, mut weights, mut most) = (0.0, 0.0, 0.0);
        for (number, facet) in (0..).zip(facets) {
            let Some(FacetFit { correlation, pattern, log_odds }) = *facet else { continue };
            evidence.agreeing_facets += u32::from(log_odds > 0.0);
            let log_odds = (HIDDEN + (1.0 - HIDDEN) * log_odds.exp()).ln();
            evidence.log_odds += log_odds;
            if log_odds > most {
                (most, evidence.most_informative_facet) = (log_odds, Some(number));
            }
            let weight = pattern.sqrt();
            sum += weight * correlation;
            weights += weight;
        }
        evidence.log_odds_of_others = evidence.log_odds - most;
        evidence.correlation = if weights > 0.0 { sum / weights } else { 0.0 };
        evidence
    }
}

/// The correlation of one facet with the image.
#[derive(Debug, Clone, Copy)]
struct FacetFit {
    correlation: f64,
    /// Visible part of the cells' pattern: its sum of squares.
    pattern: f64,
    /// Log of the likelihood ratio of the visible facet against something else.
    log_odds: f64,
}

/// Sums over pixels of the products of 1, border, inside, cells and radiance with each other.
#[derive(Default, Clone)]
struct Products {
    matrix: Matrix5<f64>,
    count: u32,
}

/// Compares a state with `samples` of all facets, of which `samples_per_pixel` count as one.
///
/// Returns the evidence, and for each facet whether something else explains it better. That follows
/// from pixels that show the facet alone, and is used for occlusion: they are less affected by an
/// occluder's soft edge. When a correlation decided, a post's soft edges moved bodies at 2 m by
/// 1.3 mm on average with all pixels, and by 1.1 mm with these.
pub(super) fn compare(
    patch: &Patch,
    print: &BodyPrint,
    state: &State,
    samples: &[Sample],
    samples_per_pixel: f64,
) -> (Evidence, Vec<bool>) {
    let scene = Scene::new(print, state, patch);
    // Sums over pixels with little beside the facet, and over those with the facet alone.
    let mut covered = vec![Products::default(); print.facets.len()];
    let mut inside = covered.clone();
    for sample in samples {
        let index = usize::from(sample.facet);
        if print.facets[index].cells.is_none() {
            continue;
        }
        let Some((visible, blurred)) = scene.facet(usize::from(sample.half), index) else {
            continue;
        };
        let at = visible.point(&sample.direction(patch));
        let is_inside = sample.is_inside();
        if !is_inside && blurred.coverage(at).value < MIN_COVERAGE {
            continue;
        }
        let black = f64::from(blurred.black(at).value);
        let [square, inner] = blurred.squares(at).map(f64::from);
        let levels = state.levels[index];
        let [black, border] =
            [black, square - inner].map(|black| seen_black(black, levels, patch.saturation));
        // Black lowers the radiance.
        let darkness = -f64::from(sample.radiance);
        let row = Vector5::new(1.0, border, inner, black - border, darkness);
        let products = row * row.transpose();
        covered[index].add(&products);
        if is_inside {
            inside[index].add(&products);
        }
    }
    let fit =
        |(pixels, printed): (&Products, &PrintedFacet)| pixels.fit(printed, samples_per_pixel);
    let fits: Vec<_> = covered.iter().zip(&print.facets).map(fit).collect();
    let disagrees = |fit: Option<FacetFit>| fit.is_some_and(|fit| fit.log_odds < 0.0);
    let disagreeing = inside.iter().zip(&print.facets).map(fit).map(disagrees).collect();
    (Evidence::of_facets(&fits), disagreeing)
}

/// Apparent black of a pixel with the share `black`, where white paper with this level saturates
/// the sensor. Then white has grown over the edges of black.
fn seen_black(black: f64, [white_level, black_level]: [f64; 2], saturation: f64) -> f64 {
    if white_level <= saturation || black_level >= saturation {
        return black;
    }
    let radiance = white_level - (white_level - black_level) * black;
    (saturation - radiance.min(saturation)) / (saturation - black_level)
}

impl Products {
    fn add(&mut self, products: &Matrix5<f64>) {
        self.matrix += products;
        self.count += 1;
    }

    /// Fit of the print to these pixels of a facet. `None` where they are too few, the blur leaves
    /// no pattern, or the radiance is nowhere above 0.
    fn fit(&self, printed: &PrintedFacet, samples_per_pixel: f64) -> Option<FacetFit> {
        // Any model explains this few pixels.
        if self.count as usize <= self.matrix.nrows() {
            return None;
        }
        let left = self.without_border();
        let (pattern, unexplained) = (left[(3, 3)], left[(4, 4)]);
        if pattern <= MIN_PATTERN * f64::from(self.count) || unexplained <= 0.0 {
            return None;
        }
        let pixels = f64::from(self.count) / samples_per_pixel;
        let inner = printed.cells.as_ref().map_or(0, |cells| cells.count.saturating_sub(2));
        let independent = INDEPENDENT_SHARE * pixels.min(inner.pow(2) as f64);
        Some(FacetFit {
            correlation: left[(3, 4)] / (pattern * unexplained).sqrt(),
            pattern,
            log_odds: self.log_odds(independent, unexplained)?,
        })
    }

    /// The Schur complement of margin, border and the cells' mean, which are regressed out.
    fn without_border(&self) -> Matrix5<f64> {
        let mut left: Matrix5<f64> = self.matrix;
        for k in 0..3 {
            let pivot = left[(k, k)];
            if pivot < 1e-9 * self.matrix[(k, k)].max(1e-12) {
                continue;
            }
            let column = left.column(k).into_owned();
            left -= column * column.transpose() / pivot;
        }
        left
    }

    /// Log of the likelihood ratio of the print against something else with the same border and
    /// mean. `independent` is the number of independent values, `unexplained` the sum of squares
    /// left by something else.
    ///
    /// Both leave residuals of unknown variance, so the ratio is that of their sums of squares.
    /// `None` where the radiance is nowhere above 0.
    fn log_odds(&self, independent: f64, unexplained: f64) -> Option<f64> {
        let count = f64::from(self.count);
        let m = &self.matrix;
        // Radiance is white (1 - contrast black). Sums over black and radiance.
        let black = m[(0, 1)] + m[(0, 3)];
        let black_square = m[(1, 1)] + 2.0 * m[(1, 3)] + m[(3, 3)];
        let radiance = -m[(0, 4)];
        let black_radiance = -(m[(1, 4)] + m[(3, 4)]);
        let square = m[(4, 4)];
        let determinant = count * black_square - black * black;
        let slope = (count * black_radiance - black * radiance) / determinant.max(1e-12);
        let white = (radiance - slope * black) / count;
        let free = if white > 0.0 { -slope / white } else { 0.0 };
        let contrast = free.clamp(MIN_PRINT_CONTRAST, MAX_PRINT_CONTRAST);
        let shape = radiance - contrast * black_radiance;
        let shape_square = count - 2.0 * contrast * black + contrast * contrast * black_square;
        let white = shape / shape_square;
        if white <= 0.0 {
            return None;
        }
        let floor = (MODEL_ERROR * white).powi(2);
        let print = (square - white * shape).max(0.0) / count + floor;
        let other = unexplained / count + floor;
        Some(independent / 2.0 * (other / print).ln())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn black_shrinks_where_white_saturates() {
        assert_eq!(seen_black(0.3, [0.8, 0.1], 1.0), 0.3, "nothing saturates");
        let seen = |black| seen_black(black, [4.0, 0.4], 1.0);
        assert_eq!((seen(0.0), seen(0.5)), (0.0, 0.0));
        assert!((seen(1.0) - 1.0).abs() < 1e-12);
        assert!(seen(0.9) > 0.3 && seen(0.9) < 0.5, "{}", seen(0.9));
    }

    #[test]
    fn facets_are_summed_up() {
        let facet = |correlation, log_odds| Some(FacetFit { correlation, pattern: 1.0, log_odds });
        let facets = [facet(0.9, 8.0), None, facet(0.9, 3.0), facet(0.65, 4.0), facet(-0.2, -50.0)];
        let evidence = Evidence::of_facets(&facets);
        assert_eq!(evidence.agreeing_facets, 3);
        assert_eq!(evidence.most_informative_facet, Some(0));
        assert!((evidence.correlation - (0.9 + 0.9 + 0.65 - 0.2) / 4.0).abs() < 1e-12);
        // The last one may be hidden, and counts no more than that.
        let hidden = HIDDEN.ln();
        assert!((evidence.log_odds - (15.0 + hidden)).abs() < 0.4, "{evidence:?}");
        assert!((evidence.log_odds_of_others - (7.0 + hidden)).abs() < 0.4, "{evidence:?}");
    }

    /// Pixels of a facet of 7 x 7 cells whose inner ones are as `is_black` says, with a radiance.
    fn products(
        is_black: impl Fn(usize) -> bool,
        radiance: impl Fn(bool, usize) -> f64,
    ) -> Products {
        let mut products = Products::default();
        for pixel in 0..49 * 4 {
            let (row, column) = (pixel / 4 / 7, pixel / 4 % 7);
            let is_inside = (1..6).contains(&row) && (1..6).contains(&column);
            let black = !is_inside || is_black(row * 7 + column);
            let border = f64::from(u8::from(!is_inside));
            let inside = f64::from(u8::from(is_inside));
            let cells = f64::from(u8::from(black)) - border;
            let row = Vector5::new(1.0, border, inside, cells, -radiance(black, pixel));
            products.add(&(row * row.transpose()));
        }
        products
    }

    #[test]
    fn print_of_any_light_speaks_for_the_body_and_other_patterns_against_it() {
        let pattern = |cell: usize| cell * 7 % 5 < 2;
        let log_odds =
            |products: Products| products.log_odds(5.0, products.without_border()[(4, 4)].max(0.0));
        for white in [0.02, 0.3, 0.9, 4.0] {
            let print = |black: bool, pixel: usize| {
                let noise = 0.02 * ((pixel * 37 % 11) as f64 / 5.0 - 1.0);
                white * (if black { 0.1 } else { 1.0 } + noise)
            };
            let right = log_odds(products(pattern, print)).unwrap();
            assert!(right > 6.0, "{white}: {right}");
            let other =
                products(|cell| cell * 11 % 3 == 0, |_, pixel| print(pattern(pixel / 4), pixel));
            let other = log_odds(other).unwrap();
            assert!(other < -0.3, "{white}: {other}");
        }
        // A grey square has no pattern, so none of the marker's either.
        let grey = products(pattern, |_, pixel| 0.3 + 1e-3 * (pixel % 3) as f64);
        assert!(log_odds(grey).unwrap() < -3.0);
        assert_eq!(log_odds(products(pattern, |_, _| 0.0)), None);
    }
}
