//! The nearest recorded picture before a frame, and close-ups from it.

use std::collections::VecDeque;
use std::sync::Arc;

use flockeye_contract::{FrameHeader, FrameOrder, FrameStamp, TopicId};
use flockeye_recording::RecordingError;
use flockeye_recording::channel::FRAME_IMAGES;
use flockeye_recording::images::decode_compressed;
use opencv::prelude::*;

use super::Recorded;
use crate::closeup::CloseupMaker;
use crate::frame_reader::is_shown_closely;
use crate::picture::{PictureMaker, decode, jpeg_size};
use crate::scene::EndedFrame;
use crate::wire::{self, CloseupHead};

/// Chunks whose pictures are kept: that of a frame, the one before, and the next.
const MOST_CHUNKS: usize = 3;
/// Maximum close-ups of a picture.
const MOST_CLOSEUPS: usize = 4;

/// The header of a frame, and its recorded picture, a JPEG.
type FramePicture = (FrameHeader, Vec<u8>);

/// A picture as a page shows it.
#[derive(Debug)]
pub(crate) struct PagePicture {
    /// The frame that it shows.
    pub stamp: FrameStamp,
    /// Width and height, pixels.
    pub size: [u32; 2],
    pub jpeg: Vec<u8>,
    /// Heads and JPEGs of its close-ups.
    pub closeups: Vec<(CloseupHead, Vec<u8>)>,
}

pub(crate) struct RecordedPictures {
    recorded: Arc<Recorded>,
    maker: PictureMaker,
    closeups: Option<CloseupMaker>,
    chunks: VecDeque<(usize, Arc<Vec<FramePicture>>)>,
    trouble: Option<String>,
}

impl RecordedPictures {
    /// Opens the pictures of a recording.
    pub(crate) fn new(recorded: Arc<Recorded>) -> anyhow::Result<Self> {
        let maker = PictureMaker::new(&recorded.resolved.camera)?;
        // A dictionary file may no longer exist.
        let closeups = CloseupMaker::new(&recorded.resolved)
            .inspect_err(|error| tracing::warn!("no close-ups: {error:#}"))
            .ok();
        Ok(Self { recorded, maker, closeups, chunks: VecDeque::new(), trouble: None })
    }

    /// The reason why a picture could not be shown, if it is new.
    pub(crate) fn trouble(&mut self) -> Option<String> {
        self.trouble.take()
    }

    /// The frame of the newest picture up to `frame`, which ended at `at_ns`.
    pub(crate) fn nearest(&mut self, frame: &FrameStamp, at_ns: u64) -> Option<FrameStamp> {
        self.find(frame.order(), at_ns).map(|(chunk, place)| chunk[place].0.stamp)
    }

    /// Reads a picture. `of` returns the ended frame of a stamp, where it is known, for close-ups.
    pub(crate) fn picture<'e>(
        &mut self,
        frame: &FrameStamp,
        at_ns: u64,
        of: impl Fn(&FrameStamp) -> Option<&'e EndedFrame>,
    ) -> Option<PagePicture> {
        let (chunk, place) = self.find(frame.order(), at_ns)?;
        let (header, jpeg) = &chunk[place];
        match self.make(header, jpeg, of(&header.stamp)) {
            Ok(picture) => Some(picture),
            Err(error) => {
                let sequence = header.stamp.sequence;
                self.trouble = Some(format!("the picture of frame {sequence}: {error:#}"));
                None
            }
        }
    }

    fn make(
        &mut self,
        header: &FrameHeader,
        jpeg: &[u8],
        ended: Option<&EndedFrame>,
    ) -> anyhow::Result<PagePicture> {
        let camera = &self.recorded.resolved.camera;
        let camera_px = [camera.width(), camera.height()];
        let size = jpeg_size(jpeg).unwrap_or_default();
        let is_whole = size == [header.width, header.height] && size == camera_px;
        let mut picture =
            PagePicture { stamp: header.stamp, size, jpeg: Vec::new(), closeups: Vec::new() };
        let tracks = ended.map_or(&[][..], |ended| &ended.tracks);
        let wants_closeups = is_whole && self.closeups.is_some() && !tracks.is_empty();
        if self.maker.is_shown_as_is(size) && !wants_closeups {
            picture.jpeg = jpeg.to_vec();
            return Ok(picture);
        }
        let decoded = decode(jpeg, camera_px)?;
        if self.maker.is_shown_as_is(size) {
            picture.jpeg = jpeg.to_vec();
        } else {
            picture.jpeg = self.maker.jpeg_of_decoded(&decoded)?.to_vec();
            picture.size = self.maker.size();
        }
        if wants_closeups && let Some(closeups) = &mut self.closeups {
            let header = FrameHeader { stride: header.width, ..*header };
            let (pixels, key) = (decoded.data_bytes()?, wire::key(&header.stamp));
            for track in tracks.iter().filter(is_shown_closely).take(MOST_CLOSEUPS) {
                picture.closeups.extend(closeups.closeup(&header, pixels, track, &key)?);
            }
        }
        Ok(picture)
    }

    /// The chunk of the newest picture up to this frame, and the picture's index there.
    fn find(&mut self, order: FrameOrder, at_ns: u64) -> Option<(Arc<Vec<FramePicture>>, usize)> {
        let images = self.recorded.images?;
        let mut chunk = self.recorded.recording.chunk_at(at_ns);
        loop {
            let has_images = |chunk: usize| {
                let place = self.recorded.recording.chunks().get(chunk);
                place.is_some_and(|place| place.channels.contains(&images))
            };
            chunk = (0..=chunk).rev().find(|chunk| has_images(*chunk))?;
            let pictures = self.of_chunk(chunk, images);
            // The source may be another process by then, but its earlier frames arrived earlier.
            let place = pictures.iter().rposition(|(header, _)| header.stamp.order() <= order);
            if let Some(place) = place {
                return Some((pictures, place));
            }
            chunk = chunk.checked_sub(1)?;
        }
    }

    /// The pictures of a chunk with their frames' headers.
    fn of_chunk(&mut self, chunk: usize, images: u16) -> Arc<Vec<FramePicture>> {
        if let Some((_, pictures)) = self.chunks.iter().find(|(known, _)| *known == chunk) {
            return pictures.clone();
        }
        let pictures = Arc::new(self.read_chunk(chunk, images).unwrap_or_else(|error| {
            self.trouble = Some(format!("{error}; what lies round it is shown"));
            Vec::new()
        }));
        if self.chunks.len() == MOST_CHUNKS {
            self.chunks.pop_front();
        }
        self.chunks.push_back((chunk, pictures.clone()));
        pictures
    }

    fn read_chunk(&self, chunk: usize, images: u16) -> Result<Vec<FramePicture>, RecordingError> {
        let Recorded { recording, channels, utc_from_exposure_ns, .. } = &*self.recorded;
        let is_frame = |channel| channels.is(channel, TopicId::Frames);
        let mut found = Vec::new();
        let mut headers: Vec<FrameHeader> = Vec::new();
        let header_at = |headers: &[FrameHeader], stamp_ns: i64| {
            let is_its = |header: &&FrameHeader| {
                header.stamp.exposure_ns.saturating_add(*utc_from_exposure_ns) == stamp_ns
            };
            headers.iter().rev().find(is_its).copied()
        };
        for message in
            recording.messages(chunk, |channel| channel == images || is_frame(channel))?
        {
            if message.channel != images {
                headers.extend(channels.frame(&message));
                continue;
            }
            let picture = decode_compressed(FRAME_IMAGES, &message.bytes)?;
            let mut header = header_at(&headers, picture.stamp.utc_ns());
            if header.is_none() && chunk > 0 {
                // A chunk may end between the header and its picture.
                let before = recording.messages(chunk - 1, is_frame)?;
                let before: Vec<_> =
                    before.iter().filter_map(|message| channels.frame(message)).collect();
                header = header_at(&before, picture.stamp.utc_ns());
            }
            if let Some(header) = header
                && picture.format == "jpeg"
            {
                found.push((header, picture.bytes.to_vec()));
            }
        }
        Ok(found)
    }
}
