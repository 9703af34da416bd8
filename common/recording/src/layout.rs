//! Where each field of a topic's messages lies: the contract's description, looked up once.

use flockeye_contract::description::{Kind, TypeDescription, topics, types};

/// A number, by its name in Rust, and its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Number {
    /// Its name in Rust.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
}

impl Number {
    /// Its value as text, from its bytes, little-endian: shortest, but exact.
    pub fn show(&self, bytes: &[u8]) -> String {
        let mut wide = [0; 8];
        let length = bytes.len().min(8);
        wide[..length].copy_from_slice(&bytes[..length]);
        let number = u64::from_le_bytes(wide);
        match self.name {
            "i64" => number.cast_signed().to_string(),
            "f64" => format!("{:?}", f64::from_bits(number)),
            // A number of 32 bits lies in the first four bytes.
            "f32" => format!("{:?}", f32::from_bits(number as u32)),
            _ => number.to_string(),
        }
    }
}

/// What a field is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shape {
    /// An array of this many numbers; `None`: a single number.
    Numbers(Number, Option<usize>),
    /// A text in so many bytes, filled up with zero bytes.
    Text(usize),
    /// A type of the contract.
    Object(Object),
}

/// A field of a type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Member {
    /// Its name.
    pub name: &'static str,
    /// Offset of the field in its type, bytes.
    pub offset: usize,
    /// What it is.
    pub shape: Shape,
}

/// A type of the contract.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Object {
    /// Its name in Rust.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
    /// Its fields, in their order in memory.
    pub members: Vec<Member>,
}

/// A topic's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicLayout {
    /// Name of the topic.
    pub service: &'static str,
    /// The header.
    pub header: Object,
    /// What the payload is a slice of; `None`: bytes, such as pixels.
    pub item: Option<Object>,
}

/// The layouts of all topics, in the order of the dataflow.
pub fn layouts() -> Vec<TopicLayout> {
    let types = types();
    let item = |kind: &Kind| match kind {
        Kind::Type(name) => Some(object(&types, name)),
        _ => None,
    };
    let layout = |topic: flockeye_contract::description::TopicDescription| TopicLayout {
        service: topic.service,
        header: object(&types, topic.header),
        item: item(&topic.item),
    };
    topics().into_iter().map(layout).collect()
}

impl TopicLayout {
    /// The name of its channel in a recording.
    pub fn channel(&self) -> String {
        format!("/{}", self.service)
    }

    /// The name of its messages, such as `flockeye_msgs/msg/TrackMessage`.
    pub fn message_name(&self) -> String {
        let last = self.service.rsplit('/').next().unwrap_or(self.service);
        let capital = |word: &str| {
            let mut letters = word.chars();
            let first = letters.next().map(|letter| letter.to_ascii_uppercase());
            first.into_iter().chain(letters).collect::<String>()
        };
        let name: String = last.split('_').map(capital).collect();
        format!("flockeye_msgs/msg/{name}Message")
    }
}

fn object(types: &[TypeDescription], name: &str) -> Object {
    // A test of the contract checks that topics and fields name types that are described.
    let Some(described) = types.iter().find(|known| known.name == name) else {
        return Object { name: "", size: 0, members: Vec::new() };
    };
    let member = |field: &flockeye_contract::description::Field| Member {
        name: field.name,
        offset: field.offset,
        shape: shape(types, &field.kind),
    };
    Object {
        name: described.name,
        size: described.size,
        members: described.fields.iter().map(member).collect(),
    }
}

fn shape(types: &[TypeDescription], kind: &Kind) -> Shape {
    match kind {
        Kind::Number(name) => Shape::Numbers(number(name), None),
        // Rows of rows are one array in ROS: the same bytes.
        Kind::Array(inner, count) => match shape(types, inner) {
            Shape::Numbers(number, inner) => {
                Shape::Numbers(number, Some(count * inner.unwrap_or(1)))
            }
            // The contract has arrays of numbers alone: `every_byte_of_a_message_has_its_place` checks it.
            other => other,
        },
        Kind::Text(bytes) => Shape::Text(*bytes),
        Kind::Type(name) => Shape::Object(object(types, name)),
    }
}

fn number(name: &'static str) -> Number {
    let size = match name {
        "u8" => 1,
        "u32" | "f32" => 4,
        _ => 8,
    };
    Number { name, size }
}

impl Shape {
    /// Bytes in shared memory.
    pub fn size(&self) -> usize {
        match self {
            Self::Numbers(number, count) => number.size * count.unwrap_or(1),
            Self::Text(bytes) => *bytes,
            Self::Object(object) => object.size,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What has no place in a layout would be lost from recordings.
    #[test]
    fn every_byte_of_a_message_has_its_place() {
        fn check(object: &Object) {
            let mut end = 0;
            for member in &object.members {
                assert_eq!(member.offset, end, "{}.{}", object.name, member.name);
                end += member.shape.size();
                if let Shape::Object(inner) = &member.shape {
                    check(inner);
                }
            }
            assert_eq!((end, object.size > 0), (object.size, true), "{}", object.name);
        }
        let all = layouts();
        assert_eq!(all.len(), flockeye_contract::TOPICS.len());
        for (layout, topic) in all.iter().zip(flockeye_contract::TOPICS) {
            check(&layout.header);
            layout.item.iter().for_each(check);
            assert_eq!(layout.header.size, topic.header_bytes, "{}", topic.name);
            assert_eq!(layout.item.as_ref().map_or(1, |item| item.size), topic.item_bytes);
        }
    }

    #[test]
    fn messages_are_named_after_their_topics() {
        let all = layouts();
        let named = |service: &str| {
            all.iter().find(|layout| layout.service == service).map(TopicLayout::message_name)
        };
        assert_eq!(
            named("flockeye/frame_end").as_deref(),
            Some("flockeye_msgs/msg/FrameEndMessage")
        );
        assert_eq!(named("flockeye/track").as_deref(), Some("flockeye_msgs/msg/TrackMessage"));
    }
}
