//! Receives all topics of the contract, and detects losses.

use flockeye_contract::{
    FrameHeader, JournalHeader, PacketHeader, PlanHeader, TOPICS, Topic, TopicId, TopicVisitor,
    VideoCodec,
};
use flockeye_recording::ContractMessage;
use flockeye_runtime::clock;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, Sender, Subscriber};

use crate::arguments::FramesChoice;
use crate::message::TopicMessage;
use crate::queue::WriteQueue;

/// Error for a source without packets; a retry is useless.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NotCoded;

impl std::fmt::Display for NotCoded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(
            "the source's pictures are not coded as H.264 or H.265, so there is nothing of its own to record. Cure: \
             --frames 'every 1' (recording.frames: every, with recording.every: 1)",
        )
    }
}

impl std::error::Error for NotCoded {}

/// Passes all received messages of a lane to the queue. Returns false if messages wait for room.
pub(crate) type DrainLane = Box<dyn FnMut(&WriteQueue) -> anyhow::Result<bool>>;

/// Subscribes to all lanes of all topics. A topic with no room for another subscriber is skipped,
/// unless its pictures are recorded.
pub(crate) fn open_lanes(
    ports: &mut Ports,
    budget: &Budget,
    frames: FramesChoice,
) -> anyhow::Result<Vec<DrainLane>> {
    let mut opener = LaneOpener { ports, budget, frames, lanes: Vec::new() };
    flockeye_contract::visit_topics(&mut opener)?;
    Ok(opener.lanes)
}

/// Passes all received messages to the queue. Returns false if messages wait for room.
pub(crate) fn drain(lanes: &mut [DrainLane], queue: &WriteQueue) -> anyhow::Result<bool> {
    lanes.iter_mut().try_fold(true, |is_drained, drain| Ok(drain(queue)? & is_drained))
}

struct LaneOpener<'o> {
    ports: &'o mut Ports,
    budget: &'o Budget,
    frames: FramesChoice,
    lanes: Vec<DrainLane>,
}

impl TopicVisitor for LaneOpener<'_> {
    type Error = anyhow::Error;

    fn visit<T: Topic + 'static>(&mut self) -> anyhow::Result<()> {
        let pixels_of_each = match (T::INFO.id, self.frames) {
            (TopicId::Views, FramesChoice::Views) => Some(1),
            (TopicId::Packets, FramesChoice::Camera) => Some(1),
            // Not subscribed: a subscriber would make the source send packets.
            (TopicId::Packets, _) => return Ok(()),
            (TopicId::Frames, FramesChoice::Every(count)) => Some(count),
            _ => None,
        };
        let subscribers = match self.ports.late_subscribers_of_all_lanes::<T>() {
            Ok(subscribers) => subscribers,
            // Other tools use all subscriber slots: skip the topic. Other errors end the recording.
            Err(error) if error.is_crowded() && pixels_of_each.is_none() => {
                tracing::warn!(
                    topic = T::NAME,
                    "not recorded: {error}. Cure: end other tools that look on"
                );
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        };
        // The table has all topics, so the default is never used.
        let topic = TOPICS.iter().position(|topic| topic.id == T::INFO.id).unwrap_or(0);
        let limits = self.budget.topic::<T>();
        let (buffer, is_awaited) = (limits.buffer, limits.patience.is_some());
        for subscriber in subscribers {
            let (numbering, has_begun) = (None, T::INFO.id != TopicId::Packets);
            let mut lane = Lane {
                subscriber,
                topic,
                buffer,
                is_awaited,
                pixels_of_each,
                numbering,
                has_begun,
            };
            self.lanes.push(Box::new(move |queue| lane.drain(queue)));
        }
        Ok(())
    }
}

struct Lane<T: Topic> {
    subscriber: Subscriber<T>,
    topic: usize,
    /// Buffer size: maximum number of waiting messages per sender.
    buffer: usize,
    /// Whether senders wait if the buffer is full, so that no message is lost.
    is_awaited: bool,
    /// Record the pixels of each Nth message; `None`: no pixels.
    pixels_of_each: Option<u64>,
    numbering: Option<Numbering>,
    /// Whether recording has begun: for packets, at a key frame.
    has_begun: bool,
}

/// Sequence number of a message, in a series with step 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Numbering {
    /// Series: the numbers restart when it changes.
    of: (u32, u32),
    number: u64,
}

impl Numbering {
    /// Series and number of a frame, packet, plan or journal.
    fn of<T: Topic>(header: &T::Header) -> Option<Self> {
        let bytes = bytemuck::bytes_of(header);
        match T::INFO.id {
            TopicId::Frames => {
                let header: FrameHeader = bytemuck::pod_read_unaligned(bytes);
                let of = (header.stamp.source_generation, header.stamp.epoch);
                Some(Self { of, number: header.stamp.sequence })
            }
            TopicId::Packets => {
                let header: PacketHeader = bytemuck::pod_read_unaligned(bytes);
                let of = (header.source_generation, header.epoch);
                Some(Self { of, number: header.sequence })
            }
            TopicId::Plans => {
                let header: PlanHeader = bytemuck::pod_read_unaligned(bytes);
                Some(Self { of: (header.generation, 0), number: header.plan_id })
            }
            TopicId::Journals => {
                let header: JournalHeader = bytemuck::pod_read_unaligned(bytes);
                Some(Self { of: (header.generation, 0), number: header.sequence })
            }
            _ => None,
        }
    }

    /// Number of missing messages between `before` and this one.
    fn missing_since(&self, before: &Self) -> u64 {
        match self.of == before.of {
            true => self.number.saturating_sub(before.number).saturating_sub(1),
            false => 0,
        }
    }
}

impl<T: Topic> Lane<T> {
    fn drain(&mut self, queue: &WriteQueue) -> anyhow::Result<bool> {
        // Messages per sender in this call. A number equal to the buffer size may mean that others
        // were lost.
        let mut counts: Vec<(Sender, usize)> = Vec::new();
        loop {
            // Senders that wait for this subscriber then wait for the disk.
            if self.is_awaited && !queue.has_room() {
                return Ok(false);
            }
            let Some((message, verdict)) = self.subscriber.receive_with_verdict()? else { break };
            let sender = message.sender();
            match counts.iter_mut().find(|(known, _)| *known == sender) {
                Some((_, count)) => *count += 1,
                None => counts.push((sender, 1)),
            }
            if verdict.is_err() {
                queue.note(self.topic, |loss| loss.refused += 1);
                continue;
            }
            if T::INFO.id == TopicId::Packets {
                let header = bytemuck::bytes_of(&message.header);
                let header: PacketHeader = bytemuck::pod_read_unaligned(header);
                if header.codec == VideoCodec::None.code() {
                    return Err(NotCoded.into());
                }
                self.has_begun |= header.is_key == 1;
                if !self.has_begun {
                    continue;
                }
            }
            let numbering = Numbering::of::<T>(&message.header);
            if let (Some(now), Some(before)) = (numbering, self.numbering) {
                let missing = now.missing_since(&before);
                queue.note(self.topic, |loss| loss.missing += missing);
            }
            self.numbering = numbering;
            let items: &[u8] = bytemuck::cast_slice(message.items());
            let is_bytes = size_of::<T::Item>() == 1;
            // Views have no number, and 1 selects each message.
            let is_wanted = self.pixels_of_each.is_some_and(|count| {
                count == 1
                    || numbering.is_some_and(|numbering| numbering.number.is_multiple_of(count))
            });
            queue.push(TopicMessage {
                topic: self.topic,
                at_ns: clock::monotonic_ns(),
                message: ContractMessage {
                    header: bytemuck::bytes_of(&message.header).to_vec(),
                    items: if is_bytes { Vec::new() } else { items.to_vec() },
                    payload_bytes: if is_bytes { items.len() as u64 } else { 0 },
                },
                pixels: is_wanted.then(|| items.to_vec()),
            });
        }
        let is_counted = self.is_awaited || self.numbering.is_some();
        if !is_counted && counts.iter().any(|(_, count)| *count >= self.buffer) {
            queue.note(self.topic, |loss| loss.buffer_full += 1);
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_missing_are_counted_within_one_process_of_a_stage() {
        let at = |generation, number| Numbering { of: (generation, 0), number };
        assert_eq!(at(0, 5).missing_since(&at(0, 4)), 0);
        assert_eq!(at(0, 9).missing_since(&at(0, 4)), 4);
        assert_eq!(at(1, 9).missing_since(&at(0, 4)), 0);
        assert_eq!(at(0, 3).missing_since(&at(0, 4)), 0);
    }
}
