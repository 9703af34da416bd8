//! Whether what was aligned is the body at all.
//!
//! All markers have a white margin and a black border, and a wrong body aligned with the right one's
//! borders agrees with 0.7 of its light. What tells markers apart are the cells within the border.
//! So margin, border and the mean of the cells are regressed out, and what is left of the image is
//! correlated with what is left of the cells' own pattern, facet by facet (a partial correlation).

use nalgebra::Matrix5;

use super::patch::Patch;
use super::print::{BodyPrint, PrintedFacet};
use super::samples::Sample;
use super::solve::Scene;
use super::unknowns::State;

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
    /// The number of the one that adds most to the logarithm, if any adds to it.
    pub foremost_facet: Option<u32>,
    /// Facets that tell by themselves that they are there: see [`Score::is_told_twice`].
    pub telling_facets: u32,
}

impl Score {
    /// Whether the body is there: the fewer the facets' cells agree on average (something hides part of
    /// it, say), the more they must say in all.
    pub fn is_accepted(&self) -> bool {
        // One facet far away is a handful of pixels, and may be anything chequered.
        let is_seen_twice = self.agreeing_facets >= 2 || self.log_ratio > ONE_FACET_LOG_RATIO;
        is_seen_twice && self.exceeds(&ACCEPTED)
    }

    /// Whether the body is there, of which it is known from the frames before that it must be about
    /// there: then a single small facet that agrees very well says enough, or one of a body whose
    /// others are hidden.
    pub fn confirms(&self) -> bool {
        self.is_accepted() || self.exceeds(&CONFIRMING)
    }

    /// Whether the body is there, of which a marker was decoded where it would be: something may hide
    /// most of it, but a second facet must say that it is not that marker's mirror image.
    pub fn supports_marker(&self) -> bool {
        self.agreeing_facets >= 2 && self.exceeds(&BESIDE_MARKER)
    }

    /// Whether two facets say that the body is there, and in this attitude, or three agree: one can look
    /// the same in two attitudes, and a second one of a few pixels, or half agreeing, agrees by chance
    /// with any.
    pub fn is_told_twice(&self) -> bool {
        self.telling_facets >= 2 || self.agreeing_facets >= SURE_FACETS
    }

    /// How much is said for a pose, to compare it with others of the same body in the same picture: what
    /// its facets say, by how well they agree. The logarithm alone leaves out what a pose shows and the
    /// picture does not, which something may hide, or which is not there: of a mirror image one facet
    /// agrees as well as in the right attitude, and the others do not.
    pub fn evidence(&self) -> f64 {
        self.log_ratio.max(0.0) * self.correlation.max(0.0)
    }

    fn exceeds(&self, limits: &[(f64, f64)]) -> bool {
        limits.iter().any(|&(correlation, log_ratio)| {
            self.correlation > correlation && self.log_ratio > log_ratio
        })
    }
}

/// Least mean correlation with least logarithm of the likelihood ratio. Of 4776 wrong bodies that were aligned
/// where the right one is, on two simulated flights at 0.6 to 4 m, those near by reach 0.25 with 39, those
/// beyond 2.5 m 0.48 with 18 and 0.7 with 9. Right ones that are believed by it have 30 and more.
const ACCEPTED: [(f64, f64); 3] = [(0.7, 20.0), (0.47, 30.0), (0.27, 200.0)];

/// The same where the body is expected; none of those wrong bodies has as much.
const CONFIRMING: [(f64, f64); 2] = [(0.8, 25.0), (0.15, 150.0)];

/// The same beside a decoded marker.
const BESIDE_MARKER: [(f64, f64); 1] = [(0.15, 50.0)];

/// What a single facet must say.
const ONE_FACET_LOG_RATIO: f64 = 100.0;

/// A pose that so many facets agree with is no mirror image: one facet and the chance agreement of
/// another were seen to say 33 degrees too much.
pub const SURE_FACETS: u32 = 3;
/// Correlation and logarithm of a facet that tells by itself. In 5913 views of simulated bodies at 0.8 to
/// 3.6 m, looked at without a track, wrong attitudes that two facets agreed with had a second one of less
/// in 255 of 257 cases; right ones had as much in 325 of 420 (by pixels that show nothing else alone).
const TELLING: (f64, f64) = (0.8, 30.0);

/// Of a facet with fewer samples that show nothing else, all are compared that show so much of it: two
/// deviations of the point spread inside its edges instead of three. Those leave 5 of a facet's 11 px at
/// 3.5 m, too few to be compared at all; near by what is before a facet begins at its edges. Whether a
/// facet is hidden is asked of those that show nothing else only: with all, a post's soft edges moved
/// bodies at 2 m by 1.3 mm in the mean instead of 1.1.
const ENOUGH_SAMPLES: u32 = 64;
const WITHIN: f32 = 0.977;
/// Facets with fewer samples are not compared.
const MIN_SAMPLES: u32 = 16;
/// Correlation of a facet that agrees.
const AGREEING: f64 = 0.6;
/// Correlations are capped: no picture is worth more.
const MOST: f64 = 0.995;

/// A facet's pixels.
#[derive(Default, Clone)]
struct Compared {
    /// Those that show nothing else.
    inside: Facet,
    /// All that show hardly anything else.
    within: Facet,
}

/// Products of ones, border, inside and cells with each other and with the light.
#[derive(Default, Clone)]
struct Facet {
    products: Matrix5<f64>,
    count: u32,
}

/// A score, and what each facet adds to it.
#[derive(Debug)]
pub(super) struct Verdict {
    pub score: Score,
    /// Each facet's own correlation, of pixels that show nothing else, where there are enough.
    correlations: Vec<Option<f64>>,
}

impl Verdict {
    /// Judges a state by `samples` of all facets; `samples_per_pixel` of them count as one.
    pub fn new(
        patch: &Patch,
        print: &BodyPrint,
        state: &State,
        samples: &[Sample],
        samples_per_pixel: f64,
    ) -> Self {
        let scene = Scene::new(print, state, patch, 0.0);
        let mut facets = vec![Compared::default(); print.facets.len()];
        for sample in samples {
            let index = usize::from(sample.facet);
            if print.facets[index].cells.is_none() {
                continue;
            }
            let Some((seen, blurred)) = scene.facet(index) else { continue };
            let at = seen.seen(&sample.direction(patch));
            let is_inside = sample.is_inside();
            if !is_inside && blurred.coverage(at).value < WITHIN {
                continue;
            }
            let parts = blurred.parts(at);
            let [black, square, inside] = [parts.black, parts.square, parts.inside].map(f64::from);
            let border = square - inside;
            let light = -f64::from(sample.light);
            let row = nalgebra::Vector5::new(1.0, border, inside, black - border, light);
            let products = row * row.transpose();
            facets[index].within.add(&products);
            if is_inside {
                facets[index].inside.add(&products);
            }
        }
        let mut score = Score::default();
        let (mut sum, mut weights, mut most) = (0.0, 0.0, 0.0);
        let mut correlations = vec![None; facets.len()];
        for ((number, facet), own) in (0..).zip(&facets).zip(&mut correlations) {
            *own = facet.inside.partial_correlation().map(|(correlation, _)| correlation);
            let facet = facet.best();
            let Some((correlation, worth)) = facet.partial_correlation() else { continue };
            let independent = f64::from(facet.count) / samples_per_pixel;
            let squared = correlation.abs().min(MOST).powi(2);
            let says = -0.5 * independent * (1.0 - squared).ln() * correlation.signum();
            score.log_ratio += says;
            if says > most {
                (most, score.foremost_facet) = (says, Some(number));
            }
            score.facets += 1;
            score.agreeing_facets += u32::from(correlation >= AGREEING);
            score.telling_facets += u32::from(correlation >= TELLING.0 && says >= TELLING.1);
            let weight = worth.sqrt();
            sum += weight * correlation;
            weights += weight;
        }
        score.correlation = if weights > 0.0 { sum / weights } else { 0.0 };
        Self { score, correlations }
    }

    /// Facets that something hides, if others say that the body is there: those that do not agree,
    /// and blank ones next to them. `None` if that is all or nothing.
    pub fn hidden(&self, print: &BodyPrint) -> Option<Vec<bool>> {
        let disagrees = |facet: usize| self.correlations[facet].is_some_and(|own| own < AGREEING);
        let is_hidden = |(index, facet): (usize, &PrintedFacet)| {
            let mut beside = facet.neighbours.iter().flatten();
            disagrees(index)
                || (facet.cells.is_none() && beside.any(|&(neighbour, _)| disagrees(neighbour)))
        };
        let hidden: Vec<bool> = print.facets.iter().enumerate().map(is_hidden).collect();
        (self.score.agreeing_facets > 0 && hidden.contains(&true)).then_some(hidden)
    }
}

impl Compared {
    /// Those that show nothing else, if they are enough.
    fn best(&self) -> &Facet {
        if self.inside.count >= ENOUGH_SAMPLES { &self.inside } else { &self.within }
    }
}

impl Facet {
    fn add(&mut self, products: &Matrix5<f64>) {
        self.products += products;
        self.count += 1;
    }

    /// The partial correlation of light and cells, and how much of the cells' pattern the facet
    /// shows (its sum of squares). `None` where there are few pixels, or the blur leaves nothing of it.
    fn partial_correlation(&self) -> Option<(f64, f64)> {
        if self.count < MIN_SAMPLES {
            return None;
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn score(correlation: f64, log_ratio: f64, agreeing_facets: u32, telling_facets: u32) -> Score {
        Score { correlation, log_ratio, agreeing_facets, telling_facets, ..Score::default() }
    }

    #[test]
    fn two_facets_tell_a_pose_if_both_tell_by_themselves_and_three_do() {
        assert!(score(0.5, 140.0, 2, 2).is_told_twice());
        assert!(!score(0.5, 140.0, 2, 1).is_told_twice());
        assert!(!score(0.9, 500.0, 1, 1).is_told_twice());
        assert!(score(0.8, 90.0, 3, 1).is_told_twice());
    }

    #[test]
    fn what_a_pose_shows_and_the_picture_does_not_counts_against_it() {
        // Of one picture: the right attitude, and the mirror image of the facet that says most.
        let [right, mirrored] = [score(0.68, 210.0, 3, 2), score(0.29, 215.0, 2, 1)];
        assert!(right.is_accepted() && mirrored.is_accepted());
        assert!(right.evidence() > 2.0 * mirrored.evidence());
        assert_eq!(score(-0.2, -20.0, 0, 0).evidence(), 0.0);
    }
}
