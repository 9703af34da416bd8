//! Ring buffer of the newest messages, for recordings of the time before an event.

use std::collections::VecDeque;
use std::time::Duration;

use crate::message::TopicMessage;

/// Limit for the size of the ring, bytes.
pub(crate) const MOST_BYTES: usize = 256_000_000;

/// The messages of a limited past.
#[derive(Debug)]
pub(crate) struct Ring {
    entries: VecDeque<TopicMessage>,
    bytes: usize,
    past_ns: i64,
    most_bytes: usize,
}

impl Ring {
    /// A ring for the messages of the last `past`, with at most `most_bytes` bytes.
    pub(crate) fn new(past: Duration, most_bytes: usize) -> Self {
        let past_ns = i64::try_from(past.as_nanos()).unwrap_or(i64::MAX);
        Self { entries: VecDeque::new(), bytes: 0, past_ns, most_bytes }
    }

    /// Adds a message, and removes messages beyond the limits of age and size.
    pub(crate) fn push(&mut self, entry: TopicMessage) {
        let now_ns = entry.at_ns;
        self.bytes += entry.bytes();
        self.entries.push_back(entry);
        while let Some(oldest) = self.entries.front() {
            let is_old = now_ns.saturating_sub(oldest.at_ns) > self.past_ns;
            if !is_old && self.bytes <= self.most_bytes {
                break;
            }
            self.bytes -= oldest.bytes();
            self.entries.pop_front();
        }
    }

    /// Takes all messages, so that each is written once.
    pub(crate) fn take(&mut self) -> VecDeque<TopicMessage> {
        self.bytes = 0;
        std::mem::take(&mut self.entries)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_recording::ContractMessage;

    fn entry(at_s: i64) -> TopicMessage {
        let message = ContractMessage { header: vec![0; 872], ..ContractMessage::default() };
        TopicMessage { topic: 0, at_ns: at_s * 1_000_000_000, message, pixels: None }
    }

    #[test]
    fn it_keeps_the_newest_within_time_and_memory() {
        let mut ring = Ring::new(Duration::from_secs(30), 10_000);
        let times = |ring: &mut Ring| -> Vec<i64> {
            ring.take().iter().map(|entry| entry.at_ns / 1_000_000_000).collect()
        };
        [0, 10, 20, 35].map(entry).into_iter().for_each(|entry| ring.push(entry));
        assert_eq!(times(&mut ring), [10, 20, 35]);
        assert!(ring.take().is_empty());
        (0..25).map(entry).for_each(|entry| ring.push(entry));
        assert_eq!(times(&mut ring), (15..25).collect::<Vec<_>>());
    }
}
