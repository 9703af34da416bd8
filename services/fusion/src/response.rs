//! The camera's response: from the configuration, or from the print of the bodies that it shows.

use std::collections::BTreeMap;
use std::fmt;

use flockeye_contract::Transfer;
use flockeye_imaging::align::SeenResponse;

/// Standard deviation of the response in pictures (see
/// [`Picture::response_sigma`](flockeye_imaging::align::Picture::response_sigma)) that nobody knows.
/// A linear camera that is taken for sRGB differs by 0.7 to 1.1.
const UNKNOWN: f64 = 0.6;
/// That of a response that is stated or learned. The bends that single bodies show in four flights of
/// sRGB cameras scatter by 0.02 to 0.06 (docs/results/constants.md#response).
const KNOWN: f64 = 0.03;
/// Change of the bend by a relative change of the gamma: 4 (1/2)^g has this slope at g = 1.
const BEND_OF_GAMMA: f64 = 1.4;
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
/// The gammas of four sRGB cameras are seen as 2.2 in the median, that of a linear one as 0.9 to 1.05.
const NEAR_SRGB: f64 = 0.4;
const NEAR_LINEAR: f64 = 0.2;
/// The response in use stays within as many times these distances, so that it does not flip.
const STAYING: f64 = 1.25;
/// Least change of a learned gamma in use, so that the curve does not change with each frame.
const STEP: f64 = 0.1;
/// Gammas of cameras. Others are no learned ones.
const GAMMAS: std::ops::RangeInclusive<f64> = 0.4..=4.0;

/// What is known of the response before the first frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Stated {
    /// All of it: the simulator's, or a measured table.
    Exactly,
    /// The configuration names a curve.
    ByName,
    /// Nothing.
    Nothing,
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
/// weighted mean takes the place of the frames' own response, unless that is stated.
#[derive(Debug, Clone)]
pub(crate) struct ResponseEstimate {
    stated: Stated,
    /// Gamma of the frames' own response, by the headers of views. `None` for a table.
    own: Option<f64>,
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
        let own = Some(SRGB_GAMMA);
        Self { stated, own, sums: (0.0, 0.0), taken: None, pending: BTreeMap::new() }
    }

    /// Standard deviation of the response in a view with this transfer curve.
    pub(crate) fn sigma(&self, transfer: u32, gamma: f32) -> f64 {
        let Some(of_view) = gamma_of(transfer, gamma) else { return 0.0 };
        match (self.stated, self.seen()) {
            (Stated::Exactly, _) => 0.0,
            (Stated::ByName, _) => KNOWN,
            (Stated::Nothing, None) => UNKNOWN,
            (Stated::Nothing, Some((seen, deviation))) => {
                let off = self.usual(seen) - of_view;
                UNKNOWN.min(KNOWN.hypot(BEND_OF_GAMMA * deviation.hypot(off) / of_view))
            }
        }
    }

    /// Records the transfer curve of a view. It is the frames' own, or the learned one.
    pub(crate) fn note_view(&mut self, transfer: u32, gamma: f32) {
        let of_view = gamma_of(transfer, gamma);
        let is_learned =
            of_view.zip(self.taken).is_some_and(|(of_view, taken)| (of_view - taken).abs() < 1e-3);
        if !is_learned {
            self.own = of_view;
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

    /// The gamma of the response that a camera with this seen gamma probably has.
    fn usual(&self, seen: f64) -> f64 {
        let used = self.taken.or(self.own);
        let is_near = |usual: f64, near: f64| {
            let share = if used == Some(usual) { STAYING } else { 1.0 };
            (seen - usual).abs() < share * near
        };
        match seen {
            _ if is_near(SRGB_GAMMA, NEAR_SRGB) => SRGB_GAMMA,
            _ if is_near(1.0, NEAR_LINEAR) => 1.0,
            _ => seen,
        }
    }

    /// Adds what a body shows in the open frame.
    pub(crate) fn note(&mut self, target: usize, seen: SeenResponse) {
        if self.stated != Stated::Exactly && seen.variance > 0.0 {
            self.pending.insert(target, seen);
        }
    }

    /// Ends a frame. Returns what surprises in it.
    pub(crate) fn end_frame(&mut self) -> Option<Surprise> {
        let pending = std::mem::take(&mut self.pending);
        // A table is measured, and is better than one number.
        let own = self.own.filter(|_| !pending.is_empty())?;
        for seen in pending.into_values() {
            let weight = 1.0 / seen.variance;
            let of_earlier = |sum: f64| (1.0 - FORGETTING) * sum;
            self.sums =
                (of_earlier(self.sums.0) + weight * seen.gamma, of_earlier(self.sums.1) + weight);
        }
        let (seen, deviation) = self.seen()?;
        let usual = self.usual(seen);
        let is_wrong = match self.taken {
            None => {
                let least = NEAR_LINEAR.max(BELIEVED_DEVIATIONS * deviation);
                usual != own && (seen - own).abs() > least
            }
            // It was believed before, and only becomes more exact.
            Some(taken) => (usual - taken).abs() > STEP,
        };
        let is_other = is_wrong && GAMMAS.contains(&usual);
        let used = self.taken.unwrap_or(own);
        if is_other && self.stated == Stated::Nothing {
            self.taken = Some(usual).filter(|usual| *usual != own);
        }
        let taken = (self.stated == Stated::Nothing).then_some(usual);
        is_other.then_some(Surprise { seen: (seen, deviation), used, taken })
    }

    /// What was learned, for the next process: the two sums, and the gamma in use.
    pub(crate) fn learned(&self) -> (f64, f64, Option<f64>) {
        (self.sums.0, self.sums.1, self.taken)
    }

    /// Continues from what another process has learned.
    pub(crate) fn resume(&mut self, (sum, weight, taken): (f64, f64, Option<f64>)) {
        let is_sound = sum.is_finite() && weight.is_finite() && weight >= 0.0;
        if self.stated == Stated::Nothing && is_sound && taken.is_none_or(|it| GAMMAS.contains(&it))
        {
            (self.sums, self.taken) = ((sum, weight), taken);
        }
    }
}

/// Gamma of a transfer curve, or the nearest one. `None` for a table.
fn gamma_of(transfer: u32, gamma: f32) -> Option<f64> {
    match Transfer::try_from(transfer).ok()? {
        Transfer::Srgb => Some(SRGB_GAMMA),
        Transfer::Linear => Some(1.0),
        Transfer::Gamma => Some(f64::from(gamma)),
        Transfer::Table => None,
    }
}

/// The response in use, and where it comes from, for health.
impl fmt::Display for ResponseEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let from = match (self.stated, self.seen()) {
            (Stated::Exactly, _) => "as the source has it",
            (Stated::ByName, _) => "configured",
            (Stated::Nothing, Some(_)) => "learned",
            (Stated::Nothing, None) => "assumed",
        };
        match self.taken.or(self.own) {
            Some(SRGB_GAMMA) => write!(f, "response: srgb, {from}"),
            Some(gamma) => write!(f, "response: gamma {gamma:.1}, {from}"),
            None => write!(f, "response: table, {from}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SRGB: (u32, f32) = (Transfer::Srgb.code(), 0.0);

    fn estimate(stated: Stated) -> ResponseEstimate {
        ResponseEstimate::new(stated)
    }

    fn shown(response: &mut ResponseEstimate, gammas: &[f64], variance: f64) -> Vec<Surprise> {
        let frame = |&gamma: &f64| {
            response.note(0, SeenResponse { gamma, variance });
            response.end_frame()
        };
        gammas.iter().filter_map(frame).collect()
    }

    /// Sigma of a view with this gamma.
    fn sigma(response: &ResponseEstimate, gamma: f32) -> f64 {
        response.sigma(Transfer::Gamma.code(), gamma)
    }

    #[test]
    fn an_assumed_response_gives_way_to_the_one_that_bodies_show() {
        let mut response = estimate(Stated::Nothing);
        assert_eq!((sigma(&response, 2.2), response.gamma()), (UNKNOWN, None));
        assert_eq!(response.to_string(), "response: srgb, assumed");
        // As long as sRGB is assumed, a linear camera seems to have a gamma of 1.3.
        let first = shown(&mut response, &[1.3], 0.06);
        assert_eq!((first.len(), response.gamma()), (1, Some(1.3)), "{first:?}");
        assert!(sigma(&response, 1.3) > 0.2, "it is hardly known yet");
        let later = shown(&mut response, &[0.95; 5], 0.015);
        assert_eq!((later.len(), response.gamma()), (1, Some(1.0)), "{later:?}");
        assert!(shown(&mut response, &[0.9, 1.1, 0.95], 0.015).is_empty());
        assert_eq!(response.to_string(), "response: gamma 1.0, learned");
        // Views that still have the old curve are not taken for certain.
        assert!(sigma(&response, 1.0) < 0.1 && response.sigma(SRGB.0, SRGB.1) == UNKNOWN);
    }

    #[test]
    fn srgb_cameras_and_single_bad_places_change_nothing() {
        let mut response = estimate(Stated::Nothing);
        assert!(shown(&mut response, &[2.4, 2.3, 2.1, 2.5, 2.2], 0.015).is_empty());
        assert!(shown(&mut response, &[0.8], 0.015).is_empty());
        assert!(shown(&mut response, &[2.3; 20], 0.015).is_empty());
        assert_eq!(response.gamma(), None);
        assert!(response.sigma(SRGB.0, SRGB.1) < 2.0 * KNOWN);
        assert_eq!(response.to_string(), "response: srgb, learned");
        let mut doubtful = estimate(Stated::Nothing);
        assert!(shown(&mut doubtful, &[1.2, 1.0], 1.0).is_empty());
        assert_eq!(sigma(&doubtful, 2.2), UNKNOWN);
    }

    #[test]
    fn a_gamma_at_the_edge_does_not_flip() {
        for edge in [1.2, 1.8] {
            let mut response = estimate(Stated::Nothing);
            shown(&mut response, &[edge; 50], 0.01);
            let around: Vec<f64> =
                (0..50).map(|k| edge + 0.03 * f64::from(k % 2 * 2 - 1)).collect();
            assert!(shown(&mut response, &around, 0.01).len() <= 1, "{edge}");
        }
    }

    #[test]
    fn a_stated_response_stays_and_is_contradicted_where_bodies_are_seen() {
        let mut response = estimate(Stated::ByName);
        let surprises = shown(&mut response, &[1.3, 1.2, 1.2], 0.02);
        assert!(!surprises.is_empty() && surprises.iter().all(|it| it.taken.is_none()));
        assert_eq!((sigma(&response, 2.2), response.gamma()), (KNOWN, None));
        assert_eq!(response.end_frame(), None, "nothing is seen in this frame");
        let mut linear = estimate(Stated::ByName);
        linear.note_view(Transfer::Linear.code(), 0.0);
        assert!(shown(&mut linear, &[0.9, 1.1, 0.95], 0.015).is_empty());
        let mut exact = estimate(Stated::Exactly);
        assert!(shown(&mut exact, &[1.0; 9], 0.01).is_empty());
        assert_eq!(sigma(&exact, 2.2), 0.0);
    }

    #[test]
    fn what_frames_say_of_themselves_counts() {
        let mut linear = estimate(Stated::Nothing);
        linear.note_view(Transfer::Linear.code(), 0.0);
        assert!(shown(&mut linear, &[1.0; 5], 0.015).is_empty());
        assert_eq!(linear.gamma(), None);
        // They say so wrongly.
        assert_eq!(shown(&mut linear, &[2.3; 60], 0.01).first().map(|it| it.used), Some(1.0));
        assert_eq!(linear.gamma(), Some(SRGB_GAMMA));
        let mut table = estimate(Stated::Nothing);
        table.note_view(Transfer::Table.code(), 0.0);
        assert!(shown(&mut table, &[1.0; 5], 0.015).is_empty());
        assert_eq!((table.gamma(), table.sigma(Transfer::Table.code(), 0.0)), (None, 0.0));
    }

    #[test]
    fn a_successor_continues() {
        let mut response = estimate(Stated::Nothing);
        shown(&mut response, &[1.0; 5], 0.015);
        let mut next = estimate(Stated::Nothing);
        next.resume(response.learned());
        assert_eq!(next.gamma(), Some(1.0));
        assert_eq!(sigma(&next, 1.0), sigma(&response, 1.0));
        let mut other = estimate(Stated::Nothing);
        other.resume((f64::NAN, 1.0, None));
        other.resume((1.0, 1.0, Some(0.0)));
        assert_eq!((other.gamma(), sigma(&other, 2.2)), (None, UNKNOWN));
    }
}
