//! An overview of a recording: its time in equal parts, each with its worst values.

use std::collections::BTreeMap;

use flockeye_contract::{FrameStamp, TopicId, Track, TrackState};
use flockeye_recording::losses::{Loss, decode_loss};

use super::Recorded;
use crate::scene::latency_ms;
use crate::wire;

/// Number of parts, about as many as a page has pixels for.
const PARTS: usize = 800;

/// Builds an overview in one pass over the file.
pub(crate) struct OverviewMaker<'r> {
    recorded: &'r Recorded,
    next_chunk: usize,
    latency_ms: Vec<Option<[Option<f32>; 5]>>,
    states: BTreeMap<u32, Vec<Option<TrackState>>>,
    skipped: Vec<u32>,
    lost: Vec<u32>,
    last: Option<FrameStamp>,
    losses: BTreeMap<String, Loss>,
}

impl<'r> OverviewMaker<'r> {
    /// An empty overview, before the first chunk.
    pub(crate) fn new(recorded: &'r Recorded) -> Self {
        Self {
            recorded,
            next_chunk: 0,
            latency_ms: vec![None; PARTS],
            states: BTreeMap::new(),
            skipped: vec![0; PARTS],
            lost: vec![0; PARTS],
            last: None,
            losses: BTreeMap::new(),
        }
    }

    /// Reads the next chunk. False: there are no more. A damaged chunk is skipped.
    pub(crate) fn read(&mut self) -> bool {
        let Recorded { recording, channels, losses, .. } = self.recorded;
        let chunk = self.next_chunk;
        if chunk >= recording.chunks().len() {
            return false;
        }
        self.next_chunk += 1;
        let is_wanted = |channel| channels.is(channel, TopicId::Tracks) || *losses == Some(channel);
        for message in recording.messages(chunk, is_wanted).unwrap_or_default() {
            let part = self.part(message.utc_ns);
            if *losses == Some(message.channel) {
                if let Ok((topic, loss)) = decode_loss(&message.bytes) {
                    self.loss(part, topic, loss);
                }
            } else if let Some((header, tracks)) = channels.tracks(&message) {
                tracks.iter().for_each(|track| self.track(part, track));
                if header.is_last != 0
                    && let Some(last) = self.last.replace(header.stamp)
                {
                    let skipped = header.stamp.skipped_since(&last);
                    add(&mut self.skipped[part], skipped);
                }
            }
        }
        true
    }

    /// The overview of the chunks that were read so far.
    pub(crate) fn overview(&self) -> wire::Overview {
        let chunks = self.recorded.recording.chunks().len().max(1);
        let states = self.states.iter().map(|(target, states)| wire::TargetStates {
            target: *target,
            states: states.iter().map(|state| state.map(TrackState::name)).collect(),
        });
        let losses = self.losses.iter().filter(|(_, loss)| loss.lost() > 0);
        wire::Overview {
            done: self.next_chunk as f32 / chunks as f32,
            latency_ms: self.latency_ms.clone(),
            states: states.collect(),
            skipped: self.skipped.clone(),
            lost: self.lost.clone(),
            losses: losses
                .map(|(topic, loss)| wire::TopicLoss {
                    topic: topic.clone(),
                    recorded: loss.recorded,
                    lost: loss.lost(),
                })
                .collect(),
        }
    }

    fn part(&self, utc_ns: u64) -> usize {
        let Recorded { first_ns, last_ns, .. } = *self.recorded;
        let span_ns = u128::from(last_ns.saturating_sub(first_ns).max(1));
        let place = u128::from(utc_ns.saturating_sub(first_ns)) * PARTS as u128 / span_ns;
        // The last message of all is in the last part.
        (place as usize).min(PARTS - 1)
    }

    fn track(&mut self, part: usize, track: &Track) {
        let latency = latency_ms(&track.latency);
        let total = |latency: &Option<[Option<f32>; 5]>| latency.and_then(|latency| latency[4]);
        if latency[4].is_some() && total(&Some(latency)) > total(&self.latency_ms[part]) {
            self.latency_ms[part] = Some(latency);
        }
        let Ok(state) = TrackState::try_from(track.state) else { return };
        // Numbers of unknown bodies must not take memory.
        if track.target as usize >= self.recorded.resolved.bodies.len() {
            return;
        }
        let states = self.states.entry(track.target).or_insert_with(|| vec![None; PARTS]);
        if states[part].is_none_or(|before| badness(state) > badness(before)) {
            states[part] = Some(state);
        }
    }

    fn loss(&mut self, part: usize, topic: String, loss: Loss) {
        let before = self.losses.get(&topic).map_or(0, Loss::lost);
        add(&mut self.lost[part], loss.lost().saturating_sub(before));
        // More losses than the contract has topics come from a damaged file.
        if self.losses.len() < 64 || self.losses.contains_key(&topic) {
            self.losses.insert(topic, loss);
        }
    }
}

fn add(sum: &mut u32, more: u64) {
    *sum = sum.saturating_add(u32::try_from(more).unwrap_or(u32::MAX));
}

fn badness(state: TrackState) -> u32 {
    match state {
        TrackState::Confirmed | TrackState::Measured => 0,
        TrackState::Tentative => 1,
        TrackState::Coasting => 2,
        TrackState::Lost => 3,
    }
}
