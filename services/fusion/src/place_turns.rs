//! Which place is searched next, and for whom, where there is time for a few places only.
//!
//! Most places that look like a body are none, and stay where they are while the camera turns. So a place near which a
//! target was searched before waits for those that are new. A body that moves is new again soon.

use std::collections::VecDeque;

use nalgebra::{Unit, UnitQuaternion, Vector3};

/// Places nearer to each other are the same, radians: so far rectification lets one move from frame to frame.
const SAME_RAD: f64 = 0.1;
/// Searches that are remembered.
const MAX_SEARCHES: usize = 128;

/// What was searched before.
#[derive(Debug, Default)]
pub struct PlaceTurns {
    searches: VecDeque<Search>,
    /// How many there have been.
    count: u64,
}

#[derive(Debug, Clone, Copy)]
struct Search {
    target: usize,
    direction_in_camera: Unit<Vector3<f64>>,
    /// How many searches were before it.
    number: u64,
}

impl PlaceTurns {
    /// The camera has turned.
    pub fn turn_camera(&mut self, later_from_earlier: &UnitQuaternion<f64>) {
        for search in &mut self.searches {
            search.direction_in_camera = later_from_earlier * search.direction_in_camera;
        }
    }

    /// The pair of a target and a place that comes next, of all pairs: the first of those that were never searched, else
    /// the one whose last search is the longest ago. Places are in the order in which they look like a body.
    pub fn next(&self, targets: &[usize], places: &[Unit<Vector3<f64>>]) -> Option<(usize, usize)> {
        let pairs =
            (0..places.len()).flat_map(|place| targets.iter().map(move |&target| (target, place)));
        pairs.min_by_key(|&(target, place)| self.last(target, &places[place]))
    }

    /// The number of the last search for a target near a place; `None` where there was none.
    fn last(&self, target: usize, direction_in_camera: &Unit<Vector3<f64>>) -> Option<u64> {
        let is_near = |search: &&Search| {
            search.target == target
                && search.direction_in_camera.angle(direction_in_camera) < SAME_RAD
        };
        self.searches.iter().rev().find(is_near).map(|search| search.number)
    }

    /// All places are new for a target.
    pub fn forget(&mut self, target: usize) {
        self.searches.retain(|search| search.target != target);
    }

    /// A place is searched for a target.
    pub fn note(&mut self, target: usize, direction_in_camera: Unit<Vector3<f64>>) {
        self.searches.push_back(Search { target, direction_in_camera, number: self.count });
        self.count += 1;
        if self.searches.len() > MAX_SEARCHES {
            self.searches.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Directions in the horizontal plane.
    fn at(azimuths_rad: &[f64]) -> Vec<Unit<Vector3<f64>>> {
        let direction = |azimuth: &f64| Vector3::new(azimuth.cos(), azimuth.sin(), 0.0);
        azimuths_rad.iter().map(|azimuth| Unit::new_normalize(direction(azimuth))).collect()
    }

    fn searched(
        turns: &mut PlaceTurns,
        targets: &[usize],
        azimuths_rad: &[f64],
    ) -> Option<(usize, usize)> {
        let places = at(azimuths_rad);
        let (target, place) = turns.next(targets, &places)?;
        turns.note(target, places[place]);
        Some((target, place))
    }

    #[test]
    fn all_pairs_take_turns_the_likeliest_places_first() {
        let mut turns = PlaceTurns::default();
        let pairs = |turns: &mut PlaceTurns| -> Vec<(usize, usize)> {
            (0..4).filter_map(|_| searched(turns, &[2, 5], &[0.0, 1.0])).collect()
        };
        assert_eq!(pairs(&mut turns), [(2, 0), (5, 0), (2, 1), (5, 1)]);
        assert_eq!(pairs(&mut turns), [(2, 0), (5, 0), (2, 1), (5, 1)], "and again");
        turns.forget(5);
        assert_eq!(searched(&mut turns, &[2, 5], &[0.0, 1.0]), Some((5, 0)), "it was found");
        assert_eq!(searched(&mut turns, &[2, 5], &[]), None);
        assert_eq!(searched(&mut turns, &[], &[0.0]), None);
    }

    #[test]
    fn what_has_moved_is_new_and_what_the_camera_has_turned_away_from_is_not() {
        let mut turns = PlaceTurns::default();
        assert_eq!(searched(&mut turns, &[0], &[0.0, 2.0]), Some((0, 0)));
        assert_eq!(searched(&mut turns, &[0], &[0.2, 2.0]), Some((0, 0)), "it has moved");
        assert_eq!(searched(&mut turns, &[0], &[0.22, 2.0]), Some((0, 1)));
        // The camera turns to the left, so all moves to the right in it.
        turns.turn_camera(&UnitQuaternion::from_euler_angles(0.0, 0.0, -0.5));
        assert_eq!(searched(&mut turns, &[0], &[1.5, -0.3, 0.6]), Some((0, 2)), "it is new");
        assert_eq!(searched(&mut turns, &[0], &[1.5, -0.3]), Some((0, 1)), "the longest ago");
    }

    #[test]
    fn few_searches_are_remembered() {
        let mut turns = PlaceTurns::default();
        let place = at(&[0.0])[0];
        (0..1000).for_each(|_| turns.note(0, place));
        assert_eq!(turns.searches.len(), MAX_SEARCHES);
    }
}
