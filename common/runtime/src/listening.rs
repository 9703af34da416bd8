//! Selection of the messages that count for a process while the launcher swaps a stage, and
//! complaints to the launcher.

use std::cell::{Cell, RefCell};

use flockeye_contract::{Complaint, ComplaintKind, HandOver, MessageSender, StageName, Text};

use crate::clock;

/// Returns the launcher's newest announcement, if there is one since the last call.
type HandOverSource = Box<dyn FnMut() -> Option<HandOver>>;

/// Sends a complaint to the launcher.
type ComplaintSink = Box<dyn Fn(Complaint)>;

/// Filter of the messages that count for this process. All its ports share one.
#[derive(Default)]
pub struct Listening {
    /// Stage, worker and generation of this process; none for tools.
    own: Option<(StageName, u32, u32)>,
    current: Cell<HandOver>,
    /// `None` in the launcher, which decides and sets `current` itself.
    hand_overs: RefCell<Option<HandOverSource>>,
    complaints: RefCell<Option<ComplaintSink>>,
}

impl Listening {
    /// Filter for worker `replica` of `stage` in this generation.
    pub(crate) fn of_stage(stage: StageName, replica: u32, generation: u32) -> Self {
        Self { own: Some((stage, replica, generation)), ..Self::default() }
    }

    /// Follows the launcher's announcements from now on.
    pub(crate) fn follow(&self, hand_overs: impl FnMut() -> Option<HandOver> + 'static) {
        *self.hand_overs.borrow_mut() = Some(Box::new(hand_overs));
    }

    /// Sends complaints by `sink` from now on.
    pub(crate) fn complain_by(&self, sink: impl Fn(Complaint) + 'static) {
        *self.complaints.borrow_mut() = Some(Box::new(sink));
    }

    /// Sets the current hand-over.
    pub fn set(&self, hand_over: HandOver) {
        self.current.set(hand_over);
    }

    /// Whether a message of these senders counts for this process.
    pub(crate) fn admits(&self, senders: [Option<MessageSender>; 2]) -> bool {
        if senders[0].is_none() {
            return true;
        }
        self.update();
        let hand_over = self.current.get();
        senders.into_iter().flatten().all(|sender| match self.own {
            // A process in the shadow needs the answers to its own views as well.
            Some((StageName::Detection, ..)) => true,
            Some((stage, replica, generation))
                if (stage, replica) == (sender.stage, sender.replica)
                    && hand_over.is_about(stage, replica) =>
            {
                sender.generation == generation
            }
            _ => hand_over.admits(&sender),
        })
    }

    fn update(&self) {
        let mut hand_overs = self.hand_overs.borrow_mut();
        if let Some(hand_over) = hand_overs.as_mut().and_then(|newest| newest()) {
            self.current.set(hand_over);
        }
    }

    /// Complains to the launcher that worker `replica` of `stage` has answered nothing, for the
    /// `count`-th time.
    pub fn complain_of_silence(&self, stage: StageName, replica: u32, count: u64, detail: &str) {
        self.complain(Complaint {
            stage: stage.name().into(),
            replica,
            count,
            detail: Text::from(detail),
            kind: ComplaintKind::Unanswered.code(),
            ..Complaint::default()
        });
    }

    /// Complains to the launcher that `count` messages of process `pid` were refused.
    pub(crate) fn complain_of_messages(&self, pid: u32, count: u64, detail: &str) {
        self.complain(Complaint {
            pid,
            count,
            detail: Text::from(detail),
            kind: ComplaintKind::Refused.code(),
            ..Complaint::default()
        });
    }

    fn complain(&self, complaint: Complaint) {
        if let Some(send) = &*self.complaints.borrow() {
            send(Complaint { sent_ns: clock::monotonic_ns(), ..complaint });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::{
        DetectionHeader, Detections, HandOverState, PlanHeader, Plans, Topic, ViewHeader, Views,
    };

    fn shadow(stage: StageName) -> HandOver {
        HandOver {
            stage: stage.name().into(),
            old_generation: 0,
            new_generation: 1,
            state: HandOverState::Shadow.code(),
            ..HandOver::default()
        }
    }

    #[test]
    fn a_process_in_the_shadow_hears_the_answers_to_its_own_views() {
        let answer = |view_generation| DetectionHeader { view_generation, ..Default::default() };
        for (generation, wanted) in [(0, [true, false]), (1, [false, true])] {
            let listening = Listening::of_stage(StageName::Rectification, 0, generation);
            listening.set(shadow(StageName::Rectification));
            assert_eq!(
                [0, 1].map(|asking| listening.admits(Detections::senders(&answer(asking)))),
                wanted
            );
        }
        let fusion = Listening::of_stage(StageName::Fusion, 0, 0);
        fusion.set(shadow(StageName::Rectification));
        assert_eq!(
            [0, 1].map(|asking| fusion.admits(Detections::senders(&answer(asking)))),
            [true, false]
        );
    }

    #[test]
    fn workers_answer_both_and_others_hear_one() {
        let views = [0, 1].map(|generation| ViewHeader { generation, ..Default::default() });
        let plans = [0, 1].map(|generation| PlanHeader { generation, ..Default::default() });
        let worker = Listening::of_stage(StageName::Detection, 0, 0);
        worker.set(shadow(StageName::Rectification));
        assert_eq!(views.map(|view| worker.admits(Views::senders(&view))), [true, true]);
        let tool = Listening::default();
        assert_eq!(views.map(|view| tool.admits(Views::senders(&view))), [true, true]);
        tool.set(shadow(StageName::Fusion));
        assert_eq!(plans.map(|plan| tool.admits(Plans::senders(&plan))), [true, false]);
    }
}
