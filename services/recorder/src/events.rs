//! What a message means for the recording. It has no port, no clock and no file.

use flockeye_contract::{PacketHeader, TOPICS, TopicId, Track, TrackState};

use crate::entry::Entry;

/// Whether decoding can begin with a packet.
pub(crate) fn begins_video(entry: &Entry) -> bool {
    let header: PacketHeader = bytemuck::pod_read_unaligned(&entry.message.header);
    header.is_key == 1
}

/// Whether a message has the track of a neighbour that is lost.
pub(crate) fn loses_somebody(entry: &Entry) -> bool {
    let mut tracks = entry.message.items.chunks_exact(size_of::<Track>());
    TOPICS[entry.topic].id == TopicId::Tracks
        && tracks.any(|bytes| {
            let track: Track = bytemuck::pod_read_unaligned(bytes);
            track.state == TrackState::Lost.code()
        })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use bytemuck::Zeroable;
    use flockeye_recording::ContractMessage;

    #[test]
    fn only_a_lost_track_is_one() {
        let entry = |id: TopicId, state: TrackState| {
            let track = Track { state: state.code(), ..Track::zeroed() };
            let items = bytemuck::bytes_of(&[Track::zeroed(), track]).to_vec();
            let topic = TOPICS.iter().position(|topic| topic.id == id).unwrap();
            let message = ContractMessage { items, ..ContractMessage::default() };
            Entry { topic, at_ns: 0, message, pixels: None }
        };
        assert!(loses_somebody(&entry(TopicId::Tracks, TrackState::Lost)));
        assert!(!loses_somebody(&entry(TopicId::Tracks, TrackState::Coasting)));
        assert!(!loses_somebody(&entry(TopicId::Plans, TrackState::Lost)));
    }
}
