//! `packet`: coded picture of the source, before decoding.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_count;
use crate::{ContractError, VideoCodec};

/// Maximum number of bytes in a packet.
pub const MAX_PACKET_BYTES: usize = 33_554_432;

/// Header of `packet`. Payload: the coded picture in Annex B's byte stream (ITU-T H.264 and H.265).
/// It has all parts that are displayed at one time, and a key frame begins with its parameter sets.
///
/// A source sends packets only while there is a subscriber, in the order of decoding. A source
/// without such a coding sends one message with [`VideoCodec::None`] and no payload.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/PacketHeader")]
#[repr(C)]
pub struct PacketHeader {
    /// The `stamp.stream_ns` of the frame that is decoded from it.
    pub stream_ns: i64,
    /// Middle of the exposure as far as it is known before decoding, on the clock of
    /// `stamp.exposure_ns`.
    pub exposure_ns: i64,
    /// Arrival of its data, CLOCK_MONOTONIC, nanoseconds.
    pub arrived_ns: i64,
    /// Packets of the source, counted from 0 in each epoch, including those that were not sent.
    pub sequence: u64,
    /// The `stamp.epoch` of the frame.
    pub epoch: u32,
    /// The `stamp.source_generation` of the frame.
    pub source_generation: u32,
    /// A [`VideoCodec`].
    pub codec: u32,
    /// 1 if decoding can begin with it.
    pub is_key: u32,
}

impl PacketHeader {
    /// Refuses a header that does not match the payload, and a payload that is no byte stream.
    ///
    /// # Errors
    /// The first violation found.
    pub fn check(&self, payload: &[u8]) -> Result<(), ContractError> {
        let codec = VideoCodec::try_from(self.codec)?;
        check_count("bytes of a packet", payload.len(), MAX_PACKET_BYTES)?;
        if self.is_key > 1 {
            return Err(ContractError::NotFinite { what: "is_key" });
        }
        if codec == VideoCodec::None {
            return match payload.is_empty() {
                true => Ok(()),
                false => Err(ContractError::Missing { what: "codec of a packet" }),
            };
        }
        let begins = payload.starts_with(&[0, 0, 1]) || payload.starts_with(&[0, 0, 0, 1]);
        match begins {
            true => Ok(()),
            false => Err(ContractError::Missing { what: "start code of a packet" }),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use super::*;
    use crate::{Packets, Topic};

    #[test]
    fn packets_that_are_none_are_refused() {
        let of = |codec: VideoCodec| PacketHeader { codec: codec.code(), ..Default::default() };
        let whole = [0, 0, 0, 1, 0x67];
        for codec in [VideoCodec::H264, VideoCodec::H265] {
            assert_eq!(Packets::check(&of(codec), &whole), Ok(()));
            assert_eq!(Packets::check(&of(codec), &whole[1..]), Ok(()));
        }
        assert_eq!(Packets::check(&of(VideoCodec::None), &[]), Ok(()));
        let refused = |header: &PacketHeader, payload: &[u8]| {
            Packets::check(header, payload).expect_err("it is wrong").to_string()
        };
        let h264 = of(VideoCodec::H264);
        assert!(refused(&h264, &[]).contains("start code"));
        assert!(refused(&h264, &[0, 0, 0, 2, 0x67]).contains("start code"));
        assert!(refused(&of(VideoCodec::None), &whole).contains("codec of a packet"));
        assert!(refused(&PacketHeader { codec: 9, ..h264 }, &whole).contains("codec code 9"));
        assert!(refused(&PacketHeader { is_key: 2, ..h264 }, &whole).contains("is_key"));
        let long = vec![0; MAX_PACKET_BYTES + 1];
        assert!(refused(&h264, &long).contains("at most 33554432"));
    }
}
