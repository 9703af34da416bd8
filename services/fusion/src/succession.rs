//! Storage of fusion's state, and its use by a successor.

use std::time::Duration;

use flockeye_runtime::clock;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::saved_state::{SavedStates, StateKeeper};

use crate::core::Core;
use crate::snapshot::Snapshot;

/// Saves the state of one process after each frame.
#[derive(Debug)]
pub(crate) struct Succession {
    /// `None` if the file could not be made. Fusion works without it.
    keeper: Option<StateKeeper>,
    failures: Throttle,
    /// Whether the core continues another process.
    pub(crate) has_resumed: bool,
}

impl Succession {
    /// Loads the state of the worker's last process into `core`. Tracks older than `longest` are
    /// over. Published frames are not published again. Without a saved state, the core starts
    /// empty, as at the pipeline's start.
    pub(crate) fn begin<P: AsRef<[u8]>>(
        core: &mut Core<P>,
        states: &SavedStates,
        longest: Duration,
    ) -> Self {
        let mut has_resumed = false;
        match states.newest(clock::monotonic_ns()) {
            Ok(None) => {}
            Err(error) => {
                tracing::warn!(%error, "the last process's state cannot be read; starting anew")
            }
            Ok(Some(saved)) => match Snapshot::from_bytes(&saved.state) {
                Err(error) => tracing::warn!(
                    generation = saved.generation,
                    %error,
                    "the last process's state is not used; starting anew"
                ),
                Ok(snapshot) => {
                    has_resumed = true;
                    let is_fresh = saved.age <= longest;
                    let snapshot = if is_fresh { snapshot } else { snapshot.without_tracks() };
                    tracing::info!(
                        generation = saved.generation,
                        age_ms = saved.age.as_millis() as u64,
                        tracks = core.resume(snapshot).join(", "),
                        "going on where the last process was"
                    );
                }
            },
        }
        let keeper = states.keeper();
        if let Err(error) = &keeper {
            tracing::warn!(%error, "there is no file for the state; a successor will start anew");
        }
        Self { keeper: keeper.ok(), failures: Throttle::default(), has_resumed }
    }

    /// Saves the state of `core`.
    pub(crate) fn save<P: AsRef<[u8]>>(&mut self, core: &Core<P>) {
        let Some(keeper) = &mut self.keeper else { return };
        let saved = core.snapshot().to_bytes();
        let saved = saved.and_then(|state| Ok(keeper.save(clock::monotonic_ns(), &state)?));
        if let Err(error) = saved
            && let Some(more) = self.failures.admit()
        {
            tracing::warn!(more_since = more, "the state cannot be saved: {error:#}");
        }
    }
}
