//! Neighbours measured, each from what a frame shows of it.

use std::collections::BTreeMap;

use crate::alignment::Pace;
use crate::gallery::FrameOrder;
use crate::neighbour::Known;
use crate::parallel;
use crate::second_look::{Answer, SecondLooks, Subject, ThreadEnded};
use crate::sighting::{Look, MeasuredBy, Sighting, doubtful_rays_of, rays_of};

use super::{BestViews, FilterChoice, SEARCH_EVERY_FRAMES, Seen, Swarm, Update};

impl Swarm {
    /// Measures neighbours, each from some of a frame's records and its picture, and takes in what
    /// was found.
    pub(super) fn settle(
        &mut self,
        order: FrameOrder,
        at_s: f64,
        looks: &[(usize, Vec<Seen<'_>>)],
        best_views: &BestViews<'_>,
        needed: usize,
    ) -> Vec<Update> {
        // Taken out meanwhile, since the looks borrow from all else.
        let mut second_looks = self.second_looks.take();
        let mut looks: Vec<Look<'_>> = looks
            .iter()
            .filter_map(|(target, seen)| self.look(at_s, *target, seen, best_views, needed))
            .collect();
        let looked = self.looked.get(&order);
        for look in &mut looks {
            if let Some(looked) = looked {
                look.tried = looked.fruitless.get(&look.target).copied();
                look.peek = looked.peeks.get(&look.target);
                look.second = looked.seconds.get(&look.target).copied();
            }
            // Where there is no gaze view, all begins when the frame ends, and later is too late for that
            // frame; where nobody else is tracked, nobody waits for it either.
            let is_glanced = looked.is_some_and(|looked| looked.glanced.contains(&look.target));
            let is_in_time = look.prior.is_some() && is_glanced;
            look.has_second &=
                second_looks.is_some() && (is_in_time || self.tracks_others(look.target));
            look.may_search &= needed == 1 || look.has_second;
        }
        let sightings = parallel::map(&looks, self.threads, |look| look.measure(&self.aligner));
        let nothing = looks.iter().zip(&sightings).filter(|(_, sighting)| sighting.is_none());
        let (mut fruitless, mut seconds) = (BTreeMap::new(), BTreeMap::new());
        for (look, _) in nothing {
            let (target, basis) = (look.target, look.basis());
            fruitless.insert(target, basis);
            let subject = Subject { order, at_s, target };
            if look.wants_second()
                && second_looks.as_mut().is_some_and(|second_looks| second_looks.ask(subject, look))
            {
                seconds.insert(target, basis);
            }
        }
        let corrected: Vec<(usize, Sighting)> = looks
            .iter()
            .zip(sightings)
            .filter_map(|(look, sighting)| {
                let sighting = sighting?;
                let rays_m = match sighting.measured_by {
                    MeasuredBy::Decoded => look.rays_m,
                    MeasuredBy::Aligned => look.best_view.map_or(look.rays_m, |view| view.rays_m),
                };
                Some((look.target, self.corrected(sighting, rays_m)))
            })
            .collect();
        self.second_looks = second_looks;
        let looked = self.looked.entry(order).or_default();
        looked.fruitless.extend(fruitless);
        looked.seconds.extend(seconds);
        corrected
            .iter()
            .filter_map(|(target, sighting)| self.take_in(order, at_s, *target, sighting))
            .collect()
    }

    /// Whether any neighbour but this one is tracked.
    fn tracks_others(&self, target: usize) -> bool {
        let mut others = self.neighbours.iter().enumerate().filter(|(other, _)| *other != target);
        others.any(|(_, neighbour)| neighbour.is_tracked())
    }

    /// Whether a frame is so recent that measurements of it still count.
    fn remembers(&self, at_s: f64) -> bool {
        match self.filter {
            FilterChoice::Tracks(policy) => {
                self.last_s.is_none_or(|last_s| last_s - at_s <= policy.history_s)
            }
            FilterChoice::None => false,
        }
    }

    /// What a second look that is over found. Of a frame that has ended it only corrects a track that
    /// goes on from there, or begins one: what was found by the word of a track that is no more means
    /// nothing.
    ///
    /// # Errors
    /// [`ThreadEnded`].
    pub fn take_second_look(&mut self) -> Result<Option<(FrameOrder, Update)>, ThreadEnded> {
        let Some(second_looks) = &mut self.second_looks else { return Ok(None) };
        let Some(answer) = second_looks.take()? else { return Ok(None) };
        let Answer { subject, sighting, stands_alone, rays_m } = answer;
        let Subject { order, at_s, target } = subject;
        let is_late = self.ended.is_some_and(|ended| order <= ended);
        let is_newcomer = stands_alone && !self.neighbours[target].is_tracked();
        if is_late && is_newcomer && self.remembers(at_s) {
            // That it was not found in the frames since says nothing: nobody knew where to look.
            self.neighbours[target].forget();
        }
        let sighting =
            sighting.map(|sighting| self.corrected(sighting, rays_m)).filter(|sighting| {
                let expects = || self.neighbours[target].expects(at_s, sighting);
                !is_late || (is_newcomer && self.remembers(at_s)) || expects()
            });
        let update = sighting.and_then(|sighting| self.take_in(order, at_s, target, &sighting));
        Ok(update.map(|update| (order, update)))
    }

    /// The frame of which a second look may still say something.
    pub fn awaited(&self) -> Option<FrameOrder> {
        self.second_looks.as_ref().and_then(SecondLooks::awaited)
    }

    /// A sighting by rays that are right for this distance, brought to its own.
    pub(super) fn corrected(&self, sighting: Sighting, rays_m: f64) -> Sighting {
        let Some(parallax) = &self.parallax else { return sighting };
        Sighting { pose: parallax.corrected(&sighting.pose, rays_m), ..sighting }
    }

    pub(super) fn take_in(
        &mut self,
        order: FrameOrder,
        at_s: f64,
        target: usize,
        sighting: &Sighting,
    ) -> Option<Update> {
        let known = match self.filter {
            FilterChoice::Tracks(_) => self.neighbours[target].seen(at_s, sighting),
            FilterChoice::None => Some(Known::of_frame(sighting)),
        }?;
        self.looked.entry(order).or_default().settled.insert(target);
        if let Some(second_looks) = &mut self.second_looks {
            second_looks.settle(order, target);
        }
        Some((target, known))
    }

    /// What there is to measure a neighbour by; `None` where there is nothing.
    pub(super) fn look<'l>(
        &'l self,
        at_s: f64,
        target: usize,
        seen: &[Seen<'_>],
        best_views: &BestViews<'l>,
        needed: usize,
    ) -> Option<Look<'l>> {
        let neighbour = self.neighbours.get(target)?;
        let (prior, predicted) = match self.filter {
            FilterChoice::Tracks(_) => (neighbour.prior(at_s), neighbour.predict(at_s)),
            FilterChoice::None => (None, None),
        };
        // All rays are brought to the distance that is known best before the pose is.
        let rays_m = self.parallax.as_ref().map_or(f64::INFINITY, |parallax| {
            let predicted = prior.as_ref().map(|prior| &prior.camera_from_markers.translation);
            predicted.map_or(parallax.assumed_m(), |position| position.vector.norm())
        });
        let (mut rays, mut doubtful) = (Vec::new(), Vec::new());
        for Seen { record, view, .. } in seen {
            for (all, mut of_view) in [
                (&mut rays, rays_of(&neighbour.body, &record.markers)),
                (&mut doubtful, doubtful_rays_of(&neighbour.body, &record.markers)),
            ] {
                if let Some(parallax) = &self.parallax {
                    let from_m = parallax.distance_m(*view);
                    for ray in &mut of_view {
                        ray.ray_in_camera = parallax.brought(&ray.ray_in_camera, from_m, rays_m);
                    }
                }
                all.extend(of_view);
            }
        }
        let predicted = predicted.map(|prediction| prediction.observer_from_target);
        let best_view = best_views.get(&target).copied();
        // A neighbour that nobody has seen is not begun from squares that are probably its markers:
        // on a chequered wall there are enough of them.
        let is_worth_it = !rays.is_empty() || (predicted.is_some() && best_view.is_some());
        // The dearest look is for one neighbour in some frames, and after those that are seen.
        let turn = self.frames / SEARCH_EVERY_FRAMES % self.neighbours.len() as u64;
        let may_search = self.frames.is_multiple_of(SEARCH_EVERY_FRAMES) && turn == target as u64;
        is_worth_it.then_some(Look {
            target,
            body: &neighbour.body,
            rays,
            doubtful,
            rays_m,
            may_search: may_search && self.pace != Pace::Behind,
            pace: self.pace,
            prior,
            predicted,
            best_view,
            needed,
            tried: None,
            peek: None,
            has_second: self.pace != Pace::Unhurried,
            second: None,
        })
    }
}
