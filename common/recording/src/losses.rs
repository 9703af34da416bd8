//! Messages of a topic that are missing in a recording: `flockeye_msgs/msg/Loss`.

use crate::cdr::{CdrReader, CdrWriter};
use crate::channel::LOSSES;
use crate::error::RecordingError;

/// Counts of recorded and missing messages of a topic, since the recording began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Loss {
    /// Messages that were received.
    pub recorded: u64,
    /// Messages that broke the contract.
    pub refused: u64,
    /// Missing sequence numbers of frames (lost, or never sent), packets, plans and journals.
    pub missing: u64,
    /// Number of times that the topic's buffer was full, so that messages may have been lost.
    pub buffer_full: u64,
    /// Messages that were dropped because the disk is too slow.
    pub queue_full: u64,
}

impl Loss {
    /// The number of messages that are certainly missing.
    pub fn certain(&self) -> u64 {
        self.refused.saturating_add(self.missing).saturating_add(self.queue_full)
    }

    /// The number of messages that are missing, or may be missing.
    pub fn lost(&self) -> u64 {
        self.certain().saturating_add(self.buffer_full)
    }

    /// The counts in the order of [`LOSS`](crate::definition::LOSS).
    fn counts(&self) -> [u64; 5] {
        [self.recorded, self.refused, self.missing, self.buffer_full, self.queue_full]
    }
}

/// The losses of a topic as a message.
pub fn encode_loss(topic: &str, loss: &Loss) -> Vec<u8> {
    let mut cdr = CdrWriter::with_capacity(96);
    cdr.text(topic.as_bytes());
    loss.counts().iter().for_each(|count| cdr.numbers(8, &count.to_le_bytes()));
    cdr.finish()
}

/// The topic and its losses in a message.
pub fn decode_loss(message: &[u8]) -> Result<(String, Loss), RecordingError> {
    let decode = || -> Result<(String, Loss), String> {
        let mut cdr = CdrReader::new(message)?;
        let topic = String::from_utf8_lossy(cdr.text()?).into_owned();
        let mut count = || -> Result<u64, String> {
            // `numbers` returns exactly eight bytes.
            Ok(u64::from_le_bytes(cdr.numbers(8, 1)?.try_into().unwrap_or_default()))
        };
        let loss = Loss {
            recorded: count()?,
            refused: count()?,
            missing: count()?,
            buffer_full: count()?,
            queue_full: count()?,
        };
        Ok((topic, loss))
    };
    decode().map_err(|reason| RecordingError::Message { channel: LOSSES.to_owned(), reason })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_loss_comes_back_and_half_of_one_is_refused() {
        let loss = Loss { recorded: 9, refused: 1, missing: 2, buffer_full: 3, queue_full: 4 };
        assert_eq!((loss.certain(), loss.lost()), (7, 10));
        let bytes = encode_loss("flockeye/plan", &loss);
        assert_eq!(decode_loss(&bytes).unwrap(), ("flockeye/plan".to_owned(), loss));
        for end in 0..bytes.len() {
            assert!(decode_loss(&bytes[..end]).is_err(), "{end} bytes");
        }
        assert_eq!(Loss { missing: u64::MAX, ..loss }.lost(), u64::MAX);
    }
}
