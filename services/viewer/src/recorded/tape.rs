//! Reads a recording forward from a time, and returns each frame that ends.

use std::collections::VecDeque;
use std::sync::Arc;

use flockeye_recording::IndexedMessage;

use super::Recorded;
use crate::scene::{EndedFrame, PageScene};
use crate::wire::{DroneSummary, ProcessReport, SightingSummary};

/// A position in a recording, and the scene there.
pub(crate) struct SceneTape {
    recorded: Arc<Recorded>,
    scene: PageScene,
    waiting: VecDeque<IndexedMessage>,
    next_chunk: usize,
    trouble: Option<String>,
}

impl SceneTape {
    /// Starts at the first chunk that may hold messages of this time.
    pub(crate) fn at(recorded: Arc<Recorded>, utc_ns: u64) -> Self {
        Self {
            scene: PageScene::new(recorded.is_real_time()),
            waiting: VecDeque::new(),
            next_chunk: recorded.recording.chunk_at(utc_ns),
            trouble: None,
            recorded,
        }
    }

    /// The next frame that ended until `until_ns`. `None`: all frames before that time were taken.
    pub(crate) fn next_until(&mut self, until_ns: u64) -> Option<EndedFrame> {
        loop {
            while let Some(message) = self.waiting.front() {
                if message.utc_ns > until_ns {
                    return None;
                }
                let message = self.waiting.pop_front()?;
                if let Some(seen) = self.take(&message) {
                    return Some(seen);
                }
            }
            let recording = &self.recorded.recording;
            let next = recording.chunks().get(self.next_chunk)?;
            if next.first_ns > until_ns {
                return None;
            }
            let channels = &self.recorded.channels;
            match recording.messages(self.next_chunk, |channel| channels.is_of_scene(channel)) {
                Ok(messages) => self.waiting = messages.into(),
                // The following chunks are intact.
                Err(error) => self.trouble = Some(format!("{error}; what lies round it is shown")),
            }
            self.next_chunk += 1;
        }
    }

    /// The reason why a chunk could not be read, if it is new.
    pub(crate) fn trouble(&mut self) -> Option<String> {
        self.trouble.take()
    }

    /// Reports of the stages until this time.
    pub(crate) fn stages(&mut self, utc_ns: u64) -> Vec<ProcessReport> {
        self.scene.stages(self.recorded.monotonic_ns(utc_ns))
    }

    /// Poses and sightings of the swarm at this time.
    pub(crate) fn swarm(
        &mut self,
        utc_ns: u64,
    ) -> Option<(Vec<DroneSummary>, Vec<SightingSummary>)> {
        self.scene.swarm(self.recorded.monotonic_ns(utc_ns))
    }

    fn take(&mut self, message: &IndexedMessage) -> Option<EndedFrame> {
        let Self { recorded, scene, .. } = self;
        let (header, tracks) = recorded.channels.hand_on(message, scene)?;
        let now_ns = recorded.monotonic_ns(message.utc_ns);
        let mut ended = scene.tracks(&header, &tracks, now_ns)?;
        ended.message.at_s = Some(recorded.seconds(message.utc_ns));
        ended.utc_ns = message.utc_ns;
        Some(ended)
    }
}
