//! A message as it was received.

use flockeye_recording::ContractMessage;

/// What the thread that receives hands to the one that writes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// The topic's place among all topics, in the order of the dataflow.
    pub topic: usize,
    /// When it was received, CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// The message.
    pub message: ContractMessage,
    /// Its pixels, where they are recorded.
    pub pixels: Option<Vec<u8>>,
}

impl Entry {
    /// Bytes that it takes in memory, about.
    pub fn bytes(&self) -> usize {
        let pixels = self.pixels.as_ref().map_or(0, Vec::len);
        self.message.header.len() + self.message.items.len() + pixels + 128
    }
}

/// What was recorded of a topic, and what was not, since the beginning.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Loss {
    /// Messages that were received.
    pub recorded: u64,
    /// Messages that broke the contract.
    pub refused: u64,
    /// Numbers that are missing among those that rise by one: of frames (lost, or never sent), packets and plans.
    pub missing: u64,
    /// How often a topic's buffer was found full, so that messages may have been lost.
    pub buffer_full: u64,
    /// Messages that were dropped because the disk is too slow.
    pub queue_full: u64,
}

impl Loss {
    /// How many messages are missing for certain.
    pub fn certain(&self) -> u64 {
        self.refused + self.missing + self.queue_full
    }

    /// Whether something is, or may be, missing.
    pub fn is_loss(&self) -> bool {
        self.certain() + self.buffer_full > 0
    }
}
