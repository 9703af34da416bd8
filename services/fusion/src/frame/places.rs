//! Places of a frame that look like a body: the views of its proposals, copied.
//!
//! The views themselves stay in shared memory only until their records have arrived, because
//! rectification needs the room. These views are small.

use std::collections::BTreeMap;

use flockeye_contract::ViewHeader;
use flockeye_geometry::search::PROPOSAL_FIELD_RADII;
use flockeye_geometry::view::View;
use flockeye_imaging::align::Place;

/// Number of places that are searched in one step, by as many threads. All of a frame would take
/// longer than the watchdog's timeout.
const AT_ONCE: usize = 2;

/// Views of the places of one frame.
#[derive(Debug, Default)]
pub(crate) struct Places {
    /// The views with their pixels, row by row, by their place in the plan.
    pub(crate) views: BTreeMap<u32, (ViewHeader, Vec<u8>)>,
    /// The last target of the search at the first places; `None` before the first.
    last_target: Option<usize>,
}

impl Places {
    pub(crate) fn add(&mut self, header: ViewHeader, pixels: &[u8]) {
        self.views.insert(header.view_index, (header, pixels.to_vec()));
    }

    /// The views of the next search.
    pub(crate) fn next(&self) -> impl Iterator<Item = (&ViewHeader, &Vec<u8>)> {
        self.views.values().take(AT_ONCE).map(|(header, pixels)| (header, pixels))
    }

    /// The next of these targets for the search at the next places. After all of them, other places
    /// come next. `None` if none are left.
    pub(crate) fn next_target(&mut self, untracked: impl Iterator<Item = usize>) -> Option<usize> {
        let untracked: Vec<usize> = untracked.collect();
        let next = untracked.iter().copied().find(|target| Some(*target) > self.last_target);
        if next.is_none() {
            (0..AT_ONCE).for_each(|_| drop(self.views.pop_first()));
        }
        let next = next.or(untracked.first().copied());
        self.last_target = next.filter(|_| !self.views.is_empty());
        self.last_target
    }
}

/// The place of a proposal's view, for a body with markers of `side_m`. Views are as wide as for
/// the body with the largest radius in sides of its markers.
pub(crate) fn place_of(view: &View, side_m: f64, radius_in_sides: f64) -> Place {
    let side_rad = view.field_rad() / 2.0 / PROPOSAL_FIELD_RADII / radius_in_sides;
    Place {
        direction_in_camera: view.direction_in_camera().into_inner(),
        range_m: side_m / side_rad,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use nalgebra::Vector3;

    fn places(view_indices: impl IntoIterator<Item = u32>) -> Places {
        let mut places = Places::default();
        for view_index in view_indices {
            let header = ViewHeader { view_index, ..ViewHeader::default() };
            places.add(header, &[view_index as u8]);
        }
        places
    }

    #[test]
    fn places_are_searched_in_the_order_of_the_plan() {
        let places = places([5, 3, 9]);
        let pixels: Vec<_> = places.next().map(|(_, copied)| copied.clone()).collect();
        assert_eq!(pixels, [[3], [5]]);
    }

    #[test]
    fn each_target_is_looked_for_at_some_places_then_at_the_next() {
        let mut places = places(0..3);
        let mut turn = |untracked: &[usize]| {
            let target = places.next_target(untracked.iter().copied())?;
            Some((target, places.next().next().unwrap().0.view_index))
        };
        assert_eq!(turn(&[1, 4]), Some((1, 0)));
        assert_eq!(turn(&[1, 4]), Some((4, 0)));
        assert_eq!(turn(&[1, 4]), Some((1, 2)), "two were looked at");
        assert_eq!(turn(&[4]), Some((4, 2)), "1 was found");
        assert_eq!(turn(&[4]), None);
        assert_eq!(Places::default().next_target([0].into_iter()), None);
    }

    #[test]
    fn a_view_tells_how_far_away_the_body_is() {
        let view = View::looking_at(&Vector3::y_axis(), 2.0 * PROPOSAL_FIELD_RADII * 0.04, 200);
        let place = place_of(&view, 0.05, 1.6);
        assert!((place.range_m - 2.0).abs() < 1e-3, "{place:?}");
        assert!((place.direction_in_camera - *Vector3::y_axis()).norm() < 1e-9);
    }
}
