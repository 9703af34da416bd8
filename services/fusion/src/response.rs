//! The camera's response: from the configuration, or from the print of the bodies that it shows.

use std::collections::BTreeMap;
use std::fmt;

use flockeye_contract::Transfer;
use flockeye_imaging::align::SeenResponse;

/// Standard deviation of the response (see
/// [`Picture::response_sigma`](flockeye_imaging::align::Picture::response_sigma)) that nobody knows.
const UNKNOWN: f64 = 0.6;
/// That of a response that is stated or learned. The bends that bodies show in three flights of sRGB
/// cameras scatter by as much.
const KNOWN: f64 = 0.03;
/// Loss of weight of earlier measurements with each new one: one bad place in the picture must not
/// count for ever.
const FORGETTING: f64 = 0.02;
/// Difference between a used gamma and the seen one, in standard deviations, that is believed.
const BELIEVED_DEVIATIONS: f64 = 2.5;
/// Largest standard deviation of a learned gamma.
const MAX_DEVIATION: f64 = 0.35;
/// The gamma that comes nearest to sRGB.
const SRGB_GAMMA: f64 = 2.2;
/// Distance from sRGB, and from a linear response, within which a camera is taken for one of these.
/// The gammas of three sRGB cameras are seen as 2.2 to 2.4, that of a linear one as 0.9 to 1.0.
const NEAR_SRGB: f64 = 0.4;
const NEAR_LINEAR: f64 = 0.2;
/// Least change of a learned gamma in use, so that the curve does not change with each frame.
const STEP: f64 = 0.1;

/// What is known of the response before the first frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Stated {
    /// All of it: the simulator's, or a measured table.
    Exactly,
    /// The configuration names a curve, whose gamma is about this.
    ByName(f64),
    /// Nothing. sRGB is assumed.
    Nothing,
}

impl Stated {
    /// That of a camera with this response, which the configuration states or the simulator has.
    pub(crate) fn of(response: Transfer, gamma: f32, is_simulated: bool) -> Self {
        match response {
            _ if is_simulated => Self::Exactly,
            Transfer::Table => Self::Exactly,
            Transfer::Srgb => Self::ByName(SRGB_GAMMA),
            Transfer::Linear => Self::ByName(1.0),
            Transfer::Gamma => Self::ByName(f64::from(gamma)),
        }
    }
}

/// A response that differs from the one in use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surprise {
    /// The seen gamma and its standard deviation.
    pub(crate) seen: (f64, f64),
    /// The gamma in use until now.
    pub(crate) used: f64,
    /// The gamma in use from now on; `None` where the configuration states another one, which stays.
    pub(crate) taken: Option<f64>,
}

/// The camera's response from light to code values.
///
/// Each aligned body shows the gamma with which its black cells are as wide as its white ones. Their
/// weighted mean is taken where sRGB was only assumed.
#[derive(Debug, Clone)]
pub(crate) struct ResponseEstimate {
    stated: Stated,
    /// Sum of the seen gammas, weighted by their precision, and sum of the weights.
    sums: (f64, f64),
    /// The learned gamma in use; `None` for the frames' own response.
    taken: Option<f64>,
    /// Seen in the open frame by target, so that the result does not depend on the order.
    pending: BTreeMap<usize, SeenResponse>,
}

impl ResponseEstimate {
    /// The estimate before the first frame.
    pub(crate) fn new(stated: Stated) -> Self {
        Self { stated, sums: (0.0, 0.0), taken: None, pending: BTreeMap::new() }
    }

    /// Standard deviation of the response in pictures.
    pub(crate) fn sigma(&self) -> f64 {
        match (self.stated, self.seen()) {
            (Stated::Exactly, _) => 0.0,
            (Stated::Nothing, None) => UNKNOWN,
            (Stated::ByName(_) | Stated::Nothing, _) => KNOWN,
        }
    }

    /// The learned gamma for views; `None` where the frames' own response is right, as far as is
    /// known.
    pub(crate) fn gamma(&self) -> Option<f64> {
        self.taken
    }

    /// The gamma that the bodies show, and its standard deviation, where it is known well enough.
    fn seen(&self) -> Option<(f64, f64)> {
        let (sum, weight) = self.sums;
        let deviation = weight.sqrt().recip();
        (deviation < MAX_DEVIATION).then(|| (sum / weight, deviation))
    }

    /// Adds what a body shows in the open frame.
    pub(crate) fn note(&mut self, target: usize, seen: SeenResponse) {
        if self.stated != Stated::Exactly {
            self.pending.insert(target, seen);
        }
    }

    /// Ends a frame. Returns what surprises in it, once for each.
    pub(crate) fn end_frame(&mut self) -> Option<Surprise> {
        let used = match self.stated {
            Stated::ByName(gamma) => gamma,
            _ => self.taken.unwrap_or(SRGB_GAMMA),
        };
        for seen in std::mem::take(&mut self.pending).into_values() {
            let weight = 1.0 / seen.variance;
            let (sum, before) = self.sums;
            self.sums =
                ((1.0 - FORGETTING) * sum + weight * seen.gamma, (1.0 - FORGETTING) * before + weight);
        }
        let (gamma, deviation) = self.seen()?;
        let is_far = |from: f64, least: f64| {
            (gamma - from).abs() > least.max(BELIEVED_DEVIATIONS * deviation)
        };
        let is_wrong = match (self.stated, self.taken) {
            (Stated::Exactly, _) => false,
            (Stated::ByName(stated), _) => is_far(stated, NEAR_SRGB),
            (Stated::Nothing, None) => is_far(SRGB_GAMMA, NEAR_SRGB),
            // It was believed before, and only becomes more exact.
            (Stated::Nothing, Some(taken)) => (usual(gamma) - taken).abs() > STEP,
        };
        if self.stated == Stated::Nothing && is_wrong {
            self.taken = Some(usual(gamma)).filter(|gamma| *gamma != SRGB_GAMMA);
        }
        let taken = (self.stated == Stated::Nothing).then(|| self.taken.unwrap_or(SRGB_GAMMA));
        is_wrong.then_some(Surprise { seen: (gamma, deviation), used, taken })
    }

    /// What was learned, for the next process: the two sums, and the gamma in use.
    pub(crate) fn learned(&self) -> (f64, f64, Option<f64>) {
        (self.sums.0, self.sums.1, self.taken)
    }

    /// Continues from what another process has learned.
    pub(crate) fn resume(&mut self, (sum, weight, taken): (f64, f64, Option<f64>)) {
        let is_finite = [Some(sum), Some(weight), taken].into_iter().flatten().all(f64::is_finite);
        if self.stated == Stated::Nothing && is_finite && weight >= 0.0 {
            (self.sums, self.taken) = ((sum, weight), taken);
        }
    }
}

/// The response in use, and where it comes from, for health.
impl fmt::Display for ResponseEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.stated, self.taken, self.seen()) {
            (Stated::Exactly, ..) => write!(f, "response: as the source has it"),
            (Stated::ByName(gamma), ..) => write!(f, "response: gamma {gamma:.1}, configured"),
            (Stated::Nothing, Some(gamma), _) => write!(f, "response: gamma {gamma:.1}, learned"),
            (Stated::Nothing, None, Some(_)) => write!(f, "response: srgb, learned"),
            (Stated::Nothing, None, None) => write!(f, "response: srgb, assumed"),
        }
    }
}

/// The gamma of the response that a camera with this seen gamma probably has.
fn usual(gamma: f64) -> f64 {
    match gamma {
        _ if (gamma - SRGB_GAMMA).abs() < NEAR_SRGB => SRGB_GAMMA,
        _ if (gamma - 1.0).abs() < NEAR_LINEAR => 1.0,
        _ => gamma,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(response: &mut ResponseEstimate, gammas: &[f64], variance: f64) -> Vec<Surprise> {
        let frame = |&gamma: &f64| {
            response.note(0, SeenResponse { gamma, variance });
            response.end_frame()
        };
        gammas.iter().filter_map(frame).collect()
    }

    #[test]
    fn an_assumed_response_gives_way_to_the_one_that_bodies_show() {
        let mut response = ResponseEstimate::new(Stated::Nothing);
        assert_eq!((response.sigma(), response.gamma()), (UNKNOWN, None));
        // As long as sRGB is assumed, a linear camera seems to have a gamma of 1.3.
        let first = shown(&mut response, &[1.3], 0.06);
        assert_eq!((first.len(), response.gamma()), (1, Some(1.3)), "{first:?}");
        let later = shown(&mut response, &[0.95; 5], 0.015);
        assert_eq!((later.len(), response.gamma()), (1, Some(1.0)), "{later:?}");
        assert_eq!(response.sigma(), KNOWN);
        assert!(shown(&mut response, &[0.9, 1.1, 0.95], 0.015).is_empty());
    }

    #[test]
    fn srgb_cameras_and_single_bad_places_change_nothing() {
        let mut response = ResponseEstimate::new(Stated::Nothing);
        assert!(shown(&mut response, &[2.4, 2.3, 2.1, 2.5, 2.2], 0.015).is_empty());
        assert!(shown(&mut response, &[0.8], 0.015).is_empty());
        assert!(shown(&mut response, &[2.3; 20], 0.015).is_empty());
        assert_eq!((response.sigma(), response.gamma()), (KNOWN, None));
        let mut doubtful = ResponseEstimate::new(Stated::Nothing);
        assert!(shown(&mut doubtful, &[1.2, 1.0], 1.0).is_empty());
        assert_eq!(doubtful.sigma(), UNKNOWN);
    }

    #[test]
    fn a_stated_response_stays_and_is_contradicted() {
        let mut response = ResponseEstimate::new(Stated::of(Transfer::Srgb, 0.0, false));
        let surprises = shown(&mut response, &[1.3, 1.2, 1.2], 0.02);
        assert!(!surprises.is_empty() && surprises.iter().all(|it| it.taken.is_none()));
        assert_eq!((response.sigma(), response.gamma()), (KNOWN, None));
        let mut linear = ResponseEstimate::new(Stated::of(Transfer::Linear, 0.0, false));
        assert!(shown(&mut linear, &[0.9, 1.1, 0.95], 0.015).is_empty());
        for exact in [Stated::of(Transfer::Srgb, 0.0, true), Stated::of(Transfer::Table, 0.0, false)] {
            let mut response = ResponseEstimate::new(exact);
            assert!(shown(&mut response, &[1.0; 9], 0.01).is_empty());
            assert_eq!(response.sigma(), 0.0);
        }
    }

    #[test]
    fn a_successor_continues() {
        let mut response = ResponseEstimate::new(Stated::Nothing);
        shown(&mut response, &[1.0; 5], 0.015);
        let mut next = ResponseEstimate::new(Stated::Nothing);
        next.resume(response.learned());
        assert_eq!((next.gamma(), next.sigma()), (Some(1.0), KNOWN));
        let mut other = ResponseEstimate::new(Stated::Nothing);
        other.resume((f64::NAN, 1.0, None));
        other.resume((1.0, 1.0, Some(f64::INFINITY)));
        assert_eq!((other.gamma(), other.sigma()), (None, UNKNOWN));
    }
}
