//! A received message.

use flockeye_contract::{PacketHeader, TOPICS, TopicId, Track, TrackState};
use flockeye_recording::ContractMessage;

/// A message from the receiving thread to the writing thread.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TopicMessage {
    /// Index of the topic in the table of topics.
    pub(crate) topic: usize,
    /// Time of reception, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) at_ns: i64,
    pub(crate) message: ContractMessage,
    /// Pixels, if they are recorded.
    pub(crate) pixels: Option<Vec<u8>>,
}

impl TopicMessage {
    /// Approximate size in memory, bytes.
    pub(crate) fn bytes(&self) -> usize {
        let pixels = self.pixels.as_ref().map_or(0, Vec::len);
        self.message.header.len() + self.message.items.len() + pixels + 128
    }

    /// For a packet: whether it is a key frame, with which decoding can begin.
    pub(crate) fn begins_video(&self) -> bool {
        let header: PacketHeader = bytemuck::pod_read_unaligned(&self.message.header);
        header.is_key == 1
    }

    /// Whether it contains the lost track of a neighbour.
    pub(crate) fn loses_somebody(&self) -> bool {
        let mut tracks = self.message.items.chunks_exact(size_of::<Track>());
        TOPICS[self.topic].id == TopicId::Tracks
            && tracks.any(|bytes| {
                let track: Track = bytemuck::pod_read_unaligned(bytes);
                track.state == TrackState::Lost.code()
            })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn only_a_lost_track_is_one() {
        let entry = |id: TopicId, state: TrackState| {
            let track = Track { state: state.code(), ..Track::zeroed() };
            let items = bytemuck::bytes_of(&[Track::zeroed(), track]).to_vec();
            let topic = TOPICS.iter().position(|topic| topic.id == id).unwrap();
            let message = ContractMessage { items, ..ContractMessage::default() };
            TopicMessage { topic, at_ns: 0, message, pixels: None }
        };
        assert!(entry(TopicId::Tracks, TrackState::Lost).loses_somebody());
        assert!(!entry(TopicId::Tracks, TrackState::Coasting).loses_somebody());
        assert!(!entry(TopicId::Plans, TrackState::Lost).loses_somebody());
    }
}
