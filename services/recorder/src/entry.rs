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
