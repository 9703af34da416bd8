//! Positions of the fields in a topic's messages, from the contract's description.

use std::sync::Arc;

use flockeye_contract::description::{Kind, TypeDescription, types};
use flockeye_contract::{TOPICS, TopicInfo};

/// A topic's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicLayout {
    /// Name of the topic.
    pub service: &'static str,
    /// The header.
    pub header: TypeDescription,
    /// The type of the payload's items; `None`: bytes, such as pixels.
    pub item: Option<TypeDescription>,
    /// All types of the contract. Fields refer to them by name.
    types: Arc<Vec<TypeDescription>>,
}

/// The layouts of all topics, in the order of the dataflow.
pub fn layouts() -> Vec<TopicLayout> {
    let types = Arc::new(types());
    // A test of the contract checks that topics and fields name types that are described.
    let described = |name: &str| types.iter().find(|known| known.name == name).cloned();
    let layout = |topic: &TopicInfo| {
        let (service, types) = (topic.name, types.clone());
        let (header, item) = (described(topic.header)?, described(topic.item));
        Some(TopicLayout { service, header, item, types })
    };
    TOPICS.iter().filter_map(layout).collect()
}

impl TopicLayout {
    /// The type with this name.
    pub(crate) fn type_named(&self, name: &str) -> Option<&TypeDescription> {
        self.types.iter().find(|known| known.name == name)
    }

    /// Bytes of a field in shared memory.
    pub(crate) fn size_of(&self, kind: &Kind) -> usize {
        match kind {
            Kind::Number(name) => number_size(name),
            Kind::Array(inner, count) => count * self.size_of(inner),
            Kind::Text(bytes) => *bytes,
            Kind::Type(name) => self.type_named(name).map_or(0, |described| described.size),
        }
    }

    /// The name of the topic's channel in a recording.
    pub fn channel(&self) -> String {
        format!("/{}", self.service)
    }

    /// The name of the message type, such as `flockeye_msgs/msg/TrackMessage`.
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

/// Size of the number type with this Rust name, bytes.
pub fn number_size(name: &str) -> usize {
    match name {
        "u8" => 1,
        "u32" | "f32" => 4,
        _ => 8,
    }
}

/// A number as its shortest exact text. `bytes` is little-endian.
pub fn number_text(name: &str, bytes: &[u8]) -> String {
    let mut wide = [0; 8];
    let length = bytes.len().min(8);
    wide[..length].copy_from_slice(&bytes[..length]);
    let number = u64::from_le_bytes(wide);
    match name {
        "i64" => number.cast_signed().to_string(),
        "f64" => format!("{:?}", f64::from_bits(number)),
        // A number of 32 bits lies in the first four bytes.
        "f32" => format!("{:?}", f32::from_bits(number as u32)),
        _ => number.to_string(),
    }
}

/// The Rust name of a field's number type, and for arrays the count. Nested arrays become one array
/// in ROS with the same bytes.
pub(crate) fn numbers_of(kind: &Kind) -> Option<(&'static str, Option<usize>)> {
    match kind {
        Kind::Number(name) => Some((name, None)),
        Kind::Array(inner, count) => {
            let (name, inner) = numbers_of(inner)?;
            Some((name, Some(count * inner.unwrap_or(1))))
        }
        Kind::Text(_) | Kind::Type(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes without a place in a layout would be lost from recordings.
    #[test]
    fn every_byte_of_a_message_has_its_place() {
        fn check(layout: &TopicLayout, described: &TypeDescription) {
            let mut end = 0;
            for field in &described.fields {
                assert_eq!(field.offset, end, "{}.{}", described.name, field.name);
                end += layout.size_of(&field.kind);
                match &field.kind {
                    Kind::Type(name) => check(layout, layout.type_named(name).unwrap()),
                    Kind::Number(_) | Kind::Array(..) => assert!(numbers_of(&field.kind).is_some()),
                    Kind::Text(_) => {}
                }
            }
            assert_eq!((end, described.size > 0), (described.size, true), "{}", described.name);
        }
        let all = layouts();
        assert_eq!(all.len(), flockeye_contract::TOPICS.len());
        for (layout, topic) in all.iter().zip(flockeye_contract::TOPICS) {
            check(layout, &layout.header);
            layout.item.iter().for_each(|item| check(layout, item));
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
