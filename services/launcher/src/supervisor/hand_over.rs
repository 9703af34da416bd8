//! The current hand-over, which selects the process that counts. A copy is kept for a later
//! launcher.

use std::path::{Path, PathBuf};

use flockeye_contract::{HandOver, HandOverState, HandOvers};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::kept;
use flockeye_runtime::ports::{PortError, Ports, Publisher};
use flockeye_runtime::whole_file::write_whole;

use crate::control::WorkerName;
use crate::fault_point;

/// Publisher of hand-overs, with the last one.
pub(super) struct HandOverNotice {
    publisher: Publisher<HandOvers>,
    current: HandOver,
    folder: PathBuf,
    /// Whether a copy is kept, because the stages fly on when this launcher dies.
    is_kept: bool,
}

impl HandOverNotice {
    /// Starts without a hand-over: all processes count.
    pub(super) fn open(
        ports: &mut Ports,
        instance: &Instance,
        is_kept: bool,
    ) -> Result<Self, PortError> {
        let folder = instance.folder().to_owned();
        Ok(Self { publisher: ports.publisher()?, current: HandOver::default(), folder, is_kept })
    }

    /// Sends the hand-over to readers that have joined since the last call.
    pub(super) fn update_connections(&self) -> Result<(), PortError> {
        self.publisher.update_connections()
    }

    /// Applies the hand-over to the ports of this process, and publishes it to all others.
    pub(super) fn announce(&mut self, ports: &Ports, hand_over: HandOver) -> anyhow::Result<()> {
        let step = match HandOverState::try_from(hand_over.state)? {
            HandOverState::TakenOver if hand_over.new_generation < hand_over.old_generation => {
                "taking back"
            }
            HandOverState::TakenOver => "taking over",
            HandOverState::Shadow => "the shadow",
            HandOverState::Nothing => "the end",
        };
        self.current = hand_over;
        // The copy is written before the message is sent: a hand-over that is sent twice does no
        // harm.
        if self.is_kept
            && let Err(error) = write_whole(&file(&self.folder), bytemuck::bytes_of(&hand_over))
        {
            tracing::warn!("the hand-over is not kept for a later launcher: {error}");
        }
        fault_point::pass(&self.folder, &format!("{step} is written"));
        ports.listening().set(hand_over);
        self.publisher.send(hand_over, &[])?;
        fault_point::pass(&self.folder, &format!("{step} is said"));
        Ok(())
    }

    /// Whether some process does not count.
    pub(super) fn is_under_way(&self) -> bool {
        self.current.state != HandOverState::Nothing.code()
    }
}

fn file(folder: &Path) -> PathBuf {
    kept::folder(folder).join("hand_over")
}

/// The last hand-over of an earlier launcher.
pub(super) fn read(folder: &Path) -> HandOver {
    let bytes = std::fs::read(file(folder)).unwrap_or_default();
    bytemuck::try_pod_read_unaligned(&bytes).unwrap_or_default()
}

/// Generation of a worker that counts, if the hand-over is about that worker.
pub(super) fn counting_generation(hand_over: &HandOver, worker: WorkerName) -> Option<u32> {
    if !hand_over.is_about(worker.stage, worker.replica) {
        return None;
    }
    match HandOverState::try_from(hand_over.state) {
        Ok(HandOverState::Shadow) => Some(hand_over.old_generation),
        Ok(HandOverState::TakenOver) => Some(hand_over.new_generation),
        Ok(HandOverState::Nothing) | Err(_) => None,
    }
}

/// Whether the new process of a worker has taken over.
pub(super) fn has_taken_over(hand_over: &HandOver, worker: WorkerName) -> bool {
    hand_over.is_about(worker.stage, worker.replica)
        && hand_over.state == HandOverState::TakenOver.code()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_hand_over_says_which_of_two_processes_counts() {
        let hand_over =
            |state: HandOverState, [old_generation, new_generation]: [u32; 2]| HandOver {
                stage: "fusion".into(),
                state: state.code(),
                old_generation,
                new_generation,
                ..HandOver::default()
            };
        let fusion = "fusion".parse().unwrap();
        for (found, wanted) in [
            (hand_over(HandOverState::Shadow, [1, 2]), Some(1)),
            (hand_over(HandOverState::TakenOver, [1, 2]), Some(2)),
            (hand_over(HandOverState::TakenOver, [2, 1]), Some(1)),
            (HandOver::default(), None),
        ] {
            assert_eq!(counting_generation(&found, fusion), wanted);
            assert_eq!(counting_generation(&found, "detection".parse().unwrap()), None);
        }
    }
}
