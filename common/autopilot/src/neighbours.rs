//! The newest state of each neighbour, and whether it was sent to the autopilot.

use crate::error::{AutopilotError, MAX_NEIGHBOURS};
use crate::neighbour::NeighbourState;

/// The newest state of each neighbour. Their number is bounded: the oldest one that is not fresh is
/// replaced.
#[derive(Debug)]
pub(crate) struct Neighbours {
    /// A neighbour's index is its number in messages, which stays the same while it is kept.
    neighbours: Vec<Neighbour>,
    max_age_ns: i64,
}

/// A state, and whether it was sent as the target and as an obstacle.
#[derive(Debug)]
struct Neighbour {
    state: NeighbourState,
    is_sent_as_target: bool,
    is_sent_as_obstacle: bool,
}

impl Neighbour {
    fn new(state: &NeighbourState) -> Self {
        Self { state: state.clone(), is_sent_as_target: false, is_sent_as_obstacle: false }
    }

    fn is_fresh(&self, now_ns: i64, max_age_ns: i64) -> bool {
        let age_ns = now_ns.saturating_sub(self.state.exposure_monotonic_ns);
        // A future time cannot be of this machine's clock.
        !self.state.is_lost && (-max_age_ns..=max_age_ns).contains(&age_ns)
    }
}

impl Neighbours {
    /// An empty table. States are fresh for `max_age_ns` nanoseconds after their exposure.
    pub(crate) fn new(max_age_ns: i64) -> Self {
        Self { neighbours: Vec::with_capacity(MAX_NEIGHBOURS), max_age_ns }
    }

    /// Takes a state. One that is older than the known state of this neighbour changes nothing.
    ///
    /// # Errors
    /// [`AutopilotError::Neighbour`] for an invalid state, [`AutopilotError::TooManyNeighbours`]
    /// where all neighbours in the table are fresh.
    pub(crate) fn update(
        &mut self,
        state: &NeighbourState,
        now_ns: i64,
    ) -> Result<(), AutopilotError> {
        state.check()?;
        let known = self.neighbours.iter().position(|neighbour| neighbour.state.name == state.name);
        if let Some(neighbour) = known.map(|place| &mut self.neighbours[place]) {
            if state.exposure_monotonic_ns >= neighbour.state.exposure_monotonic_ns {
                *neighbour = Neighbour::new(state);
            }
            return Ok(());
        }
        if state.is_lost {
            return Ok(());
        }
        let neighbour = Neighbour::new(state);
        if self.neighbours.len() < MAX_NEIGHBOURS {
            self.neighbours.push(neighbour);
            return Ok(());
        }
        let max_age_ns = self.max_age_ns;
        let oldest = self
            .neighbours
            .iter_mut()
            .filter(|neighbour| !neighbour.is_fresh(now_ns, max_age_ns))
            .min_by_key(|neighbour| neighbour.state.exposure_monotonic_ns);
        match oldest {
            Some(place) => *place = neighbour,
            None => {
                return Err(AutopilotError::TooManyNeighbours(state.name.clone()));
            }
        }
        Ok(())
    }

    /// Whether `name` is fresh and has not been sent as the target.
    pub(crate) fn has_target(&self, name: &str, now_ns: i64) -> bool {
        self.fresh(now_ns)
            .any(|(_, neighbour)| neighbour.state.name == name && !neighbour.is_sent_as_target)
    }

    /// The state of the target `name`; each is returned once.
    pub(crate) fn take_target(&mut self, name: &str, now_ns: i64) -> Option<(u8, &NeighbourState)> {
        let max_age_ns = self.max_age_ns;
        let place = self.neighbours.iter().position(|neighbour| neighbour.state.name == name)?;
        let neighbour = &mut self.neighbours[place];
        if neighbour.is_sent_as_target || !neighbour.is_fresh(now_ns, max_age_ns) {
            return None;
        }
        neighbour.is_sent_as_target = true;
        Some((id(place), &neighbour.state))
    }

    /// Whether a fresh state has not been sent as an obstacle.
    pub(crate) fn has_obstacles(&self, now_ns: i64) -> bool {
        self.fresh(now_ns).any(|(_, neighbour)| !neighbour.is_sent_as_obstacle)
    }

    /// All fresh states as obstacles, the nearest first, if at least one of them is new. Older ones
    /// are sent again, because a receiver drops the obstacles of the previous message.
    pub(crate) fn take_obstacles(&mut self, now_ns: i64) -> Vec<(u8, &NeighbourState)> {
        if !self.has_obstacles(now_ns) {
            return Vec::new();
        }
        let max_age_ns = self.max_age_ns;
        for neighbour in &mut self.neighbours {
            neighbour.is_sent_as_obstacle |= neighbour.is_fresh(now_ns, max_age_ns);
        }
        let mut obstacles: Vec<_> =
            self.fresh(now_ns).map(|(place, neighbour)| (id(place), &neighbour.state)).collect();
        obstacles.sort_by(|(_, a), (_, b)| a.distance_m().total_cmp(&b.distance_m()));
        obstacles
    }

    fn fresh(&self, now_ns: i64) -> impl Iterator<Item = (usize, &Neighbour)> {
        self.neighbours
            .iter()
            .enumerate()
            .filter(move |(_, neighbour)| neighbour.is_fresh(now_ns, self.max_age_ns))
    }
}

/// Indices are below [`MAX_NEIGHBOURS`], so they fit.
fn id(place: usize) -> u8 {
    u8::try_from(place).unwrap_or(u8::MAX)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::neighbour::tests::neighbour;

    const MS: i64 = 1_000_000;
    const MAX_AGE_NS: i64 = 500 * MS;

    fn names(obstacles: &[(u8, &NeighbourState)]) -> Vec<String> {
        obstacles.iter().map(|(_, state)| state.name.clone()).collect()
    }

    #[test]
    fn the_newest_of_each_wins_and_sent_once() {
        let mut all = Neighbours::new(MAX_AGE_NS);
        all.update(&neighbour("kite", 100 * MS), 150 * MS).unwrap();
        all.update(&neighbour("kite", 130 * MS), 160 * MS).unwrap();
        // It comes late.
        all.update(&neighbour("kite", 110 * MS), 170 * MS).unwrap();
        let (_, state) = all.take_target("kite", 170 * MS).unwrap();
        assert_eq!(state.exposure_monotonic_ns, 130 * MS);
        assert!(all.take_target("kite", 170 * MS).is_none(), "told already");
        assert_eq!(all.take_obstacles(170 * MS).len(), 1, "that is another message");
        assert!(all.take_obstacles(170 * MS).is_empty() && !all.has_obstacles(170 * MS));
    }

    #[test]
    fn lost_and_old_ones_are_not_told() {
        let mut all = Neighbours::new(MAX_AGE_NS);
        for name in ["kite", "swift", "robin"] {
            all.update(&neighbour(name, 100 * MS), 100 * MS).unwrap();
        }
        let lost = NeighbourState { is_lost: true, ..neighbour("swift", 130 * MS) };
        all.update(&lost, 140 * MS).unwrap();
        all.update(&neighbour("robin", 500 * MS), 500 * MS).unwrap();
        assert!(!all.has_target("swift", 500 * MS) && all.has_target("kite", 500 * MS));
        assert_eq!(names(&all.take_obstacles(500 * MS)), ["kite", "robin"]);
        all.update(&neighbour("robin", 610 * MS), 610 * MS).unwrap();
        assert_eq!(names(&all.take_obstacles(610 * MS)), ["robin"], "kite is too old");
        // The number stays when it comes back.
        all.update(&neighbour("swift", 620 * MS), 620 * MS).unwrap();
        assert_eq!(all.take_target("swift", 620 * MS).unwrap().0, 1);
    }

    #[test]
    fn the_nearest_comes_first() {
        let mut all = Neighbours::new(MAX_AGE_NS);
        for (name, x) in [("far", 30.0), ("near", 1.0), ("middle", -7.0)] {
            let mut state = neighbour(name, 0);
            state.observer_from_target.translation.x = x;
            all.update(&state, 0).unwrap();
        }
        assert_eq!(names(&all.take_obstacles(0)), ["near", "middle", "far"]);
    }

    #[test]
    fn places_are_bounded_and_those_of_the_lost_are_given_on() {
        let mut all = Neighbours::new(MAX_AGE_NS);
        for place in 0..MAX_NEIGHBOURS {
            all.update(&neighbour(&format!("n{place}"), 0), 0).unwrap();
        }
        let refused = all.update(&neighbour("one-more", 0), 0);
        assert!(matches!(refused, Err(AutopilotError::TooManyNeighbours(_))));
        let lost = NeighbourState { is_lost: true, ..neighbour("n7", MS) };
        all.update(&lost, MS).unwrap();
        all.update(&neighbour("one-more", MS), MS).unwrap();
        assert_eq!(all.take_target("one-more", MS).unwrap().0, 7);
        assert_eq!(all.neighbours.len(), MAX_NEIGHBOURS);
    }
}
