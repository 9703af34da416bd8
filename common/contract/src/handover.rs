//! `handover`: which of two processes of one stage the others listen to while one replaces the other.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::{
    Complaint, ContractError, DetectionHeader, FrameEnd, FrameHeader, FrameOrder, FrameStamp,
    HandOverState, Health, ImuHeader, JournalHeader, OdometrySample, PacketHeader, PeerHeader,
    PlanHeader, Rotation, StageName, SwarmHeader, Text, TrackHeader, TruthHeader, ViewHeader,
};

/// Header of `handover`. No payload. The launcher sends it while it swaps a stage.
///
/// Both processes run side by side and do the same work. Everybody who reads their messages ignores those
/// of the process that does not count for a frame ([`HandOver::admits`]), so no frame is lost and none is
/// answered twice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/HandOver")]
#[repr(C)]
pub struct HandOver {
    /// The first frame of the new process, where `state` is `taken_over`. Only its order counts.
    pub first: FrameStamp,
    /// When it was sent, CLOCK_MONOTONIC, nanoseconds.
    pub sent_ns: i64,
    /// The stage's name in pipeline.yaml.
    pub stage: Text<32>,
    /// Which of its workers, from 0.
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
pub struct Speaker {
    /// The stage.
    pub stage: StageName,
    /// Which of its workers.
    pub replica: u32,
    /// How often its process was replaced.
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

    /// Whether what `speaker` says counts for everybody else.
    ///
    /// Processes of other generations than the two are replacements after a crash: one that is newer than
    /// the new process counts as that, all others as the old one.
    pub fn admits(&self, speaker: &Speaker) -> bool {
        if !self.is_about(speaker.stage, speaker.replica) {
            return true;
        }
        let has_newer = self.new_generation > self.old_generation;
        let is_new = speaker.generation == self.new_generation
            || (has_newer && speaker.generation > self.new_generation);
        match HandOverState::try_from(self.state) {
            Ok(HandOverState::Shadow) => !is_new,
            Ok(HandOverState::TakenOver) => is_new == (speaker.frame >= self.first.order()),
            Ok(HandOverState::Nothing) | Err(_) => true,
        }
    }
}

/// A header whose messages may come from two processes of a stage at once.
pub trait Spoken {
    /// Who sent the message; for an answer, also who asked. None for topics whose stages never run twice.
    fn speakers(&self) -> [Option<Speaker>; 2] {
        [None, None]
    }
}

fn only(stage: StageName, generation: u32, stamp: &FrameStamp) -> [Option<Speaker>; 2] {
    [Some(Speaker { stage, replica: 0, generation, frame: stamp.order() }), None]
}

impl Spoken for FrameHeader {}
impl Spoken for ImuHeader {}
impl Spoken for PacketHeader {}
impl Spoken for JournalHeader {}
impl Spoken for Health {}
impl Spoken for TruthHeader {}
impl Spoken for HandOver {}
impl Spoken for Complaint {}
impl Spoken for OdometrySample {}
impl Spoken for PeerHeader {}
impl Spoken for SwarmHeader {}

impl Spoken for Rotation {
    fn speakers(&self) -> [Option<Speaker>; 2] {
        only(StageName::Egomotion, self.generation, &self.stamp)
    }
}

impl Spoken for PlanHeader {
    fn speakers(&self) -> [Option<Speaker>; 2] {
        only(StageName::Fusion, self.generation, &self.after)
    }
}

impl Spoken for TrackHeader {
    fn speakers(&self) -> [Option<Speaker>; 2] {
        only(StageName::Fusion, self.generation, &self.stamp)
    }
}

impl Spoken for ViewHeader {
    fn speakers(&self) -> [Option<Speaker>; 2] {
        only(StageName::Rectification, self.generation, &self.stamp)
    }
}

impl Spoken for FrameEnd {
    fn speakers(&self) -> [Option<Speaker>; 2] {
        only(StageName::Rectification, self.generation, &self.stamp)
    }
}

impl Spoken for DetectionHeader {
    fn speakers(&self) -> [Option<Speaker>; 2] {
        let [asking, _] = only(StageName::Rectification, self.view_generation, &self.stamp);
        let answering = Speaker {
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

    fn speaker(generation: u32, sequence: u64) -> Speaker {
        Speaker { stage: StageName::Detection, replica: 1, generation, frame: (0, 0, sequence) }
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
            let [old, new] = [speaker(4, frame), speaker(5, frame)];
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
            assert_eq!(back.admits(&speaker(4, frame)), frame >= 15);
            assert_eq!(back.admits(&speaker(5, frame)), frame < 15);
        }
    }

    #[test]
    fn others_are_not_touched() {
        let shadow = hand_over(HandOverState::Shadow, 0);
        assert!(shadow.admits(&Speaker { replica: 0, ..speaker(5, 3) }));
        assert!(shadow.admits(&Speaker { stage: StageName::Fusion, ..speaker(5, 3) }));
        assert!(HandOver::default().admits(&speaker(5, 3)));
    }

    #[test]
    fn an_answer_counts_by_who_asked_and_who_answered() {
        let header = DetectionHeader {
            worker: 1,
            generation: 5,
            view_generation: 7,
            ..DetectionHeader::default()
        };
        let speakers = header.speakers().map(|speaker| speaker.map(|of| (of.stage, of.generation)));
        assert_eq!(
            speakers,
            [Some((StageName::Detection, 5)), Some((StageName::Rectification, 7))]
        );
    }
}
