//! The measurement passes of the core, with their inputs from its frames.

use flockeye_contract::FrameOrder;

use super::{Core, Outputs, time_of};
use crate::account::Pass;
use crate::aligner::BestView;
use crate::frame::OpenFrame;
use crate::measure::AnsweredView;
use crate::output::Cause;
use crate::record::Record;
use crate::schedule::Schedule;
use crate::target::Update;
use crate::twins::seen_twice;

impl<P: AsRef<[u8]>> Core<P> {
    /// The direct pass over regions of one frame, as many at once as there are threads.
    pub(super) fn measure_regions(&mut self, order: FrameOrder, outputs: &mut Outputs) {
        let taken = self.frames.take_regions(order, self.tracker.threads.max(1));
        let Some(frame) = self.frames.get_mut(order) else { return };
        let stamp = frame.stamp;
        let time = time_of(&stamp);
        let (reader, tracker) = (&mut self.reader, &mut self.tracker);
        let found = frame.with_parts(|frame, parts| {
            let regions: Vec<(usize, BestView<'_>)> =
                reader.regions(&frame.held, &taken, tracker.camera());
            let updates = tracker.direct_pass(time, parts, &regions).into_iter();
            let caused = updates.filter_map(|update| {
                let (_, last) = regions.iter().rfind(|(target, _)| *target == update.0)?;
                Some((
                    update,
                    Cause::View { issued_ns: frame.views.get(&last.view_index)?.issued_ns },
                ))
            });
            caused.collect::<Vec<_>>()
        });
        if self.schedule.is_flight() {
            found.into_iter().for_each(|found| self.publish(&stamp, vec![found], outputs));
        } else {
            // They wait until the frame is complete. Their order must not depend on the speed of
            // threads, so `OpenFrame::take_found` sorts them.
            frame.found.extend(found);
        }
        self.frames.answer_seen(order);
    }

    /// The corner pass over records of a frame: over those of the views `searched`, or over all
    /// that count. `pass` is its kind, region or complete. Publishes the results.
    pub(super) fn measure(
        &mut self,
        order: FrameOrder,
        pass: Pass,
        searched: Option<Vec<u32>>,
        outputs: &mut Outputs,
    ) {
        let Some(stamp) = self.frames.get(order).map(|frame| frame.stamp) else { return };
        let (time, budget) = (time_of(&stamp), self.budget(&stamp));
        let Some(frame) = self.frames.get_mut(order) else { return };
        let (reader, tracker) = (&mut self.reader, &mut self.tracker);
        let notices = &mut outputs.notices;
        let updates = frame.with_parts(|frame, parts| {
            let mut best_views = reader.best_views(&frame.held, tracker.camera());
            let views = searched.clone().unwrap_or_else(|| {
                let counted: Vec<u32> = frame.counted_views().collect();
                best_views.retain(|_, best| counted.contains(&best.view_index));
                counted
            });
            let answered = views.iter().filter_map(|index| answered(frame, *index));
            let answered: Vec<AnsweredView<'_>> = answered.collect();
            match pass {
                Pass::Complete => {
                    let markers = || answered.iter().flat_map(|answer| &answer.record.markers);
                    let targets = tracker.targets().iter();
                    notices
                        .extend(targets.filter_map(|target| seen_twice(&target.body, markers())));
                    tracker.final_pass(time, parts, &answered, &best_views, budget)
                }
                _ => tracker.region_pass(time, parts, &answered, &best_views, budget),
            }
        });
        let attempts = self.tracker.take_attempts();
        if let Schedule::Virtual(clock) = &mut self.schedule {
            clock.spend(attempts);
        }
        self.begin_background(outputs);
        self.publish_updates(order, updates, searched.as_deref(), outputs);
    }

    /// Searches some places of a complete frame for one of the targets that were not measured.
    /// Returns whether there were both. All places together would take longer than the watchdog's
    /// timeout.
    pub(super) fn search_a_place(&mut self, order: FrameOrder, outputs: &mut Outputs) -> bool {
        let Some(frame) = self.frames.get_mut(order) else { return false };
        let untracked = self.tracker.untracked(&frame.parts);
        let Some(target) = frame.places.next_target(untracked) else { return false };
        let time = time_of(&frame.stamp);
        let (reader, tracker) = (&mut self.reader, &mut self.tracker);
        let update = frame.with_parts(|frame, parts| {
            let views = reader.places(frame.places.next(), tracker.camera());
            tracker.place_pass(time, parts, target, &views)
        });
        self.publish_updates(order, update.into_iter().collect(), None, outputs);
        true
    }

    /// Publishes the results of the views `searched`, or of the whole frame.
    pub(super) fn publish_updates(
        &mut self,
        order: FrameOrder,
        updates: Vec<Update>,
        searched: Option<&[u32]>,
        outputs: &mut Outputs,
    ) {
        let Some(frame) = self.frames.get(order) else { return };
        let stamp = frame.stamp;
        let records: Vec<&Record> = match searched {
            Some(views) => views.iter().filter_map(|index| frame.records.get(index)).collect(),
            None => frame.records.values().collect(),
        };
        let caused = |update: Update| {
            let body = &self.tracker.targets()[update.0].body;
            (update, Cause::of_records(&records, body))
        };
        let updates = updates.into_iter().map(caused).collect();
        self.publish(&stamp, updates, outputs);
    }
}

/// The record of a view, with the view if it has arrived.
fn answered<P>(frame: &OpenFrame<P>, view_index: u32) -> Option<AnsweredView<'_>> {
    Some(AnsweredView {
        record: frame.records.get(&view_index)?,
        purpose: frame.purpose_of(view_index),
        view: frame.views.get(&view_index),
    })
}
