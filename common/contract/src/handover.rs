//! `handover`: selects which of two processes of one stage counts while one replaces the other.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::{
    ContractError, DetectionHeader, FrameOrder, FrameStamp, HandOverState, StageName, Text,
};

/// Header of `handover`. No payload. The launcher sends it while it swaps a stage.
///
/// Both processes run side by side and do the same work. Readers of their messages ignore the
/// process that does not count for a frame ([`HandOver::admits`]). So no frame is lost, and none is
/// answered twice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/HandOver")]
#[repr(C)]
pub struct HandOver {
    /// The first frame of the new process, where `state` is `taken_over`. Only its order counts.
    pub first: FrameStamp,
    /// Sending time, CLOCK_MONOTONIC, nanoseconds.
    pub sent_ns: i64,
    /// The stage's name in pipeline.yaml.
    pub stage: Text<32>,
    /// Number of the worker in its stage, from 0.
    pub replica: u32,
    /// Generation of the process that counts up to the frame before `first`.
    pub old_generation: u32,
    /// Generation of the process that counts from `first` on.
    pub new_generation: u32,
    /// A [`HandOverState`].
    pub state: u32,
}

/// Sender of a message, and its frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageSender {
    /// The stage.
    pub stage: StageName,
    /// Number of the worker in its stage.
    pub replica: u32,
    /// Number of replacements of its process.
    pub generation: u32,
    /// The frame.
    pub frame: FrameOrder,
}

impl HandOver {
    /// Refuses an unknown state.
    pub fn check(&self) -> Result<(), ContractError> {
        HandOverState::try_from(self.state)?;
        Ok(())
    }

    /// Whether the hand-over is about this worker of this stage.
    pub fn is_about(&self, stage: StageName, replica: u32) -> bool {
        self.replica == replica && self.stage == Text::from(stage.name())
    }

    /// Whether what `sender` publishes counts for all other processes.
    ///
    /// Processes of other generations are replacements after a crash. One that is newer than the
    /// new process counts as the new one, all others as the old one.
    pub fn admits(&self, sender: &MessageSender) -> bool {
        if !self.is_about(sender.stage, sender.replica) {
            return true;
        }
        let has_newer = self.new_generation > self.old_generation;
        let is_new = sender.generation == self.new_generation
            || (has_newer && sender.generation > self.new_generation);
        match HandOverState::try_from(self.state) {
            Ok(HandOverState::Shadow) => !is_new,
            Ok(HandOverState::TakenOver) => is_new == (sender.frame >= self.first.order()),
            Ok(HandOverState::Nothing) | Err(_) => true,
        }
    }
}

/// The single worker of a stage, as the only sender of a message.
pub(crate) fn only(
    stage: StageName,
    generation: u32,
    stamp: &FrameStamp,
) -> [Option<MessageSender>; 2] {
    [Some(MessageSender { stage, replica: 0, generation, frame: stamp.order() }), None]
}

impl DetectionHeader {
    /// The worker that answered, and the rectification that requested the view.
    pub(crate) fn senders(&self) -> [Option<MessageSender>; 2] {
        let [asking, _] = only(StageName::Rectification, self.view_generation, &self.stamp);
        let answering = MessageSender {
            stage: StageName::Detection,
            replica: self.worker,
            generation: self.generation,
            frame: self.stamp.order(),
        };
        [Some(answering), asking]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sender(generation: u32, sequence: u64) -> MessageSender {
        MessageSender {
            stage: StageName::Detection,
            replica: 1,
            generation,
            frame: (0, 0, sequence),
        }
    }

    fn hand_over(state: HandOverState, first: u64) -> HandOver {
        HandOver {
            first: FrameStamp { sequence: first, ..FrameStamp::default() },
            stage: "detection".into(),
            replica: 1,
            old_generation: 4,
            new_generation: 5,
            state: state.code(),
            ..HandOver::default()
        }
    }

    #[test]
    fn each_frame_is_answered_by_one_of_the_two() {
        for frame in 0..20 {
            let [old, new] = [sender(4, frame), sender(5, frame)];
            let shadow = hand_over(HandOverState::Shadow, 0);
            assert!(shadow.admits(&old) && !shadow.admits(&new));
            let taken_over = hand_over(HandOverState::TakenOver, 10);
            assert_eq!(taken_over.admits(&new), frame >= 10);
            assert_eq!(taken_over.admits(&old), frame < 10);
        }
    }

    #[test]
    fn a_hand_over_that_is_taken_back_has_the_old_process_again() {
        let back = HandOver {
            old_generation: 5,
            new_generation: 4,
            ..hand_over(HandOverState::TakenOver, 15)
        };
        for frame in 0..20 {
            assert_eq!(back.admits(&sender(4, frame)), frame >= 15);
            assert_eq!(back.admits(&sender(5, frame)), frame < 15);
        }
    }

    #[test]
    fn others_are_not_touched() {
        let shadow = hand_over(HandOverState::Shadow, 0);
        assert!(shadow.admits(&MessageSender { replica: 0, ..sender(5, 3) }));
        assert!(shadow.admits(&MessageSender { stage: StageName::Fusion, ..sender(5, 3) }));
        assert!(HandOver::default().admits(&sender(5, 3)));
    }

    #[test]
    fn an_answer_counts_by_who_asked_and_who_answered() {
        let header = DetectionHeader {
            worker: 1,
            generation: 5,
            view_generation: 7,
            ..DetectionHeader::default()
        };
        let senders = header.senders().map(|sender| sender.map(|of| (of.stage, of.generation)));
        assert_eq!(senders, [Some((StageName::Detection, 5)), Some((StageName::Rectification, 7))]);
    }
}
