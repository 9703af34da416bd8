//! The messages in a datagram.

use std::io::{Read, repeat};

use mavlink::consts::MAX_FRAME_SIZE;
use mavlink::dialects::development::MavMessage;
use mavlink::error::MessageReadError;
use mavlink::{MavHeader, MavlinkReader};

/// Passes on the complete messages in a datagram. A message never spans two datagrams, so an
/// incomplete rest is dropped with its datagram, and cannot spoil the next.
pub fn decode(datagram: &[u8], mut hear: impl FnMut(MavHeader, &MavMessage)) {
    // A byte that only resembles the start of a message may claim more bytes than there are. These
    // zeros make its checksum fail, so the reader finds the messages after it.
    let rest = repeat(0).take(MAX_FRAME_SIZE as u64);
    let mut reader = MavlinkReader::with_capacity(0, datagram.chain(rest));
    loop {
        match reader.read_any_message() {
            Ok((header, message)) => hear(header, &message),
            // A message of another dialect; the next may be of this one.
            Err(MessageReadError::Parse(_)) => {}
            Err(MessageReadError::Io(_)) => return,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use mavlink::dialects::development::HEARTBEAT_DATA;
    use mavlink::{MavlinkVersion, write_versioned_msg};

    use super::*;

    #[test]
    fn whole_messages_are_found_between_others() {
        let header = MavHeader { system_id: 1, component_id: 1, sequence: 0 };
        let heartbeat = MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT);
        let mut bytes = vec![0xfd, 0xff, 0x13];
        for version in [MavlinkVersion::V2, MavlinkVersion::V1] {
            write_versioned_msg(&mut bytes, version, header, &heartbeat).unwrap();
            bytes.push(0xfe);
        }
        let count = |bytes: &[u8]| {
            let mut count = 0;
            decode(bytes, |found, message| {
                assert_eq!((found.system_id, message), (1, &heartbeat));
                count += 1;
            });
            count
        };
        assert_eq!(count(&bytes), 2);
        assert_eq!(count(&bytes[..bytes.len() - 3]), 1);
        assert_eq!(count(&[]), 0);
    }
}
