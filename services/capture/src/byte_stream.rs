//! Conversion of coded pictures from files and cameras to the byte stream of Annex B (ITU-T H.264
//! and H.265). Parameter sets are inserted before each key frame. Pictures are not recoded: the
//! decoder gives the same pixels.

use flockeye_contract::VideoCodec;

const START: [u8; 4] = [0, 0, 0, 1];

/// Converter for the packets of one stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ByteStream {
    codec: VideoCodec,
    /// Size of the length field before each unit, bytes; `None`: the input is a byte stream
    /// already.
    length_bytes: Option<usize>,
    /// Current parameter sets, without start codes.
    sets: Vec<Vec<u8>>,
    /// Highest temporal layer so far; H.264 has none.
    highest_layer: u8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Unit {
    /// Access unit delimiter, at the beginning of a picture.
    Delimiter,
    /// Top-level parameter set, to which the others refer.
    FirstSet,
    Set,
    Other,
}

impl ByteStream {
    /// A converter for a stream with these `codec_data` (ISO/IEC 14496-15, `avcC` and `hvcC`).
    /// Without them, the stream is a byte stream.
    pub(crate) fn new(codec: VideoCodec, codec_data: Option<&[u8]>) -> Result<Self, String> {
        let (length_bytes, sets) = match codec_data {
            None => (None, Vec::new()),
            Some(data) => {
                let read = match codec {
                    VideoCodec::H265 => hevc_configuration(data),
                    VideoCodec::H264 | VideoCodec::None => avc_configuration(data),
                };
                let (length_bytes, sets) =
                    read.ok_or("the stream's parameter sets cannot be read")?;
                (Some(length_bytes), sets)
            }
        };
        Ok(Self { codec, length_bytes, sets, highest_layer: 0 })
    }

    fn units<'p>(&self, picture: &'p [u8]) -> Option<Vec<&'p [u8]>> {
        let units = match self.length_bytes {
            Some(length_bytes) => units_by_length(picture, length_bytes),
            None => units_by_start_code(picture),
        };
        units.filter(|units| !units.is_empty())
    }

    /// Whether no other picture refers to this one, so that it can be left out (`nal_ref_idc` 0 in
    /// H.264; in H.265 a sub-layer non-reference picture of the highest temporal layer).
    pub(crate) fn is_disposable(&mut self, picture: &[u8]) -> bool {
        let Some(units) = self.units(picture) else { return false };
        let slices: Vec<&[u8]> = units.into_iter().filter(|unit| self.is_slice(unit)).collect();
        let layer = |slice: &&[u8]| match self.codec {
            VideoCodec::H265 => slice.get(1).map_or(0, |second| second & 7),
            VideoCodec::H264 | VideoCodec::None => 0,
        };
        let layer = slices.iter().map(layer).max().unwrap_or(0);
        self.highest_layer = self.highest_layer.max(layer);
        let is_referred_to = |slice: &&[u8]| match (self.codec, slice.first()) {
            // Types up to 14 are odd where later pictures of the layer may refer to them.
            (VideoCodec::H265, Some(first)) => (first >> 1) > 14 || (first >> 1) & 1 == 1,
            (VideoCodec::H264 | VideoCodec::None, Some(first)) => (first >> 5) & 3 != 0,
            (_, None) => true,
        };
        !slices.is_empty() && layer == self.highest_layer && !slices.iter().any(is_referred_to)
    }

    /// Whether a unit holds pixels.
    fn is_slice(&self, unit: &[u8]) -> bool {
        let first = unit.first().copied().unwrap_or(0);
        match self.codec {
            VideoCodec::H265 => (first >> 1) & 0x3F < 32,
            VideoCodec::H264 | VideoCodec::None => (1..=5).contains(&(first & 0x1F)),
        }
    }

    pub(crate) fn packet(&mut self, picture: &[u8], is_key: bool) -> Result<Vec<u8>, String> {
        let units = self.units(picture).ok_or("a picture's units are cut")?;
        let kinds: Vec<Unit> = units.iter().map(|unit| self.kind_of(unit)).collect();
        let has_sets = kinds.contains(&Unit::FirstSet);
        if has_sets {
            self.sets.clear();
        }
        for (unit, kind) in units.iter().zip(&kinds) {
            let is_set = matches!(kind, Unit::FirstSet | Unit::Set);
            if is_set && !self.sets.iter().any(|known| known == unit) {
                self.sets.push(unit.to_vec());
            }
        }
        let mut packet = Vec::with_capacity(picture.len() + 128);
        let mut add = |unit: &[u8]| {
            packet.extend_from_slice(&START);
            packet.extend_from_slice(unit);
        };
        let delimiters = kinds.iter().take_while(|kind| **kind == Unit::Delimiter).count();
        let (before, after) = units.split_at(delimiters);
        before.iter().for_each(|unit| add(unit));
        if is_key && !has_sets {
            self.sets.iter().for_each(|unit| add(unit));
        }
        after.iter().for_each(|unit| add(unit));
        Ok(packet)
    }

    fn kind_of(&self, unit: &[u8]) -> Unit {
        let first = unit.first().copied().unwrap_or(0);
        match self.codec {
            VideoCodec::H265 => match (first >> 1) & 0x3F {
                35 => Unit::Delimiter,
                32 => Unit::FirstSet,
                33 | 34 => Unit::Set,
                _ => Unit::Other,
            },
            VideoCodec::H264 | VideoCodec::None => match first & 0x1F {
                9 => Unit::Delimiter,
                7 => Unit::FirstSet,
                8 => Unit::Set,
                _ => Unit::Other,
            },
        }
    }
}

fn take<'b>(rest: &mut &'b [u8], count: usize) -> Option<&'b [u8]> {
    let (taken, left) = rest.split_at_checked(count)?;
    *rest = left;
    Some(taken)
}

/// Reads a big-endian number.
fn number(rest: &mut &[u8], bytes: usize) -> Option<usize> {
    Some(take(rest, bytes)?.iter().fold(0, |sum, &byte| sum << 8 | usize::from(byte)))
}

fn avc_configuration(mut data: &[u8]) -> Option<(usize, Vec<Vec<u8>>)> {
    let rest = &mut data;
    let [1, _, _, _, lengths] = *take(rest, 5)? else { return None };
    let mut sets = Vec::new();
    for mask in [0x1F, 0xFF] {
        for _ in 0..number(rest, 1)? & mask {
            let length = number(rest, 2)?;
            sets.push(take(rest, length)?.to_vec());
        }
    }
    Some((usize::from(lengths & 3) + 1, sets))
}

fn hevc_configuration(mut data: &[u8]) -> Option<(usize, Vec<Vec<u8>>)> {
    let rest = &mut data;
    let head = take(rest, 22)?;
    let mut sets = Vec::new();
    for _ in 0..number(rest, 1)? {
        take(rest, 1)?;
        for _ in 0..number(rest, 2)? {
            let length = number(rest, 2)?;
            sets.push(take(rest, length)?.to_vec());
        }
    }
    Some((usize::from(head[21] & 3) + 1, sets))
}

/// The units of a picture with length fields.
fn units_by_length(mut picture: &[u8], length_bytes: usize) -> Option<Vec<&[u8]>> {
    let rest = &mut picture;
    let mut units = Vec::new();
    while !rest.is_empty() {
        let length = number(rest, length_bytes)?;
        units.push(take(rest, length)?);
    }
    Some(units)
}

/// The units of a picture with start codes.
fn units_by_start_code(picture: &[u8]) -> Option<Vec<&[u8]>> {
    let starts: Vec<usize> = picture
        .windows(3)
        .enumerate()
        .filter(|(_, three)| *three == [0, 0, 1])
        .map(|(at, _)| at)
        .collect();
    // Zeros are allowed before the first start code.
    let first = *starts.first()?;
    if picture[..first].iter().any(|&byte| byte != 0) {
        return None;
    }
    let ends = starts.iter().skip(1).copied().chain([picture.len()]);
    let unit = |(start, end): (&usize, usize)| {
        let unit = &picture[start + 3..end];
        // Trailing zeros belong to the next start code.
        let length = unit.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1);
        &unit[..length]
    };
    Some(starts.iter().zip(ends).map(unit).collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const SPS: [u8; 3] = [0x67, 1, 2];
    const PPS: [u8; 2] = [0x68, 3];
    const IDR: [u8; 4] = [0x65, 0, 0, 9];

    fn joined(units: &[&[u8]]) -> Vec<u8> {
        units.iter().flat_map(|unit| [&START, *unit].concat()).collect()
    }

    #[test]
    fn pictures_that_no_other_refers_to_are_disposable() {
        let mut avc = ByteStream::new(VideoCodec::H264, None).unwrap();
        // Delimiter and slices: with nal_ref_idc 0, with 2, one of each, and none at all.
        for (units, expected) in [
            (&[&[9u8, 0x10][..], &[0x01, 5], &[0x01, 6]][..], true),
            (&[&[0x41, 5]], false),
            (&[&[0x01, 5], &[0x41, 5]], false),
            (&[&IDR], false),
            (&[&[9, 0x10], &SPS], false),
        ] {
            assert_eq!(avc.is_disposable(&joined(units)), expected, "{units:?}");
        }
        assert!(!avc.is_disposable(&[]));
        // TRAIL_N, TRAIL_R, RASL_N and CRA of the only layer.
        let mut hevc = ByteStream::new(VideoCodec::H265, None).unwrap();
        let slice = |kind: u8, layer: u8| joined(&[&[kind << 1, layer + 1, 7]]);
        let kinds = [0, 1, 8, 21].map(|kind| hevc.is_disposable(&slice(kind, 0)));
        assert_eq!(kinds, [true, false, true, false]);
        // Pictures of a higher layer may refer to it.
        assert!(hevc.is_disposable(&slice(0, 1)) && !hevc.is_disposable(&slice(0, 0)));
    }

    #[test]
    fn lengths_become_start_codes_and_key_frames_get_their_sets() {
        let data = [&[1, 66, 0, 30, 0xFF, 0xE1, 0, 3][..], &SPS, &[1, 0, 2], &PPS].concat();
        let mut stream = ByteStream::new(VideoCodec::H264, Some(&data)).unwrap();
        let delimiter = [9, 0x10];
        let picture = [&[0, 0, 0, 2][..], &delimiter, &[0, 0, 0, 4], &IDR].concat();
        let key = stream.packet(&picture, true).unwrap();
        assert_eq!(key, joined(&[&delimiter, &SPS, &PPS, &IDR]));
        let other = stream.packet(&[0, 0, 0, 2, 0x41, 5], false).unwrap();
        assert_eq!(other, joined(&[&[0x41, 5]]));
        for end in 1..picture.len() - 1 {
            let cut = stream.packet(&picture[..end], true);
            // A whole first unit is a picture too.
            assert_eq!(cut.is_ok(), end == 6, "{end} bytes");
        }
        for end in 0..data.len() {
            assert!(ByteStream::new(VideoCodec::H264, Some(&data[..end])).is_err(), "{end}");
        }
    }

    #[test]
    fn sets_that_came_once_are_repeated_and_new_ones_replace_them() {
        let mut stream = ByteStream::new(VideoCodec::H264, None).unwrap();
        let first = [&[0, 0, 1][..], &SPS, &START, &PPS, &START, &IDR].concat();
        assert_eq!(stream.packet(&first, true).unwrap(), joined(&[&SPS, &PPS, &IDR]));
        assert_eq!(stream.packet(&joined(&[&IDR]), true).unwrap(), joined(&[&SPS, &PPS, &IDR]));
        let other: [u8; 3] = [0x67, 7, 7];
        let changed = joined(&[&other, &PPS, &IDR]);
        assert_eq!(stream.packet(&changed, true).unwrap(), changed);
        assert_eq!(stream.packet(&joined(&[&IDR]), true).unwrap(), changed);
        assert!(stream.packet(b"nothing", true).is_err());
        assert!(stream.packet(&[5, 0, 0, 1, 5], true).is_err());
    }

    #[test]
    fn the_other_codec_has_three_kinds_of_sets() {
        let sets: [&[u8]; 3] = [&[0x40, 1, 1], &[0x42, 1, 2], &[0x44, 1, 3]];
        let mut data = vec![1; 21];
        data.extend([0xFF, 3]);
        for set in sets {
            data.extend([0x20, 0, 1, 0, 3]);
            data.extend(set);
        }
        let mut stream = ByteStream::new(VideoCodec::H265, Some(&data)).unwrap();
        let key = [0x26, 1, 5];
        let packet = stream.packet(&[0, 0, 0, 3, 0x26, 1, 5], true).unwrap();
        assert_eq!(packet, joined(&[sets[0], sets[1], sets[2], &key]));
    }
}
