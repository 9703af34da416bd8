//! A recording as messages to and from fusion, with the same checks as in ports.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, bail, ensure};
use bytemuck::{AnyBitPattern, Pod, pod_read_unaligned};
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{
    BodyTruth, Detections, FrameEnd, FrameEnds, FrameHeader, Frames, JournalEntry, JournalHeader,
    Journals, PlanHeader, PlannedView, Plans, Rotation, Rotations, Topic, Track, TrackHeader,
    Tracks, TruthHeader, Truths, ViewHeader, Views,
};
use flockeye_geometry::body::Bodies;
use flockeye_recording::channel::{LOSSES, VIEW_IMAGES};
use flockeye_recording::images::decode_image;
use flockeye_recording::losses::decode_loss;
use flockeye_recording::message::decode;
use flockeye_recording::{
    ContractMessage, Ending, RecordedMessage, RecordingReader, TopicLayout, layouts,
};

use flockeye_fusion::Record;

/// The pixels of a recorded view.
pub(crate) type RecordedPixels = Arc<[u8]>;

/// A message of a recorded flight.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant, reason = "one at a time, on the stack")]
pub(crate) enum FlightMessage {
    /// A frame, without its pixels.
    Frame(FrameHeader),
    /// The header of a view. Its pixels are not recorded, or follow with [`FlightMessage::View`].
    Header(ViewHeader),
    /// A view with its pixels.
    View(ViewHeader, RecordedPixels),
    /// The markers of a view.
    Searched(Record),
    FrameEnd(FrameEnd),
    /// The rotation of the camera.
    Rotation(Rotation),
    /// Tracks from fusion, with their bytes.
    Tracks(TrackHeader, Vec<Track>, ContractMessage),
    /// A plan from fusion, with its bytes.
    Plan(PlanHeader, Vec<PlannedView>, ContractMessage),
    /// Calls of fusion's core, with their times.
    Journal(JournalHeader, Vec<JournalEntry>),
    /// The truth of a simulated source.
    Truth(TruthHeader, Vec<BodyTruth>),
}

/// Topics of which messages are missing, or may be missing, with their number.
pub(crate) type LostMessages = Vec<(String, u64)>;

/// A recording that is being read, with all its files if it was split.
pub(crate) struct RecordedFlight {
    reader: RecordingReader,
    layouts: Vec<TopicLayout>,
    /// The header of a view whose pixels come next, and its sequence number.
    view: Option<(u32, ViewHeader)>,
    lost: BTreeMap<String, u64>,
}

impl RecordedFlight {
    /// Opens a recording.
    pub(crate) fn open(path: &Path) -> anyhow::Result<Self> {
        let reader = RecordingReader::open(path)?;
        Ok(Self { reader, layouts: layouts(), view: None, lost: BTreeMap::new() })
    }

    /// The end of the recording, after it was read completely.
    pub(crate) fn ending(&self) -> Option<Ending> {
        self.reader.ending()
    }

    /// A number from the metadata of the recording.
    pub(crate) fn number(&self, name: &str) -> Option<i64> {
        self.reader.about().metadata.get(name)?.parse().ok()
    }

    /// The flow of the recorded pipeline.
    pub(crate) fn flow(&self) -> Option<&str> {
        self.reader.about().metadata.get("flow").map(String::as_str)
    }

    /// Messages that are missing, as far as the recording was read.
    pub(crate) fn lost(&self) -> LostMessages {
        let lost = self.lost.iter().filter(|(_, messages)| **messages > 0);
        lost.map(|(topic, &messages)| (topic.clone(), messages)).collect()
    }

    fn attachment(&self, name: &str) -> Option<&[u8]> {
        let attachments = &self.reader.about().attachments;
        let found = attachments.iter().find(|(attached, _, _)| attached == name);
        found.map(|(_, _, bytes)| bytes.as_slice())
    }

    /// The configuration of the recorded pipeline, with the bodies at the time of recording. If the
    /// body files have changed or are missing, the bodies in the recording are used.
    ///
    /// # Errors
    /// The configuration is missing, or is not valid any more.
    pub(crate) fn configuration(&self) -> anyhow::Result<Resolved> {
        let name = "pipeline.json";
        let json = self.attachment(name).with_context(|| format!("the recording has no {name}"))?;
        let pipeline =
            Pipeline::from_json(json).with_context(|| format!("{name} of the recording"))?;
        let today = Resolved::of(pipeline.clone());
        let Some(attached) = self.bodies()? else {
            return today.context("the recorded configuration cannot be worked with any more");
        };
        match today {
            Ok(today) if is_alike(&today.bodies, &attached) => Ok(today),
            _ => Resolved::with_bodies(pipeline, attached)
                .context("the recorded configuration cannot be worked with any more"),
        }
    }

    /// The bodies in the recording, in the order of their target numbers.
    fn bodies(&self) -> anyhow::Result<Option<Bodies>> {
        let name = "bodies.json";
        let Some(json) = self.attachment(name) else { return Ok(None) };
        let read = || -> anyhow::Result<Bodies> {
            let text = std::str::from_utf8(json)?;
            let listed: serde_json::Value = serde_json::from_str(text)?;
            let number = |body: &str| listed["bodies"][body]["target"].as_u64().unwrap_or(u64::MAX);
            let by_name = Bodies::from_json(text)?;
            let mut bodies: Vec<_> = by_name.iter().cloned().collect();
            bodies.sort_by_key(|body| number(&body.name));
            Ok(Bodies::new(by_name.dictionary, bodies)?)
        };
        // Bodies in a recording of an older version may be unreadable.
        Ok(Some(read().with_context(|| format!("{name} of the recording"))?))
    }

    /// The next relevant message, and its time of recording, UTC nanoseconds; `None` at the end.
    ///
    /// # Errors
    /// The recording is damaged, or a message breaks the contract because the file was changed.
    pub(crate) fn next_message(&mut self) -> anyhow::Result<Option<(FlightMessage, u64)>> {
        loop {
            while let Some(message) = self.reader.next_message()? {
                let utc_ns = message.utc_ns;
                if let Some(message) = self.understood(&message)? {
                    return Ok(Some((message, utc_ns)));
                }
            }
            let is_whole = self.reader.ending() == Some(Ending::Whole);
            let next = if is_whole { self.reader.next_part()? } else { None };
            match next {
                Some(reader) => self.reader = reader,
                None => return Ok(None),
            }
        }
    }

    fn understood(&mut self, message: &RecordedMessage) -> anyhow::Result<Option<FlightMessage>> {
        let topic = message.channel.topic.as_str();
        if topic == VIEW_IMAGES {
            return self.view(message).map(Some);
        }
        if topic == LOSSES {
            let (topic, loss) = decode_loss(&message.bytes)?;
            // Counts only increase, so the last message is kept.
            self.lost.insert(topic, loss.lost());
            return Ok(None);
        }
        let is_of = |layout: &&TopicLayout| layout.channel() == topic;
        let Some(layout) = self.layouts.iter().find(is_of) else { return Ok(None) };
        let found = || decode(layout, &message.bytes);
        Ok(Some(match layout.service {
            <Frames as Topic>::NAME => FlightMessage::Frame(header(&found()?)),
            <Views as Topic>::NAME => {
                let header: ViewHeader = header(&found()?);
                self.view = Some((message.sequence, header));
                FlightMessage::Header(header)
            }
            <Detections as Topic>::NAME => {
                let (header, markers) = checked::<Detections>(&found()?)?;
                FlightMessage::Searched(Record { header, markers })
            }
            <Rotations as Topic>::NAME => {
                FlightMessage::Rotation(checked::<Rotations>(&found()?)?.0)
            }
            <FrameEnds as Topic>::NAME => {
                FlightMessage::FrameEnd(checked::<FrameEnds>(&found()?)?.0)
            }
            <Tracks as Topic>::NAME => {
                let found = found()?;
                let (header, tracks) = checked::<Tracks>(&found)?;
                FlightMessage::Tracks(header, tracks, found)
            }
            <Plans as Topic>::NAME => {
                let found = found()?;
                let (header, views) = checked::<Plans>(&found)?;
                FlightMessage::Plan(header, views, found)
            }
            <Journals as Topic>::NAME => {
                let (header, entries) = checked::<Journals>(&found()?)?;
                FlightMessage::Journal(header, entries)
            }
            <Truths as Topic>::NAME => {
                let (header, bodies) = checked::<Truths>(&found()?)?;
                FlightMessage::Truth(header, bodies)
            }
            _ => return Ok(None),
        }))
    }

    fn view(&mut self, message: &RecordedMessage) -> anyhow::Result<FlightMessage> {
        let Some((sequence, header)) = self.view.take() else {
            bail!("pixels of a view without its header");
        };
        ensure!(sequence == message.sequence, "pixels of a view without its header");
        let pixels = decode_image(VIEW_IMAGES, &message.bytes)?.pixels;
        refuse_if_wrong::<Views>(&header, pixels)?;
        Ok(FlightMessage::View(header, pixels.into()))
    }
}

/// Whether two sets of bodies are equal, except for rounding of numbers in text files.
fn is_alike(one: &Bodies, other: &Bodies) -> bool {
    const ROUNDING: f64 = 1e-9;
    let mut pairs = one.iter().zip(other.iter());
    one.dictionary == other.dictionary
        && one.len() == other.len()
        && pairs.all(|(one, other)| {
            let mut corners = one.corners().zip(other.corners());
            let mut facets = one.facets().iter().zip(other.facets());
            let mount = one.target_from_markers.inverse() * other.target_from_markers;
            one.name == other.name
                && one.markers.len() == other.markers.len()
                && one.facets().len() == other.facets().len()
                && one.markers.iter().zip(&other.markers).all(|(one, other)| one.id == other.id)
                && corners.all(|(one, other)| (one - other).norm() < ROUNDING)
                && facets.all(|(one, other)| {
                    let mut outlines = one.outline.iter().zip(&other.outline);
                    one.outline.len() == other.outline.len()
                        && outlines.all(|(one, other)| (one - other).norm() < ROUNDING)
                })
                && mount.translation.vector.norm() + mount.rotation.angle() < 1e3 * ROUNDING
        })
}

/// A message's header and items. An error if a port would refuse them.
fn checked<T: Topic>(message: &ContractMessage) -> anyhow::Result<(T::Header, Vec<T::Item>)> {
    let header: T::Header = header(message);
    let items = message.items.chunks_exact(size_of::<T::Item>()).map(pod_read_unaligned);
    let items: Vec<T::Item> = items.collect();
    refuse_if_wrong::<T>(&header, &items)?;
    Ok((header, items))
}

fn refuse_if_wrong<T: Topic>(header: &T::Header, items: &[T::Item]) -> anyhow::Result<()> {
    T::check(header, items).with_context(|| {
        format!("a recorded message of {} breaks the contract. Cure: record anew", T::NAME)
    })
}

/// A copy of a message outside of shared memory.
pub(crate) fn contract_message<H: Pod, I: Pod>(header: &H, items: &[I]) -> ContractMessage {
    ContractMessage {
        header: bytemuck::bytes_of(header).to_vec(),
        items: bytemuck::cast_slice(items).to_vec(),
        payload_bytes: 0,
    }
}

/// A message's header.
pub(crate) fn header<H: AnyBitPattern>(message: &ContractMessage) -> H {
    // `decode` returns a header of the type's size.
    pod_read_unaligned(&message.header)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::{alpha, bravo};
    use flockeye_geometry::body::squares;

    #[test]
    fn bodies_that_differ_by_rounding_alone_are_alike() {
        let of = |bodies| Bodies::new("DICT_5X5_250".into(), bodies).unwrap();
        let written = |bodies: &Bodies| Bodies::from_json(&bodies.to_json().to_string()).unwrap();
        let both = of(vec![alpha(), bravo()]);
        assert!(is_alike(&both, &written(&both)));
        assert!(!is_alike(&both, &of(vec![alpha()])));
        assert!(!is_alike(&both, &of(vec![bravo(), alpha()])), "their numbers differ");
        assert!(!is_alike(&both, &of(vec![alpha(), squares("bravo", 0.0625, 0.0499, 17)])));
        let mut mounted = alpha();
        mounted.target_from_markers.translation.x = 0.01;
        assert!(!is_alike(&both, &of(vec![mounted, bravo()])));
    }
}
