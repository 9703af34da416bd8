//! Conversion between messages of the contract and ROS 2 messages, byte by byte.

use flockeye_contract::description::{Kind, TypeDescription};

use crate::cdr::{CdrReader, CdrWriter};
use crate::error::RecordingError;
use crate::layout::{TopicLayout, number_size, number_text, numbers_of};

/// A message of the contract as it lies in shared memory.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ContractMessage {
    /// The header's bytes.
    pub header: Vec<u8>,
    /// The items' bytes. Empty if the payload is bytes, such as pixels; these have a channel of
    /// their own.
    pub items: Vec<u8>,
    /// The size of a payload of bytes.
    pub payload_bytes: u64,
}

/// The ROS 2 message of a topic's message.
pub fn encode(layout: &TopicLayout, message: &ContractMessage) -> Result<Vec<u8>, RecordingError> {
    let refused = |reason: String| RecordingError::Message { channel: layout.channel(), reason };
    if message.header.len() != layout.header.size {
        let (found, wanted) = (message.header.len(), layout.header.size);
        return Err(refused(format!("has a header of {found} bytes, not {wanted}")));
    }
    let mut cdr = CdrWriter::with_capacity(message.header.len() + message.items.len() + 64);
    write(&mut cdr, layout, &layout.header, &message.header);
    match &layout.item {
        None => cdr.numbers(8, &message.payload_bytes.to_le_bytes()),
        Some(item) => {
            if !message.items.len().is_multiple_of(item.size) {
                let (found, size) = (message.items.len(), item.size);
                return Err(refused(format!("has {found} bytes of items of {size} bytes each")));
            }
            cdr.length(message.items.len() / item.size);
            for bytes in message.items.chunks_exact(item.size) {
                write(&mut cdr, layout, item, bytes);
            }
        }
    }
    Ok(cdr.finish())
}

/// The message of the contract that [`encode`] has converted.
pub fn decode(layout: &TopicLayout, message: &[u8]) -> Result<ContractMessage, RecordingError> {
    let refused = |reason: String| RecordingError::Message { channel: layout.channel(), reason };
    let mut cdr = CdrReader::new(message).map_err(refused)?;
    let mut found = ContractMessage::default();
    read(&mut cdr, layout, &layout.header, &mut found.header).map_err(refused)?;
    match &layout.item {
        None => {
            let bytes = cdr.numbers(8, 1).map_err(refused)?;
            // The slice has the length of the number.
            found.payload_bytes = u64::from_le_bytes(bytes.try_into().unwrap_or_default());
        }
        Some(item) => {
            let count = cdr.u32().map_err(refused)?;
            // Each item takes bytes of the message, so a count that is too large ends in an error.
            for _ in 0..count {
                read(&mut cdr, layout, item, &mut found.items).map_err(refused)?;
            }
        }
    }
    let left = cdr.rest().len();
    if left > 0 {
        return Err(refused(format!("has {left} bytes more than its definition")));
    }
    Ok(found)
}

/// The first field in which two messages of a topic differ, with both values. `None` if they are
/// equal bit by bit.
pub fn first_difference(
    layout: &TopicLayout,
    one: &ContractMessage,
    other: &ContractMessage,
) -> Option<String> {
    let header = difference(layout, &layout.header, &one.header, &other.header);
    if let Some((field, [one, other])) = header {
        return Some(format!("header.{field}: {one} and {other}"));
    }
    let size = layout.item.as_ref().map_or(1, |item| item.size);
    let counts = [one, other].map(|message| message.items.len() / size);
    if counts[0] != counts[1] {
        return Some(format!("{} items and {}", counts[0], counts[1]));
    }
    let item = layout.item.as_ref()?;
    let pairs = one.items.chunks_exact(size).zip(other.items.chunks_exact(size));
    pairs.enumerate().find_map(|(index, (one, other))| {
        let (field, [one, other]) = difference(layout, item, one, other)?;
        Some(format!("items[{index}].{field}: {one} and {other}"))
    })
}

/// The first field in which two values of a type differ, and both values.
fn difference(
    layout: &TopicLayout,
    described: &TypeDescription,
    one: &[u8],
    other: &[u8],
) -> Option<(String, [String; 2])> {
    described.fields.iter().find_map(|field| {
        let end = field.offset + layout.size_of(&field.kind);
        let [one, other] =
            [one, other].map(|bytes| bytes.get(field.offset..end).unwrap_or_default());
        if one == other {
            return None;
        }
        let name = field.name;
        if let Kind::Type(inner) = &field.kind {
            let (field, values) = difference(layout, layout.type_named(inner)?, one, other)?;
            return Some((format!("{name}.{field}"), values));
        }
        let Some((number, count)) = numbers_of(&field.kind) else {
            let shown =
                |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end_matches('\0').to_owned();
            return Some((name.to_owned(), [shown(one), shown(other)]));
        };
        let size = number_size(number);
        let pairs = one.chunks(size).zip(other.chunks(size));
        let (index, (one, other)) = pairs.enumerate().find(|(_, (one, other))| one != other)?;
        let place = count.map(|_| format!("[{index}]")).unwrap_or_default();
        Some((format!("{name}{place}"), [number_text(number, one), number_text(number, other)]))
    })
}

fn write(cdr: &mut CdrWriter, layout: &TopicLayout, described: &TypeDescription, bytes: &[u8]) {
    for field in &described.fields {
        // `encode` has checked the total size, which is the sum of the fields.
        let bytes = bytes.get(field.offset..field.offset + layout.size_of(&field.kind));
        let bytes = bytes.unwrap_or_default();
        match &field.kind {
            Kind::Text(_) => {
                let end = bytes.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1);
                cdr.text(&bytes[..end]);
            }
            Kind::Type(name) => {
                if let Some(inner) = layout.type_named(name) {
                    write(cdr, layout, inner, bytes);
                }
            }
            kind @ (Kind::Number(_) | Kind::Array(..)) => {
                if let Some((number, _)) = numbers_of(kind) {
                    cdr.numbers(number_size(number), bytes);
                }
            }
        }
    }
}

fn read(
    cdr: &mut CdrReader<'_>,
    layout: &TopicLayout,
    described: &TypeDescription,
    bytes: &mut Vec<u8>,
) -> Result<(), String> {
    for field in &described.fields {
        match &field.kind {
            Kind::Text(size) => {
                let text = cdr.text()?;
                if text.len() > *size {
                    let (name, length) = (field.name, text.len());
                    return Err(format!("has {length} bytes of {name}, where {size} fit"));
                }
                bytes.extend_from_slice(text);
                bytes.resize(bytes.len() + size - text.len(), 0);
            }
            Kind::Type(name) => {
                if let Some(inner) = layout.type_named(name) {
                    read(cdr, layout, inner, bytes)?;
                }
            }
            kind @ (Kind::Number(_) | Kind::Array(..)) => {
                if let Some((number, count)) = numbers_of(kind) {
                    bytes.extend_from_slice(cdr.numbers(number_size(number), count.unwrap_or(1))?);
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::layout::layouts;
    use proptest::prelude::*;

    fn layout(service: &str) -> TopicLayout {
        layouts().into_iter().find(|layout| layout.service == service).unwrap()
    }

    fn of<T: flockeye_contract::Topic>(header: &T::Header, items: &[T::Item]) -> ContractMessage {
        ContractMessage {
            header: bytemuck::bytes_of(header).to_vec(),
            items: bytemuck::cast_slice(items).to_vec(),
            payload_bytes: 0,
        }
    }

    #[test]
    fn numbers_and_texts_lie_where_ros_expects_them() {
        use flockeye_contract::{Complaint, Complaints};
        let complaint =
            Complaint { sent_ns: -2, count: 7, stage: "fusion".into(), ..Complaint::default() };
        let message = of::<Complaints>(&complaint, &[]);
        let cdr = encode(&layout("flockeye/complaint"), &message).unwrap();
        assert_eq!(&cdr[..4], [0, 1, 0, 0]);
        assert_eq!(&cdr[4..12], (-2_i64).to_le_bytes());
        assert_eq!(&cdr[12..20], 7_u64.to_le_bytes());
        // A text is its length with the zero byte, and its bytes.
        assert_eq!(&cdr[20..31], b"\x07\0\0\0fusion\0");
    }

    #[test]
    fn what_is_no_number_comes_back_bit_by_bit() {
        use flockeye_contract::{ImuHeader, ImuSample, Imus};
        let odd = [f64::NAN, f64::from_bits(0x7ff8_0000_dead_beef), f64::NEG_INFINITY];
        let sample = ImuSample { at_ns: i64::MIN, rate: odd, specific_force: [-0.0, 5e-324, 0.1] };
        let message = of::<Imus>(&ImuHeader::default(), &[sample; 3]);
        let layout = layout("flockeye/imu");
        assert_eq!(decode(&layout, &encode(&layout, &message).unwrap()).unwrap(), message);
    }

    #[test]
    fn what_is_not_such_a_message_is_refused() {
        use flockeye_contract::{HandOver, HandOvers};
        let layout = layout("flockeye/handover");
        let whole = encode(&layout, &of::<HandOvers>(&HandOver::default(), &[])).unwrap();
        for end in 0..whole.len() {
            assert!(decode(&layout, &whole[..end]).is_err(), "{end} bytes");
        }
        let longer = [&whole[..], &[0]].concat();
        let error = decode(&layout, &longer).unwrap_err().to_string();
        assert!(error.contains("/flockeye/handover has 1 bytes more"), "{error}");
        let short = ContractMessage::default();
        assert!(encode(&layout, &short).unwrap_err().to_string().contains("0 bytes, not"));
    }

    #[test]
    fn the_first_difference_is_named_by_its_field() {
        use bytemuck::Zeroable;
        use flockeye_contract::{Track, TrackHeader, Tracks};
        let layout = layout("flockeye/track");
        let track = Track { name: "kite".into(), ..Track::zeroed() };
        let message =
            |track: Track| of::<Tracks>(&TrackHeader::default(), &[Track::zeroed(), track]);
        let compared = |other: Track| first_difference(&layout, &message(track), &message(other));
        assert_eq!(compared(track), None);
        let mut other = track;
        other.observer_from_target.position[2] = -0.0;
        assert_eq!(
            compared(other).as_deref(),
            Some("items[1].observer_from_target.position[2]: 0.0 and -0.0")
        );
        let other = Track { name: "lark".into(), ..track };
        assert_eq!(compared(other).as_deref(), Some("items[1].name: kite and lark"));
        let none = of::<Tracks>(&TrackHeader { is_last: 1, ..TrackHeader::default() }, &[]);
        let said = first_difference(&layout, &message(track), &none);
        assert_eq!(said.as_deref(), Some("header.is_last: 0 and 1"));
    }

    #[test]
    fn a_count_that_lies_takes_no_memory() {
        let layout = layout("flockeye/track");
        let header = vec![0; layout.header.size];
        let mut cdr =
            encode(&layout, &ContractMessage { header, ..ContractMessage::default() }).unwrap();
        let place = cdr.len() - 4;
        cdr[place..].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(decode(&layout, &cdr).unwrap_err().to_string().contains("ends after"));
    }

    proptest! {
        #[test]
        fn every_message_of_every_topic_comes_back(seed in any::<u64>(), items in 0_usize..4) {
            // Any bytes at all, as a foreign stage may write them.
            let mut state = seed | 1;
            let mut dice = |count: usize| -> Vec<u8> {
                (0..count).map(|_| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    (state >> 56) as u8
                }).collect()
            };
            for layout in layouts() {
                let header = dice(layout.header.size);
                let item_bytes = layout.item.as_ref().map_or(0, |item| item.size * items);
                let message = ContractMessage {
                    header,
                    items: dice(item_bytes),
                    payload_bytes: if layout.item.is_none() { seed } else { 0 },
                };
                let back = decode(&layout, &encode(&layout, &message).unwrap()).unwrap();
                prop_assert_eq!(back, message);
            }
        }

        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            for layout in layouts() {
                drop(decode(&layout, &bytes));
                drop(decode(&layout, &[&[0, 1, 0, 0], &bytes[..]].concat()));
            }
        }
    }
}
