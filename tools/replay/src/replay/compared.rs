//! Compares the recorded messages of fusion with the replayed ones.

use std::collections::VecDeque;

use anyhow::Context;
use flockeye_contract::{PlanHeader, Plans, Topic, TrackHeader, Tracks};
use flockeye_recording::message::first_difference;
use flockeye_recording::{ContractMessage, TopicLayout, layouts};

use crate::recorded::{contract_message, header};

/// The messages of both topics.
pub(super) struct MessageComparison {
    pub tracks: Pairs,
    pub plans: Pairs,
    /// Number of replayed plans that were not recorded.
    pub lost_plans: u64,
}

/// Recorded and replayed messages of a topic.
pub(super) struct Pairs {
    layout: TopicLayout,
    recorded: VecDeque<ContractMessage>,
    given: VecDeque<ContractMessage>,
}

impl MessageComparison {
    /// Begins before the first message.
    pub(super) fn new() -> anyhow::Result<Self> {
        Ok(Self { tracks: Pairs::of::<Tracks>()?, plans: Pairs::of::<Plans>()?, lost_plans: 0 })
    }

    /// Compares the messages that have a counterpart. Returns their number and the first
    /// difference.
    pub(super) fn compare(&mut self) -> (u64, Option<String>) {
        let (tracks, differs) =
            self.tracks.compare(|message| header::<TrackHeader>(message).stamp.sequence);
        if differs.is_some() {
            return (tracks, differs);
        }
        let mut plans = 0;
        loop {
            self.leave_out_lost_plans();
            let after = |message: &ContractMessage| header::<PlanHeader>(message).after.sequence;
            let (compared, differs) = self.plans.compare_next(after);
            plans += compared;
            if compared == 0 || differs.is_some() {
                return (tracks + plans, differs);
            }
        }
    }

    /// Drops replayed plans that were not recorded. Numbers of plans rise by one, so gaps are
    /// visible.
    fn leave_out_lost_plans(&mut self) {
        let number = |message: &ContractMessage| header::<PlanHeader>(message).plan_id;
        let Some(recorded) = self.plans.recorded.front().map(number) else { return };
        while self.plans.given.front().is_some_and(|given| number(given) < recorded) {
            self.plans.given.pop_front();
            self.lost_plans += 1;
        }
    }

    /// Whether all replayed messages were compared.
    pub(super) fn is_done(&self) -> bool {
        self.tracks.given.is_empty() && self.plans.given.is_empty()
    }

    /// The number of recorded messages that were not compared.
    pub(super) fn left(&self) -> u64 {
        (self.tracks.recorded.len() + self.plans.recorded.len()) as u64
    }
}

impl Pairs {
    fn of<T: Topic>() -> anyhow::Result<Self> {
        let layout = layouts().into_iter().find(|layout| layout.service == T::NAME);
        let layout = layout.context("a topic is not in the contract")?;
        Ok(Self { layout, recorded: VecDeque::new(), given: VecDeque::new() })
    }

    /// Takes a recorded message.
    pub(super) fn record(&mut self, message: ContractMessage) {
        self.recorded.push_back(message);
    }

    /// Takes a message of the replayed core.
    pub(super) fn give<H: bytemuck::Pod, I: bytemuck::Pod>(&mut self, header: &H, items: &[I]) {
        self.given.push_back(contract_message(header, items));
    }

    fn compare(&mut self, frame_of: impl Fn(&ContractMessage) -> u64) -> (u64, Option<String>) {
        let mut compared = 0;
        loop {
            let (more, differs) = self.compare_next(&frame_of);
            compared += more;
            if more == 0 || differs.is_some() {
                return (compared, differs);
            }
        }
    }

    /// Compares the next pair, if both messages exist.
    fn compare_next(
        &mut self,
        frame_of: impl Fn(&ContractMessage) -> u64,
    ) -> (u64, Option<String>) {
        if self.recorded.is_empty() || self.given.is_empty() {
            return (0, None);
        }
        let (Some(recorded), Some(given)) = (self.recorded.pop_front(), self.given.pop_front())
        else {
            return (0, None);
        };
        let found = first_difference(&self.layout, &recorded, &given);
        let (service, frame) = (self.layout.service, frame_of(&recorded));
        let said =
            found.map(|found| format!("{service} of frame {frame}, recorded and given: {found}"));
        (1, said)
    }
}
