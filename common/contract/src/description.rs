//! The contract's types, codes and topics as data: what the clients in other languages and the messages of
//! recordings are made from.

mod c;
mod python;

use std::mem::{align_of, offset_of, size_of};

use crate::{
    BodyTruth, Complaint, ComplaintKind, DetectedMarker, DetectionHeader, FrameEnd, FrameHeader,
    FrameStamp, HandOver, HandOverState, Health, ImuHeader, ImuSample, JournalEntry, JournalHeader,
    JournalKind, MeasuredBy, OdometrySample, PacketHeader, PeerHeader, PeerSighting, PixelFormat,
    PlanHeader, PlannedView, Pose, Projection, Range, Rotation, RotationSource, Search, SearchMode,
    StageLatency, StageState, StopReason, StopRule, SwarmHeader, SwarmPose, SwarmWay, Text, Topic,
    TopicVisitor, Track, TrackHeader, TrackState, Transfer, TruthHeader, VideoCodec, ViewHeader,
    ViewKind, visit_topics,
};

pub use c::c_header;
pub use python::python_module;

/// What a field is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    /// A number, by its name in Rust.
    Number(&'static str),
    /// So many of one kind.
    Array(Box<Kind>, usize),
    /// UTF-8 in so many bytes, filled up with zero bytes.
    Text(usize),
    /// A type of the contract, by its name.
    Type(&'static str),
}

/// A type that a field may have.
trait Described {
    fn kind() -> Kind;
}

macro_rules! numbers {
    ($($number:ident)+) => {
        $(impl Described for $number {
            fn kind() -> Kind {
                Kind::Number(stringify!($number))
            }
        })+
    };
}

numbers! { u8 u32 u64 i64 f32 f64 }

impl<T: Described, const N: usize> Described for [T; N] {
    fn kind() -> Kind {
        Kind::Array(Box::new(T::kind()), N)
    }
}

impl<const N: usize> Described for Text<N> {
    fn kind() -> Kind {
        Kind::Text(N)
    }
}

/// A field of a type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Its name.
    pub name: &'static str,
    /// Where it begins in its type, bytes.
    pub offset: usize,
    /// What it is.
    pub kind: Kind,
}

/// A type of the contract.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TypeDescription {
    /// Its name in Rust.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
    /// What its address is a multiple of, bytes.
    pub alignment: usize,
    /// Its fields, in their order in memory.
    pub fields: Vec<Field>,
}

/// The kind of the field that a function reads.
fn kind_of<S, F: Described>(_: fn(&S) -> &F) -> Kind {
    F::kind()
}

macro_rules! types {
    ($($name:ident: $($field:ident),+;)+) => {
        $(impl Described for $name {
            fn kind() -> Kind {
                Kind::Type(stringify!($name))
            }
        })+

        /// The types, each after those that it contains.
        pub fn types() -> Vec<TypeDescription> {
            vec![$(TypeDescription {
                name: stringify!($name),
                size: size_of::<$name>(),
                alignment: align_of::<$name>(),
                fields: vec![$(Field {
                    name: stringify!($field),
                    offset: offset_of!($name, $field),
                    kind: kind_of(|whole: &$name| &whole.$field),
                }),+],
            }),+]
        }
    };
}

types! {
    FrameStamp: sequence, exposure_ns, stream_ns, published_ns, epoch, source_generation;
    Pose: position, orientation;
    FrameHeader: stamp, exposure_time_ns, readout_ns, width, height, stride, pixel_format, transfer,
        gamma, range, projection;
    PacketHeader: stream_ns, exposure_ns, arrived_ns, sequence, epoch, source_generation, codec, is_key;
    ImuHeader: sent_ns, epoch, generation;
    ImuSample: at_ns, rate, specific_force;
    Rotation: stamp, earlier_exposure_ns, later_from_earlier, covariance, rate_in_camera,
        rate_covariance, ahead_ns, ahead_from_later, ahead_covariance, ahead_rate_in_camera,
        ahead_rate_covariance, source, generation;
    PlanHeader: after, plan_id, made_ns, has_after, generation, stop_rule, mode, view_budget, reserved;
    PlannedView: camera_from_view, rate_in_camera, reference_ns, focal_px,
        predicted_camera_from_markers, size_px, kind, tile, target, has_prediction, search;
    ViewHeader: stamp, plan_id, taken_ns, issued_ns, camera_from_view, focal_px,
        predicted_camera_from_markers, readout_ns, generation, view_index, attempt, worker, size_px,
        stride, kind, tile, target, has_prediction, transfer, gamma, range, search;
    DetectionHeader: stamp, plan_id, taken_ns, issued_ns, received_ns, sent_ns, generation,
        view_index, attempt, worker, hits, failed, view_generation, reserved;
    DetectedMarker: rays_in_camera, deviations, corners_in_view, id, doubtful;
    FrameEnd: stamp, plan_id, taken_ns, ended_ns, views_issued, views_abandoned, reason, generation;
    TrackHeader: stamp, generation, is_last;
    StageLatency: capture_ns, rectification_ns, detection_ns, fusion_ns, total_ns;
    Track: observer_from_target, covariance, linear_velocity, angular_velocity,
        measured_observer_from_target, measured_covariance, predicted_observer_from_target,
        predicted_covariance, predicted_ns, age_ns, unseen_ns, latency, name, target, track_id, state,
        measured_by, markers, reserved;
    JournalHeader: first, sequence, generation, is_resumed;
    JournalEntry: at_ns, sequence, epoch, source_generation, kind, generation, view_generation,
        view_index, attempt, worker, tracks, plans;
    OdometrySample: odom_from_observer, covariance, linear_velocity, angular_velocity, at_ns, epoch,
        generation;
    PeerHeader: arrived_ns, generation, reserved;
    PeerSighting: observer_from_target, covariance, target_from_observer, inverse_covariance,
        linear_velocity, angular_velocity, exposure_ns, exposure_deviation_ns, frame, observer, target,
        epoch, state, measured_by, is_own;
    SwarmHeader: at_ns, sent_ns, generation, left_out;
    SwarmPose: own_from_drone, covariance, seen_ns, name, through, way, pairs;
    Health: sent_ns, taken, published, dropped, failed, queued, processor_ns, resident_bytes,
        latency_median_ns, latency_p99_ns, stage, detail, replica, generation, pid, state;
    TruthHeader: stamp, world_from_camera, observer_yaw, exposure_s;
    BodyTruth: camera_from_markers, observer_from_target, best_side_px, blur_px, name, target,
        markers_visible_50, markers_visible_90, localisable;
    HandOver: first, sent_ns, stage, replica, old_generation, new_generation, state;
    Complaint: sent_ns, count, stage, detail, replica, pid, kind, reserved;
}

/// An enumeration of the contract.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Codes {
    pub name: &'static str,
    /// The values' names in Rust, by their codes from 0.
    pub values: Vec<&'static str>,
}

/// The enumerations.
pub(crate) fn codes() -> Vec<Codes> {
    macro_rules! codes {
        ($($name:ident)+) => {
            vec![$(Codes { name: stringify!($name), values: $name::NAMES.to_vec() }),+]
        };
    }
    codes! {
        PixelFormat VideoCodec Transfer Range Projection RotationSource ViewKind Search StopRule StopReason
        SearchMode TrackState MeasuredBy SwarmWay StageState HandOverState JournalKind ComplaintKind
    }
}

/// A topic, with its types.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicDescription {
    /// Name of its service.
    pub service: &'static str,
    /// Name of the header's type.
    pub header: &'static str,
    /// What the payload is a slice of.
    pub item: Kind,
    /// Whether there is a service for each detection worker.
    pub has_lanes: bool,
}

/// The topics, in the order of the dataflow.
pub fn topics() -> Vec<TopicDescription> {
    /// The types' names as iceoryx2 has them, less what all have in common.
    struct Topics(Vec<TopicDescription>);
    impl TopicVisitor for Topics {
        type Error = std::convert::Infallible;

        fn visit<T: Topic + 'static>(&mut self) -> Result<(), Self::Error> {
            let short = |name: &'static str| name.rsplit(['/', ':']).next().unwrap_or(name);
            let header = short(std::any::type_name::<T::Header>());
            let item = match short(std::any::type_name::<T::Item>()) {
                "u8" => Kind::Number("u8"),
                name => Kind::Type(name),
            };
            let has_lanes = T::INFO.has_lanes();
            self.0.push(TopicDescription { service: T::NAME, header, item, has_lanes });
            Ok(())
        }
    }
    let mut topics = Topics(Vec::new());
    match visit_topics(&mut topics) {
        Ok(()) => topics.0,
        Err(never) => match never {},
    }
}

/// The layout of all types as text: name, size, alignment, then the offset of each field. It is the block
/// in `docs/CONTRACT.md`.
pub fn layout() -> String {
    let mut text = String::new();
    for TypeDescription { name, size, alignment, fields } in types() {
        text += &format!("{name} {size} {alignment}\n");
        for Field { name, offset, .. } in fields {
            text += &format!("  {name} {offset}\n");
        }
    }
    text
}

/// `PlannedView` as `planned_view`.
fn snake_case(name: &str) -> String {
    let mut snake = String::new();
    for letter in name.chars() {
        if letter.is_ascii_uppercase() && !snake.is_empty() {
            snake.push('_');
        }
        snake.push(letter.to_ascii_lowercase());
    }
    snake
}

/// The last part of a service's name, in capitals.
fn constant(service: &str) -> String {
    service.rsplit('/').next().unwrap_or(service).to_uppercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rust does not tell which fields a type has, so the list above is checked by what it must fill.
    #[test]
    fn every_byte_of_every_type_is_described() {
        let types = types();
        let size_of_type =
            |name: &str| types.iter().find(|known| known.name == name).map(|t| t.size);
        fn bytes(kind: &Kind, size_of_type: &dyn Fn(&str) -> Option<usize>) -> usize {
            match kind {
                Kind::Number("u8") => 1,
                Kind::Number("u32" | "f32") => 4,
                Kind::Number(_) => 8,
                Kind::Array(kind, count) => bytes(kind, size_of_type) * count,
                Kind::Text(bytes) => *bytes,
                Kind::Type(name) => size_of_type(name).unwrap_or(0),
            }
        }
        for described in &types {
            let mut end = 0;
            for field in &described.fields {
                assert_eq!(field.offset, end, "before {}.{}", described.name, field.name);
                end += bytes(&field.kind, &size_of_type);
            }
            assert_eq!(end, described.size, "{} has more at its end", described.name);
        }
    }

    #[test]
    fn topics_name_their_types() {
        let types = types();
        for topic in topics() {
            assert!(types.iter().any(|known| known.name == topic.header), "{topic:?}");
            if let Kind::Type(name) = topic.item {
                assert!(types.iter().any(|known| known.name == name), "{name}");
            }
        }
        let views: Vec<_> = topics().into_iter().filter(|topic| topic.has_lanes).collect();
        assert_eq!(views.len(), 1);
        assert_eq!((views[0].service, views[0].header), ("flockeye/view", "ViewHeader"));
    }

    /// The clients are in the repository, so that they can be installed without building anything.
    #[test]
    fn the_clients_files_are_as_generated() {
        for (file, generated) in [
            ("clients/python/flockeye/contract.py", python_module()),
            ("clients/c/include/flockeye/contract.h", c_header()),
        ] {
            let path = format!("{}/../../{file}", env!("CARGO_MANIFEST_DIR"));
            let found = std::fs::read_to_string(&path).unwrap_or_default();
            assert!(found == generated, "{file} is not as generated. Cure: make clients");
        }
    }
}
