//! Types, codes and topics of the contract as data. Clients in other languages and the messages of
//! recordings are made from it.

mod c;
mod python;

use std::mem::{align_of, size_of};

use crate::{
    BodyTruth, Complaint, ComplaintKind, DetectedMarker, DetectionHeader, FrameEnd, FrameHeader,
    FrameStamp, HandOver, HandOverState, Health, ImuHeader, ImuSample, JournalEntry, JournalHeader,
    JournalKind, MeasuredBy, OdometrySample, PacketHeader, PeerHeader, PeerSighting, PixelFormat,
    PlanHeader, PlannedView, Pose, Projection, Range, Rotation, RotationSource, Search, SearchMode,
    StageLatency, StageState, StopReason, StopRule, SwarmHeader, SwarmPose, SwarmWay, Text, Track,
    TrackHeader, TrackState, Transfer, TruthHeader, VideoCodec, ViewHeader, ViewKind,
};

pub use c::c_header;
pub use python::python_module;

/// Kind of a field.
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

/// Type that a field may have. The contract's own types derive it.
pub(crate) trait Described {
    /// Kind of a field of this type.
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
    /// Its kind.
    pub kind: Kind,
}

/// A type of the contract.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TypeDescription {
    /// Its name in Rust.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
    /// Alignment, bytes.
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

/// The enumerations: each one's name, and its values' names in Rust, by their codes from 0.
pub(crate) fn codes() -> Vec<(&'static str, &'static [&'static str])> {
    macro_rules! codes {
        ($($name:ident)+) => {
            vec![$((stringify!($name), $name::NAMES)),+]
        };
    }
    codes! {
        PixelFormat VideoCodec Transfer Range Projection RotationSource ViewKind Search StopRule StopReason
        SearchMode TrackState MeasuredBy SwarmWay StageState HandOverState JournalKind ComplaintKind
    }
}

/// The layout of all types as text: name, size, alignment, then the offset of each field. It is the
/// block in `docs/CONTRACT.md`.
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
    crate::codes::text(&crate::codes::snake_case(name)).to_owned()
}

/// The last part of a service's name, in capitals.
fn constant(service: &str) -> String {
    service.rsplit('/').next().unwrap_or(service).to_uppercase()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TOPICS;

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
        let is_type = |name: &str| types.iter().any(|known| known.name == name);
        for topic in TOPICS {
            assert!(is_type(topic.header), "{topic:?}");
            assert!(topic.item == "u8" || is_type(topic.item), "{topic:?}");
        }
        let views: Vec<_> = TOPICS.iter().filter(|topic| topic.has_lanes()).collect();
        assert_eq!(views.len(), 1);
        assert_eq!((views[0].name, views[0].header), ("flockeye/view", "ViewHeader"));
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
