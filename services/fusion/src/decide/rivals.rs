//! The rivals of a pose: other poses that would be false if it is true.

use flockeye_geometry::pose::is_false;

use super::competitors;
use crate::hypothesis::Hypothesis;

/// Hypotheses that may be rivals (`is_rival`) and would be false if `best` is true, the likeliest
/// first, with their log odds less its own. Starts that led to the same pose are one rival: the
/// likeliest of them counts.
pub(super) fn rivals_of(
    tried: &[Hypothesis],
    best: usize,
    is_rival: impl Fn(&Hypothesis) -> bool,
) -> Vec<(usize, f64)> {
    let most = tried.get(best).and_then(Hypothesis::log_odds).unwrap_or_default();
    let is_same = |one: usize, other: usize| is_same(&tried[one], &tried[other]);
    let mut rivals: Vec<(usize, f64)> = competitors(tried)
        .filter(|(other, _)| *other != best && !is_same(best, *other))
        .filter(|(other, _)| is_rival(&tried[*other]))
        .map(|(other, log_odds)| (other, log_odds - most))
        .collect();
    rivals.sort_by(|(_, one), (_, other)| other.total_cmp(one));
    let mut distinct: Vec<(usize, f64)> = Vec::new();
    for rival in rivals {
        if !distinct.iter().any(|(other, _)| is_same(*other, rival.0)) {
            distinct.push(rival);
        }
    }
    distinct
}

/// Whether two poses are equivalent: neither is false if the other one is true.
fn is_same(one: &Hypothesis, other: &Hypothesis) -> bool {
    one.alignment()
        .zip(other.alignment())
        .is_some_and(|(one, other)| !is_false(&one.camera_from_markers, &other.camera_from_markers))
}
