//! The contract's types, codes and topics as data: what the clients in other languages and the messages of
//! recordings are made from.

mod c;
mod python;

use std::mem::{align_of, size_of};

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
    /// An array of one kind, with its length.
    Array(Box<Kind>, usize),
    /// UTF-8 in this number of bytes, filled up with zero bytes.
    Text(usize),
    /// A type of the contract, by its name.
    Type(&'static str),
}

/// A type that a field may have. The contract's own types derive it.
pub(crate) trait Described {
    /// What a field of this type is.
    fn kind() -> Kind;

    /// Its own fields, in their order in memory.
    fn fields() -> Vec<Field> {
        Vec::new()
    }
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
    /// Offset of the field in its type, bytes.
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

macro_rules! types {
    ($($name:ident)+) => {
        /// The types, each after those that it contains.
        pub fn types() -> Vec<TypeDescription> {
            vec![$(TypeDescription {
                name: stringify!($name),
                size: size_of::<$name>(),
                alignment: align_of::<$name>(),
                fields: $name::fields(),
            }),+]
        }
    };
}

types! {
    FrameStamp Pose FrameHeader PacketHeader ImuHeader ImuSample Rotation PlanHeader
    PlannedView ViewHeader DetectionHeader DetectedMarker FrameEnd TrackHeader StageLatency
    Track JournalHeader JournalEntry OdometrySample PeerHeader PeerSighting SwarmHeader
    SwarmPose Health TruthHeader BodyTruth HandOver Complaint
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

    /// A gap between two fields would be a byte that no other language knows of.
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
