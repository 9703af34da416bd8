//! Neighbours measured before their views are searched for markers.

use flockeye_imaging::align::Alignment;
use nalgebra::Isometry3;

use crate::alignment::{BestView, Start, is_surprising};
use crate::gallery::FrameOrder;
use crate::parallel;
use crate::sighting::{Peek, Sighting, contradicts, rays_of};

use super::{Purpose, Seen, Swarm, Update};

/// Facets that must agree with a pose for which no marker is waited.
const PEEKED_FACETS: u32 = 2;

/// A gaze view that has been cut, and whose it is.
#[derive(Debug, Clone, Copy)]
pub struct Glimpse<'v> {
    /// The neighbour's number.
    pub target: usize,
    /// The view.
    pub view: BestView<'v>,
}

impl Swarm {
    /// What the pixels of confirmed neighbours' gaze views of a frame say before they are searched for
    /// markers: aligned from their predictions alone. Nothing of those of whom that is not beyond doubt; then
    /// their markers are waited for, and so they are for some frames after they contradicted such a pose.
    pub fn peek(&mut self, order: FrameOrder, at_s: f64, glimpses: &[Glimpse<'_>]) -> Vec<Update> {
        let predicted: Vec<(Glimpse<'_>, Isometry3<f64>)> = glimpses
            .iter()
            .filter_map(|glimpse| {
                let predicted = self.predicted_to_peek(order, at_s, glimpse.target)?;
                Some((*glimpse, predicted))
            })
            .collect();
        let found =
            parallel::map(&predicted, self.threads, |(Glimpse { target, view }, predicted)| {
                self.aligner.align(*target, &view.picture, &Start::Fine(*predicted))
            });
        let peeks = predicted.into_iter().zip(found);
        peeks
            .filter_map(|((glimpse, predicted), found)| {
                self.take_peek(order, at_s, &glimpse, predicted, found)
            })
            .collect()
    }

    /// Where a neighbour is predicted, if its view is worth a peek.
    fn predicted_to_peek(
        &self,
        order: FrameOrder,
        at_s: f64,
        target: usize,
    ) -> Option<Isometry3<f64>> {
        let neighbour = self.neighbours.get(target)?;
        let is_worth_it = neighbour.is_measured()
            && !self.trust.is_doubted(target)
            && !self.is_settled(order, target);
        let prior = neighbour.prior(at_s).filter(|_| is_worth_it)?;
        Some(prior.camera_from_markers)
    }

    fn take_peek(
        &mut self,
        order: FrameOrder,
        at_s: f64,
        Glimpse { target, view }: &Glimpse<'_>,
        predicted: Isometry3<f64>,
        found: Option<Alignment>,
    ) -> Option<Update> {
        // A view may come twice, cut again for another worker.
        if self.is_settled(order, *target) {
            return None;
        }
        let is_sure = |found: &&Alignment| {
            found.is_accepted()
                && found.evidence.agreeing_facets >= PEEKED_FACETS
                && !is_surprising(found, &predicted)
        };
        let expected = found.as_ref().filter(is_sure).and_then(|sure| {
            let sighting = self.corrected(Sighting::aligned(sure, 0), view.rays_m);
            let is_expected = self.neighbours[*target].expects(at_s, &sighting);
            is_expected.then_some((sure.camera_from_markers, sighting))
        });
        let Some((pose, sighting)) = expected else {
            let found = found.map(Box::new);
            let peek = Peek { predicted, view_index: view.view_index, found };
            self.looked.entry(order).or_default().peeks.insert(*target, peek);
            return None;
        };
        let update = self.take_in(order, at_s, *target, &sighting)?;
        self.looked.entry(order).or_default().peeked.insert(*target, pose);
        Some(update)
    }

    /// Notes where markers say something else than the pose that came before they were decoded.
    pub(super) fn check_peeked(&mut self, order: FrameOrder, seen: &[Seen<'_>]) {
        let Some(looked) = self.looked.get(&order) else { return };
        for record in seen {
            let Some(Purpose::Gaze(target)) = record.purpose else { continue };
            let Some(pose) = looked.peeked.get(&target) else { continue };
            let rays = rays_of(&self.neighbours[target].body, &record.record.markers);
            if contradicts(&self.neighbours[target].body, &rays, pose) {
                self.trust.doubt(target);
            }
        }
    }
}
