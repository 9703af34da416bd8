//! Coded pictures, and whether somebody wants them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use flockeye_contract::VideoCodec;

/// Whether somebody wants packets. All copies share one answer.
#[derive(Debug, Clone, Default)]
pub struct PacketWish(Arc<AtomicBool>);

impl PacketWish {
    /// Sets whether somebody wants them.
    pub fn set(&self, is_wanted: bool) {
        self.0.store(is_wanted, Ordering::Relaxed);
    }

    pub(crate) fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

impl PartialEq for PacketWish {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

/// A coded picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packet {
    /// When it is shown, from the stream's first frame, nanoseconds.
    pub stream_ns: i64,
    /// When its data came in, CLOCK_MONOTONIC, nanoseconds.
    pub arrived_ns: i64,
    /// Its number among the stream's packets, in the order in which they are decoded.
    pub sequence: u64,
    /// How it is coded.
    pub codec: VideoCodec,
    /// Whether decoding can begin with it.
    pub is_key: bool,
    /// Annex B's byte stream, with the parameter sets before a key frame.
    pub bytes: Vec<u8>,
}
