//! The measurement passes that the core runs, with the inputs that it holds for them.

use std::collections::BTreeMap;

use flockeye_contract::{FrameOrder, FrameStamp, ViewHeader};

use super::{Core, Outputs, Pass, time_of};
use crate::frame_assembly::{Frame, Record};
use crate::output::Cause;
use crate::passes::AnsweredView;
use crate::passes::corners::records_that_count;
use crate::passes::direct::Region;
use crate::pictures::Pixels;
use crate::schedule::Schedule;
use crate::target::Update;

impl<P: Pixels> Core<P> {
    /// Direct passes over regions of one frame, as many at once as there are threads.
    pub(super) fn direct_pass(&mut self, outputs: &mut Outputs) {
        let (first, _) = self.cut_regions[0];
        let same = self.cut_regions.iter().take_while(|(order, _)| *order == first).count();
        let views: Vec<(FrameOrder, u32)> =
            self.cut_regions.drain(..same.min(self.tracker.threads().max(1))).collect();
        self.measure_regions(&views, outputs);
        for (order, view_index, shows) in std::mem::take(&mut self.shown) {
            if self.cut_regions.contains(&(order, view_index)) {
                self.shown.push((order, view_index, shows));
            } else {
                self.cache.answered(order, view_index, &shows);
            }
        }
    }

    /// The direct pass over regions of one frame.
    fn measure_regions(&mut self, views: &[(FrameOrder, u32)], outputs: &mut Outputs) {
        let read = self.reader.regions(&self.cache, views);
        let Some(stamp) = read.first().map(|(header, _)| header.stamp) else { return };
        let time = time_of(&self.planning, &stamp);
        let headers: BTreeMap<usize, ViewHeader> =
            read.iter().map(|(header, region)| (region.target, *header)).collect();
        let regions: Vec<Region<'_>> = read.into_iter().map(|(_, region)| region).collect();
        let updates = self.tracker.direct_pass(time, &regions);
        for update in updates {
            let Some(header) = headers.get(&update.0) else { continue };
            let found = (update, Cause::of_view(header));
            match self.schedule.is_flight() {
                true => self.publish(&stamp, vec![found], outputs),
                // Their order must not depend on who is faster.
                false => self.found.push(found),
            }
        }
    }

    /// Corner passes over the regions of one frame that have been searched.
    pub(super) fn region_pass(&mut self, outputs: &mut Outputs) {
        let oldest = self.searched.iter().map(|record| record.header.stamp);
        let Some(stamp) = oldest.min_by_key(FrameStamp::order) else { return };
        let (records, others): (Vec<Record>, Vec<Record>) = std::mem::take(&mut self.searched)
            .into_iter()
            .partition(|record| record.header.stamp.order() == stamp.order());
        self.searched = others;
        let Some(frame) = self.assembly.open_frame(&stamp) else { return };
        let answered: Vec<AnsweredView<'_>> = records
            .iter()
            .filter(|record| record.header.stamp.is_same_frame(&stamp))
            .map(|record| {
                let (plan_id, index) = (record.header.plan_id, record.header.view_index);
                let view = frame.views.get(&index);
                let purpose = self.planning.purpose_of(plan_id, index, view);
                AnsweredView { record, purpose, view }
            })
            .collect();
        let (time, budget) = (time_of(&self.planning, &stamp), self.budget(&stamp));
        let best_views = self.reader.best_views(&self.cache, stamp.order());
        let updates = self.tracker.region_pass(time, &answered, &best_views, budget);
        drop(best_views);
        let records: Vec<&Record> = records.iter().collect();
        let updates = self.caused_by(updates, &records);
        self.publish(&stamp, updates, outputs);
    }

    /// Runs a pass over all of a complete frame, and publishes what it finds.
    pub(super) fn measure(&mut self, frame: &Frame, outputs: &mut Outputs, pass: Pass) {
        let (purposes, stop_rule) = self.planning.purposes_of(frame);
        let counted = records_that_count(frame, stop_rule);
        let answered: Vec<AnsweredView<'_>> = counted
            .iter()
            .map(|record| AnsweredView {
                record,
                purpose: purposes.get(&record.header.view_index).copied(),
                view: frame.views.get(&record.header.view_index),
            })
            .collect();
        let (time, budget) = (time_of(&self.planning, &frame.stamp), self.budget(&frame.stamp));
        let mut best_views = self.reader.best_views(&self.cache, frame.stamp.order());
        let counts =
            |view_index| counted.iter().any(|record| record.header.view_index == view_index);
        best_views.retain(|_, best| counts(best.view_index));
        let updates = pass(&mut self.tracker, time, &answered, &best_views, budget);
        drop(best_views);
        let attempts = self.tracker.take_attempts();
        if let Schedule::Virtual(clock) = &mut self.schedule {
            clock.spend(attempts);
        }
        self.begin_background(outputs);
        let records: Vec<&Record> = frame.records.values().collect();
        let updates = self.caused_by(updates, &records);
        self.publish(&frame.stamp, updates, outputs);
    }

    /// Looks at some places of a complete frame for one of the targets that nothing else has found, and says whether there
    /// were both. All together would take longer than a stage may go without a sign of life.
    pub(super) fn search_a_place(&mut self, frame: &Frame, outputs: &mut Outputs) -> bool {
        let Some(places) = &mut self.places else { return false };
        let order = frame.stamp.order();
        let untracked = self.tracker.untracked(order);
        let Some(target) = places.next_target(order, untracked) else { return false };
        let views: Vec<_> = places.next(order).collect();
        let some = self.reader.places(&views);
        let time = time_of(&self.planning, &frame.stamp);
        let updates: Vec<Update> =
            self.tracker.place_pass(time, target, &some).into_iter().collect();
        let records: Vec<&Record> = frame.records.values().collect();
        let updates = self.caused_by(updates, &records);
        self.publish(&frame.stamp, updates, outputs);
        true
    }
}
