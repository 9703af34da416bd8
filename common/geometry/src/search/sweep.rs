//! The order in which the sphere is swept for untracked targets.

use super::{Purpose, Searched};

/// The tiles of two resolutions, each kind by its last search: never, then longest ago, ties by
/// index.
///
/// Tiles of the partition that were never searched come first. Then the kinds take turns, so that
/// all tiles of both are searched within a bounded number of frames, even if a frame has time for
/// few views.
pub fn least_recently_searched(
    searched: &Searched,
    partitions: impl IntoIterator<Item = usize>,
    high_resolution_tiles: impl IntoIterator<Item = usize>,
) -> Vec<Purpose> {
    let last = |tile: &Purpose| searched.last_searched(*tile);
    let mut near: Vec<Purpose> = partitions.into_iter().map(Purpose::Partition).collect();
    let mut far: Vec<Purpose> =
        high_resolution_tiles.into_iter().map(Purpose::HighResolution).collect();
    near.sort_by_key(last);
    far.sort_by_key(last);
    let never = near.partition_point(|tile| last(tile).is_none());
    // A frame may have time for one view only, or for three. So the next frame begins with the kind
    // of which fewer tiles were searched in the last one.
    let latest = near.last().map(last).max(far.last().map(last));
    let in_latest =
        |kind: &[Purpose]| kind.iter().filter(|&tile| Some(last(tile)) == latest).count();
    let begins_with_far = never == 0 && in_latest(&far) < in_latest(&near);
    let mut order: Vec<Purpose> = near.drain(..never).collect();
    let mut kinds = [near.into_iter(), far.into_iter()];
    if begins_with_far {
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
