//! The contract's messages of a recording.

use std::collections::BTreeMap;

use bytemuck::pod_read_unaligned;
use flockeye_contract::{
    Detections, FrameEnds, FrameHeader, Healths, Peers, Plans, Rotations, Swarms, TOPICS, Topic,
    TopicId, Track, TrackHeader, Tracks, Truths,
};
use flockeye_recording::message::decode;
use flockeye_recording::{
    ChannelKind, ContractMessage, IndexedMessage, IndexedRecording, TopicLayout, layouts,
};

use crate::scene::PageScene;

/// The channels with messages of the contract, in the layout that this version reads.
pub(crate) struct ContractChannels {
    known: BTreeMap<u16, (TopicId, TopicLayout)>,
    foreign: Vec<(TopicId, &'static str)>,
}

impl ContractChannels {
    /// Reads the channels of a recording. A topic counts if the file defines its messages as this
    /// version does.
    pub(crate) fn of(recording: &IndexedRecording) -> Self {
        let (mut known, mut foreign) = (BTreeMap::new(), Vec::new());
        for (topic, layout) in TOPICS.iter().zip(layouts()) {
            let kind = ChannelKind::of_topic(&layout);
            for (number, found) in recording.channels() {
                if found.topic != kind.topic {
                    continue;
                }
                if **found == kind {
                    known.insert(*number, (topic.id, layout.clone()));
                } else {
                    foreign.push((topic.id, topic.name));
                }
            }
        }
        Self { known, foreign }
    }

    /// Whether the file defines this topic in another way.
    pub(crate) fn is_foreign(&self, topic: TopicId) -> bool {
        self.foreign.iter().any(|(foreign, _)| *foreign == topic)
    }

    /// Names of the topics that the file defines in another way.
    pub(crate) fn foreign(&self) -> Vec<&'static str> {
        self.foreign.iter().map(|(_, name)| *name).collect()
    }

    /// Whether a channel has messages of this topic.
    pub(crate) fn is(&self, channel: u16, topic: TopicId) -> bool {
        self.known.get(&channel).is_some_and(|(found, _)| *found == topic)
    }

    /// Whether the scene uses this channel's messages.
    pub(crate) fn is_of_scene(&self, channel: u16) -> bool {
        let topic = self.known.get(&channel).map(|(topic, _)| *topic);
        matches!(
            topic,
            Some(
                TopicId::Plans
                    | TopicId::Detections
                    | TopicId::FrameEnds
                    | TopicId::Rotations
                    | TopicId::Truths
                    | TopicId::Tracks
                    | TopicId::Healths
                    | TopicId::Peers
                    | TopicId::Swarms
            )
        )
    }

    pub(crate) fn tracks(&self, message: &IndexedMessage) -> Option<(TrackHeader, Vec<Track>)> {
        let (_, layout) = self.known.get(&message.channel)?;
        read::<Tracks>(layout, message)
    }

    pub(crate) fn frame(&self, message: &IndexedMessage) -> Option<FrameHeader> {
        let (_, layout) = self.known.get(&message.channel)?;
        let ContractMessage { header, payload_bytes, .. } = decode(layout, &message.bytes).ok()?;
        let header: FrameHeader = pod_read_unaligned(&header);
        header.check(usize::try_from(payload_bytes).ok()?).ok()?;
        Some(header)
    }

    /// Passes a message to the scene, if it is complete and keeps the contract. Returns tracks.
    pub(crate) fn hand_on(
        &self,
        message: &IndexedMessage,
        scene: &mut PageScene,
    ) -> Option<(TrackHeader, Vec<Track>)> {
        let (topic, layout) = self.known.get(&message.channel)?;
        match topic {
            TopicId::Plans => {
                let (header, views) = read::<Plans>(layout, message)?;
                scene.plan(&header, &views);
            }
            TopicId::Detections => {
                let (header, markers) = read::<Detections>(layout, message)?;
                scene.detection(&header, &markers);
            }
            TopicId::FrameEnds => scene.frame_end(&read::<FrameEnds>(layout, message)?.0),
            TopicId::Rotations => scene.rotation(&read::<Rotations>(layout, message)?.0),
            TopicId::Truths => {
                let (header, bodies) = read::<Truths>(layout, message)?;
                scene.truth(&header, &bodies);
            }
            TopicId::Healths => scene.health(&read::<Healths>(layout, message)?.0),
            TopicId::Peers => {
                let (_, sightings) = read::<Peers>(layout, message)?;
                scene.sightings(&sightings);
            }
            TopicId::Swarms => {
                let (header, poses) = read::<Swarms>(layout, message)?;
                scene.drones(&header, &poses);
            }
            TopicId::Tracks => return read::<Tracks>(layout, message),
            _ => {}
        }
        None
    }
}

/// Decodes a message; none if it is incomplete or breaks the contract.
fn read<T: Topic>(
    layout: &TopicLayout,
    message: &IndexedMessage,
) -> Option<(T::Header, Vec<T::Item>)> {
    let found = decode(layout, &message.bytes).ok()?;
    // `decode` returns exactly as many bytes as the types have.
    let header: T::Header = pod_read_unaligned(&found.header);
    let items: Vec<T::Item> =
        found.items.chunks_exact(size_of::<T::Item>()).map(pod_read_unaligned).collect();
    T::check(&header, &items).ok()?;
    Some((header, items))
}
