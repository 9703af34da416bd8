//! What a recording says that it lacks: `flockeye_msgs/msg/Loss`, read back.

use crate::cdr::CdrReader;
use crate::channel::LOSSES;
use crate::error::RecordingError;

/// What is missing of a topic, counted since the recording began.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Loss {
    /// Name of the topic.
    pub topic: String,
    /// Messages that are recorded.
    pub recorded: u64,
    /// Messages that break the contract.
    pub refused: u64,
    /// Numbers that are missing.
    pub missing: u64,
    /// How often the topic's buffer was full.
    pub buffer_full: u64,
    /// Messages for which the queue had no room.
    pub queue_full: u64,
}

impl Loss {
    /// All that is, or may be, lost.
    pub fn lost(&self) -> u64 {
        [self.refused, self.missing, self.buffer_full, self.queue_full]
            .into_iter()
            .fold(0, u64::saturating_add)
    }
}

/// Reads what [`encode_loss`](crate::message::encode_loss) gave.
///
/// # Errors
/// [`RecordingError::Message`] where the bytes are not those of such a message.
pub fn decode_loss(message: &[u8]) -> Result<Loss, RecordingError> {
    let decode = || -> Result<Loss, String> {
        let mut cdr = CdrReader::new(message)?;
        let topic = String::from_utf8_lossy(cdr.text()?).into_owned();
        let mut count = || -> Result<u64, String> {
            // `numbers` gives as many bytes as were asked for.
            Ok(u64::from_le_bytes(cdr.numbers(8, 1)?.try_into().unwrap_or_default()))
        };
        Ok(Loss {
            topic,
            recorded: count()?,
            refused: count()?,
            missing: count()?,
            buffer_full: count()?,
            queue_full: count()?,
        })
    };
    decode().map_err(|reason| RecordingError::Message { channel: LOSSES.to_owned(), reason })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::message::encode_loss;

    #[test]
    fn a_loss_comes_back_and_half_of_one_is_refused() {
        let bytes = encode_loss("flockeye/plan", [9, 1, 2, 3, 4]);
        let loss = decode_loss(&bytes).unwrap();
        let wanted = Loss {
            topic: "flockeye/plan".into(),
            recorded: 9,
            refused: 1,
            missing: 2,
            buffer_full: 3,
            queue_full: 4,
        };
        assert_eq!((loss.lost(), &loss), (10, &wanted));
        for end in 0..bytes.len() {
            assert!(decode_loss(&bytes[..end]).is_err(), "{end} bytes");
        }
    }
}
