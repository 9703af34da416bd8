//! The order in which the sphere is searched for newcomers.

use super::{Purpose, Searched};

/// Partitions (their numbers) by when they were last searched: never, then longest ago; ties by
/// number. `far` are views that show the sphere at a higher resolution, for who is far: one of each
/// kind in turn, so that all of both are searched within bounded numbers of frames, however few views
/// a frame has time for. Only those of `near` that were never searched go before all others.
pub fn least_recently_searched(
    searched: &Searched,
    near: impl IntoIterator<Item = usize>,
    far: impl IntoIterator<Item = usize>,
) -> Vec<usize> {
    let last = |part: &usize| searched.last_searched(Purpose::Partition(*part));
    let mut near: Vec<usize> = near.into_iter().collect();
    let mut far: Vec<usize> = far.into_iter().collect();
    near.sort_by_key(last);
    far.sort_by_key(last);
    let never = near.partition_point(|part| last(part).is_none());
    // A frame may have time for one view alone, or three: the kind of which fewer were searched in
    // the last frame begins the next.
    let latest = near.last().map(last).max(far.last().map(last));
    let in_latest = |kind: &[usize]| kind.iter().filter(|&part| Some(last(part)) == latest).count();
    let is_fars_turn = never == 0 && in_latest(&far) < in_latest(&near);
    let mut order: Vec<usize> = near.drain(..never).collect();
    let mut kinds = [near.into_iter(), far.into_iter()];
    if is_fars_turn {
        kinds.reverse();
    }
    loop {
        let before = order.len();
        order.extend(kinds.iter_mut().filter_map(Iterator::next));
        if order.len() == before {
            return order;
        }
    }
}
