//! Places of a frame that look like a body: the views of its proposals, copied.
//!
//! The views themselves stay in shared memory only until their records have come, because rectification needs the room.
//! These views are small.

use std::collections::BTreeMap;

use flockeye_contract::{FrameOrder, ViewHeader};
use flockeye_geometry::search::PROPOSAL_FIELD_RADII;
use flockeye_geometry::view::View;
use flockeye_imaging::align::Place;

use crate::pictures::Pixels;

/// Places that are searched in one step, by as many threads. All of a frame would take longer than a stage may go without
/// a sign of life.
const AT_ONCE: usize = 2;
/// Views that are kept at most, of all frames.
const MAX_VIEWS: usize = 128;

/// Views of places.
#[derive(Debug, Default)]
pub struct Places {
    /// By frame and place in the plan.
    views: BTreeMap<(FrameOrder, u32), (ViewHeader, Copied)>,
    /// The target that was looked for last at the first places; `None` when a frame begins.
    last_target: Option<usize>,
}

/// Pixels of a view, row by row.
#[derive(Debug)]
pub struct Copied(Vec<u8>);

impl Pixels for Copied {
    fn pixels(&self) -> &[u8] {
        &self.0
    }
}

impl Places {
    /// Keeps a view. Where there are too many, newer frames give way.
    pub fn add(&mut self, header: ViewHeader, pixels: &[u8]) {
        let key = (header.stamp.order(), header.view_index);
        self.views.insert(key, (header, Copied(pixels.to_vec())));
        while self.views.len() > MAX_VIEWS {
            self.views.pop_last();
        }
    }

    /// The views of a frame, in the order of its plan.
    fn of(&self, order: FrameOrder) -> impl Iterator<Item = (&ViewHeader, &Copied)> {
        let of_frame = self.views.range((order, 0)..=(order, u32::MAX));
        of_frame.map(|(_, (header, pixels))| (header, pixels))
    }

    /// The views that are searched next, of a frame.
    pub fn next(&self, order: FrameOrder) -> impl Iterator<Item = (&ViewHeader, &Copied)> {
        self.of(order).take(AT_ONCE)
    }

    /// The target that is to be looked for next at the next places of a frame, of these. When all of them have been, other
    /// places come next. `None` where none are left.
    pub fn next_target(
        &mut self,
        order: FrameOrder,
        untracked: impl Iterator<Item = usize>,
    ) -> Option<usize> {
        let untracked: Vec<usize> = untracked.collect();
        let next = untracked.iter().copied().find(|target| Some(*target) > self.last_target);
        if next.is_none() {
            let done = self.views.range((order, 0)..=(order, u32::MAX)).take(AT_ONCE);
            let done: Vec<_> = done.map(|(key, _)| *key).collect();
            done.iter().for_each(|key| drop(self.views.remove(key)));
        }
        let next = next.or(untracked.first().copied());
        self.last_target = next.filter(|_| self.of(order).next().is_some());
        self.last_target
    }

    /// Drops all views up to and with this frame.
    pub fn release_until(&mut self, order: FrameOrder) {
        self.views.retain(|(of, _), _| *of > order);
        self.last_target = None;
    }
}

/// The place that a proposal's view shows, for a body with markers of `side_m`. Views are as wide as for the body with
/// the largest radius in sides of its markers.
pub fn place_of(view: &View, side_m: f64, radius_in_sides: f64) -> Place {
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
    use crate::fixtures::stamp;
    use nalgebra::Vector3;

    fn header(sequence: u64, view_index: u32) -> ViewHeader {
        ViewHeader { stamp: stamp(sequence), view_index, ..ViewHeader::default() }
    }

    #[test]
    fn a_frame_has_its_places_until_it_ends() {
        let mut places = Places::default();
        for (sequence, view_index) in [(2, 1), (1, 5), (1, 3), (2, 0)] {
            places.add(header(sequence, view_index), &[sequence as u8, view_index as u8]);
        }
        let of = |places: &Places, sequence| {
            let pixels = places.of(stamp(sequence).order()).map(|(_, copied)| copied.0.clone());
            pixels.collect::<Vec<_>>()
        };
        assert_eq!(of(&places, 1), [[1, 3], [1, 5]]);
        places.release_until(stamp(1).order());
        assert_eq!((of(&places, 1).len(), of(&places, 2).len()), (0, 2));
    }

    #[test]
    fn each_target_is_looked_for_at_some_places_then_at_the_next() {
        let mut places = Places::default();
        (0..3).for_each(|index| places.add(header(1, index), &[index as u8]));
        let order = stamp(1).order();
        let mut turn = |untracked: &[usize]| {
            let target = places.next_target(order, untracked.iter().copied())?;
            Some((target, places.of(order).next().unwrap().0.view_index))
        };
        assert_eq!(turn(&[1, 4]), Some((1, 0)));
        assert_eq!(turn(&[1, 4]), Some((4, 0)));
        assert_eq!(turn(&[1, 4]), Some((1, 2)), "two were looked at");
        assert_eq!(turn(&[4]), Some((4, 2)), "1 was found");
        assert_eq!(turn(&[4]), None);
        assert_eq!(Places::default().next_target(order, [0].into_iter()), None);
    }

    #[test]
    fn a_flood_is_bounded_and_the_oldest_frame_keeps_its_places() {
        let mut places = Places::default();
        (0..3 * MAX_VIEWS as u64).rev().for_each(|k| places.add(header(k, 0), &[0]));
        assert_eq!(places.views.len(), MAX_VIEWS);
        assert_eq!(places.of(stamp(0).order()).count(), 1);
    }

    #[test]
    fn a_view_tells_how_far_away_the_body_is() {
        let view = View::looking_at(&Vector3::y_axis(), 2.0 * PROPOSAL_FIELD_RADII * 0.04, 200);
        let place = place_of(&view, 0.05, 1.6);
        assert!((place.range_m - 2.0).abs() < 1e-3, "{place:?}");
        assert!((place.direction_in_camera - *Vector3::y_axis()).norm() < 1e-9);
    }
}
