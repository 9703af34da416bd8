//! Topics of the dataflow, and the check of each message.

use std::fmt::Debug;

use bytemuck::Pod;
use iceoryx2::prelude::ZeroCopySend;

use crate::handover::only;
use crate::{
    BodyTruth, Complaint, ContractError, DetectedMarker, DetectionHeader, FrameEnd, FrameHeader,
    HandOver, Health, ImuHeader, ImuSample, JournalEntry, JournalHeader, MessageSender,
    OdometrySample, PacketHeader, PeerHeader, PeerSighting, PlanHeader, PlannedView, Rotation,
    StageName, SwarmHeader, SwarmPose, Track, TrackHeader, TruthHeader, ViewHeader,
};

/// Version of everything in this crate. A stage of another version is refused.
pub const CONTRACT_VERSION: &str = "9";

/// The iceoryx2 service attribute that carries [`CONTRACT_VERSION`].
pub const VERSION_ATTRIBUTE: &str = "flockeye.contract";

/// One publish-subscribe service: messages of one header and a slice of items.
pub trait Topic {
    /// The iceoryx2 user header.
    type Header: ZeroCopySend + Pod + Default + Debug;
    /// The iceoryx2 payload is `[Item]`.
    type Item: ZeroCopySend + Pod + Debug;
    /// Name of the service and of the event service that wakes its subscribers.
    const NAME: &'static str;
    /// Its row in the table of all topics.
    const INFO: TopicInfo;

    /// Validates a message before it is read.
    ///
    /// # Errors
    /// The first violation found.
    fn check(header: &Self::Header, items: &[Self::Item]) -> Result<(), ContractError>;

    /// Senders that a hand-over may exclude: the sender of the message and, for an answer, of the
    /// request. None for topics of stages that never run twice at once.
    fn senders(_header: &Self::Header) -> [Option<MessageSender>; 2] {
        [None, None]
    }
}

/// A row of the table of all topics: a topic with its publishers and subscribers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TopicInfo {
    /// Which topic.
    pub id: TopicId,
    /// Name of its service.
    pub name: &'static str,
    /// The stages that publish it.
    pub publishers: &'static [StageName],
    /// The stages that read it. Tools may read any topic.
    pub subscribers: &'static [StageName],
    /// Name of the header's type.
    pub header: &'static str,
    /// Name of the items' type.
    pub item: &'static str,
    /// Bytes of the header.
    pub header_bytes: usize,
    /// Bytes of an item.
    pub item_bytes: usize,
}

impl TopicInfo {
    /// Whether each detection worker has its own service, `NAME/0`, `NAME/1` .... So a slow worker
    /// costs no other its messages.
    pub fn has_lanes(&self) -> bool {
        self.id == TopicId::Views
    }
}

/// Operation on each topic, with its types.
pub trait TopicVisitor {
    /// Error of the operation.
    type Error;

    /// Performs the operation for topic `T`.
    ///
    /// # Errors
    /// Error of the operation; no further topic is visited.
    fn visit<T: Topic + 'static>(&mut self) -> Result<(), Self::Error>;
}

macro_rules! topics {
    ($($(#[$doc:meta])* $name:ident = $service:literal, $header:ty, [$item:ty], [$($publisher:ident),*] => [$($subscriber:ident),*], |$h:ident, $i:ident| $check:expr $(, senders: |$s:ident| $senders:expr)?;)+) => {
        $(
            $(#[$doc])*
            #[derive(Debug, Clone, Copy)]
            pub enum $name {}

            impl Topic for $name {
                type Header = $header;
                type Item = $item;
                const NAME: &'static str = $service;
                const INFO: TopicInfo = TopicInfo {
                    id: TopicId::$name,
                    name: $service,
                    publishers: &[$(StageName::$publisher),*],
                    subscribers: &[$(StageName::$subscriber),*],
                    header: stringify!($header),
                    item: stringify!($item),
                    header_bytes: size_of::<$header>(),
                    item_bytes: size_of::<$item>(),
                };

                fn check($h: &$header, $i: &[$item]) -> Result<(), ContractError> {
                    $check
                }
                $(
                    fn senders($s: &$header) -> [Option<MessageSender>; 2] {
                        $senders
                    }
                )?
            }
        )+

        /// The topics as values.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum TopicId { $($(#[$doc])* $name),+ }

        /// All topics, in the order of the dataflow.
        pub const TOPICS: &[TopicInfo] = &[$($name::INFO),+];

        /// Visits all topics, in the order of the dataflow.
        ///
        /// # Errors
        /// The first error of the visitor.
        pub fn visit_topics<V: TopicVisitor>(visitor: &mut V) -> Result<(), V::Error> {
            $(visitor.visit::<$name>()?;)+
            Ok(())
        }
    };
}

topics! {
    /// Source to rectification: the luma plane of the whole sphere.
    Frames = "flockeye/frame", FrameHeader, [u8],
        [Capture, Simulator] => [Rectification, Egomotion], |header, items| header.check(items.len());
    /// Source to any subscriber: its coded pictures, before decoding.
    Packets = "flockeye/packet", PacketHeader, [u8],
        [Capture] => [], |header, items| header.check(items);
    /// Inertial sensor to egomotion: rotation rate and acceleration of the drone.
    Imus = "flockeye/imu", ImuHeader, [ImuSample],
        [Capture, Simulator, Inertial] => [Egomotion], |header, items| header.check(items);
    /// Egomotion to fusion and the gateway: rotation of the camera since the previous frame.
    Rotations = "flockeye/rotation", Rotation, [u8],
        [Egomotion] => [Fusion, Gateway], |header, _items| header.check(),
        senders: |header| only(StageName::Egomotion, header.generation, &header.stamp);
    /// Fusion to rectification (and, in a lossless run, to the source): the views to cut.
    Plans = "flockeye/plan", PlanHeader, [PlannedView],
        [Fusion] => [Rectification, Capture, Simulator], |header, items| header.check(items),
        senders: |header| only(StageName::Fusion, header.generation, &header.after);
    /// Rectification to detection and fusion: a square pinhole image.
    Views = "flockeye/view", ViewHeader, [u8],
        [Rectification] => [Detection, Fusion], |header, items| header.check(items.len()),
        senders: |header| only(StageName::Rectification, header.generation, &header.stamp);
    /// Detection to rectification and fusion: the markers in a view.
    Detections = "flockeye/detection", DetectionHeader, [DetectedMarker],
        [Detection] => [Rectification, Fusion], |header, items| header.check(items),
        senders: |header| header.senders();
    /// Rectification to fusion: no more views of a frame will come.
    FrameEnds = "flockeye/frame_end", FrameEnd, [u8],
        [Rectification] => [Fusion], |header, _items| header.check(),
        senders: |header| only(StageName::Rectification, header.generation, &header.stamp);
    /// Fusion to the gateway, ROS 2, the autopilot and tools: the neighbours' poses.
    Tracks = "flockeye/track", TrackHeader, [Track],
        [Fusion] => [Autopilot, Gateway, Ros2], |_header, items| items.iter().try_for_each(Track::check),
        senders: |header| only(StageName::Fusion, header.generation, &header.stamp);
    /// Fusion to any subscriber: the inputs of its core, with their order and times.
    Journals = "flockeye/journal", JournalHeader, [JournalEntry],
        [Fusion] => [], |header, items| header.check(items);
    /// Autopilot to the gateway: motion of the observer by its own dead reckoning.
    Odometries = "flockeye/odometry", OdometrySample, [u8],
        [Autopilot] => [Gateway], |header, _items| header.check();
    /// Gateway to ROS 2 and any subscriber: reports of peers.
    Peers = "flockeye/peer", PeerHeader, [PeerSighting],
        [Gateway] => [Ros2], |_header, items| items.iter().try_for_each(PeerSighting::check);
    /// Gateway to any subscriber: poses of all drones of the swarm from here.
    Swarms = "flockeye/swarm", SwarmHeader, [SwarmPose],
        [Gateway] => [], |_header, items| items.iter().try_for_each(SwarmPose::check);
    /// Every stage to the launcher.
    Healths = "flockeye/health", Health, [u8],
        [Capture, Simulator, Inertial, Egomotion, Rectification, Detection, Fusion, Autopilot, Gateway, Ros2] => [], |header, _items| header.check();
    /// Simulator to evaluation.
    Truths = "flockeye/truth", TruthHeader, [BodyTruth],
        [Simulator] => [], |header, items| header.check(items);
    /// Launcher to every stage: selects which of two processes of a stage counts.
    HandOvers = "flockeye/handover", HandOver, [u8],
        [] => [Capture, Simulator, Inertial, Egomotion, Rectification, Detection, Fusion, Autopilot, Gateway, Ros2], |header, _items| header.check();
    /// Every stage to the launcher: a fault of another process.
    Complaints = "flockeye/complaint", Complaint, [u8],
        [Capture, Simulator, Inertial, Egomotion, Rectification, Detection, Fusion, Autopilot, Gateway, Ros2] => [], |header, _items| header.check();
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_stage_is_connected() {
        for stage in StageName::ALL {
            let publishes = TOPICS.iter().any(|topic| topic.publishers.contains(&stage));
            let reads = TOPICS.iter().any(|topic| topic.subscribers.contains(&stage));
            // The inertial sensor is a beginning: it reads nothing.
            assert!(publishes && (reads || stage == StageName::Inertial), "{stage:?}");
            assert_eq!(StageName::from_name(stage.name()), Some(stage));
        }
        assert_eq!(StageName::from_name("fusions"), None);
    }

    #[test]
    fn names_and_order_are_those_of_the_table() {
        let names: BTreeSet<_> = TOPICS.iter().map(|topic| topic.name).collect();
        assert_eq!(names.len(), TOPICS.len());
        struct Names(Vec<&'static str>);
        impl TopicVisitor for Names {
            type Error = ();
            fn visit<T: Topic>(&mut self) -> Result<(), ()> {
                self.0.push(T::NAME);
                Ok(())
            }
        }
        let mut visited = Names(Vec::new());
        assert_eq!(visit_topics(&mut visited), Ok(()));
        assert_eq!(visited.0, TOPICS.iter().map(|topic| topic.name).collect::<Vec<_>>());
    }

    /// What is not in CONTRACT.md cannot be spoken from another language.
    #[test]
    fn the_contract_document_names_every_topic() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/CONTRACT.md");
        let text = std::fs::read_to_string(path).expect("CONTRACT.md is in the repository");
        for topic in TOPICS {
            assert!(text.contains(topic.name.trim_start_matches("flockeye/")), "{}", topic.name);
        }
    }
}
