//! Pictures as ROS 2 messages. Their bytes are copied as one block, because there are many.

use flockeye_ros2::messages::Time;

use crate::cdr::{CdrReader, CdrWriter};
use crate::error::RecordingError;

/// A picture of 8-bit luma.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Image<'p> {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from row to row.
    pub step: u32,
    /// The pixels, row by row.
    pub pixels: &'p [u8],
}

fn header(cdr: &mut CdrWriter, stamp: Time, frame: &str) {
    cdr.numbers(4, &stamp.sec.to_le_bytes());
    cdr.u32(stamp.nanosec);
    cdr.text(frame.as_bytes());
}

/// `sensor_msgs/msg/Image` of an uncompressed picture. `frame` is the name of the camera frame.
pub fn encode_image(stamp: Time, frame: &str, image: &Image<'_>) -> Vec<u8> {
    let mut cdr = CdrWriter::with_capacity(image.pixels.len() + 128);
    header(&mut cdr, stamp, frame);
    cdr.u32(image.height);
    cdr.u32(image.width);
    cdr.text(b"mono8");
    cdr.numbers(1, &[0]);
    cdr.u32(image.step);
    cdr.length(image.pixels.len());
    cdr.numbers(1, image.pixels);
    cdr.finish()
}

/// The picture in a `sensor_msgs/msg/Image` from [`encode_image`].
pub fn decode_image<'m>(channel: &str, message: &'m [u8]) -> Result<Image<'m>, RecordingError> {
    let decode = || -> Result<Image<'m>, String> {
        let mut cdr = CdrReader::new(message)?;
        cdr.numbers(4, 2)?;
        cdr.text()?;
        let (height, width) = (cdr.u32()?, cdr.u32()?);
        let encoding = cdr.text()?;
        if encoding != b"mono8" {
            let encoding = String::from_utf8_lossy(encoding);
            return Err(format!("has pixels in {encoding}, not mono8"));
        }
        cdr.numbers(1, 1)?;
        let step = cdr.u32()?;
        let length = cdr.u32()? as usize;
        let pixels = cdr.numbers(1, length)?;
        Ok(Image { width, height, step, pixels })
    };
    decode().map_err(|reason| RecordingError::Message { channel: channel.to_owned(), reason })
}

/// `sensor_msgs/msg/CompressedImage` of a picture in `format`, such as `jpeg`.
pub fn encode_compressed(stamp: Time, frame: &str, format: &str, bytes: &[u8]) -> Vec<u8> {
    let mut cdr = CdrWriter::with_capacity(bytes.len() + 128);
    header(&mut cdr, stamp, frame);
    cdr.text(format.as_bytes());
    cdr.length(bytes.len());
    cdr.numbers(1, bytes);
    cdr.finish()
}

/// A compressed picture or video packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compressed<'m> {
    /// Mid-exposure, UTC.
    pub stamp: Time,
    /// The compression: `jpeg`, `h264` or `h265`.
    pub format: &'m str,
    /// The compressed bytes.
    pub bytes: &'m [u8],
}

/// The picture in a `sensor_msgs/msg/CompressedImage`.
pub fn decode_compressed<'m>(
    channel: &str,
    message: &'m [u8],
) -> Result<Compressed<'m>, RecordingError> {
    decode_with(channel, message, |cdr, stamp| {
        let format = format_of(cdr.text()?)?;
        Ok(Compressed { stamp, format, bytes: sequence(cdr)? })
    })
}

/// `foxglove_msgs/msg/CompressedVideo` of a packet in `format`: `h264` or `h265`.
pub fn encode_video(stamp: Time, frame: &str, format: &str, bytes: &[u8]) -> Vec<u8> {
    let mut cdr = CdrWriter::with_capacity(bytes.len() + 128);
    header(&mut cdr, stamp, frame);
    cdr.length(bytes.len());
    cdr.numbers(1, bytes);
    cdr.text(format.as_bytes());
    cdr.finish()
}

/// The packet in a `foxglove_msgs/msg/CompressedVideo`.
pub fn decode_video<'m>(
    channel: &str,
    message: &'m [u8],
) -> Result<Compressed<'m>, RecordingError> {
    decode_with(channel, message, |cdr, stamp| {
        let bytes = sequence(cdr)?;
        Ok(Compressed { stamp, bytes, format: format_of(cdr.text()?)? })
    })
}

/// Reads a message: time and frame first, which both types have in common, then `rest`.
fn decode_with<'m>(
    channel: &str,
    message: &'m [u8],
    rest: impl FnOnce(&mut CdrReader<'m>, Time) -> Result<Compressed<'m>, String>,
) -> Result<Compressed<'m>, RecordingError> {
    let decode = || {
        let mut cdr = CdrReader::new(message)?;
        let stamp = time(&mut cdr)?;
        cdr.text()?;
        rest(&mut cdr, stamp)
    };
    decode().map_err(|reason| RecordingError::Message { channel: channel.to_owned(), reason })
}

fn sequence<'m>(cdr: &mut CdrReader<'m>) -> Result<&'m [u8], String> {
    let length = cdr.u32()? as usize;
    cdr.numbers(1, length)
}

fn time(cdr: &mut CdrReader<'_>) -> Result<Time, String> {
    let (sec, nanosec) = (cdr.u32()?.cast_signed(), cdr.u32()?);
    Ok(Time { sec, nanosec })
}

fn format_of(text: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(text).map_err(|_| "names its format by no text".to_owned())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_picture_comes_back_and_half_a_picture_is_refused() {
        let pixels: Vec<u8> = (0..24).collect();
        let image = Image { width: 5, height: 4, step: 6, pixels: &pixels };
        let message = encode_image(Time::default(), "wren/camera", &image);
        assert_eq!(decode_image("/view", &message).unwrap(), image);
        for end in 0..message.len() {
            let error = decode_image("/view", &message[..end]).unwrap_err().to_string();
            assert!(error.starts_with("a message of /view "), "{error}");
        }
    }

    #[test]
    fn what_is_compressed_comes_back_and_half_of_it_is_refused() {
        type Encode = fn(Time, &str, &str, &[u8]) -> Vec<u8>;
        type Decode = for<'m> fn(&str, &'m [u8]) -> Result<Compressed<'m>, RecordingError>;
        let stamp = Time { sec: -3, nanosec: 7 };
        let bytes = [0, 0, 1, 9, 8];
        let ways: [(&str, Encode, Decode); 2] =
            [("jpeg", encode_compressed, decode_compressed), ("h264", encode_video, decode_video)];
        for (format, encode, decode) in ways {
            let message = encode(stamp, "wren/camera", format, &bytes);
            let found = decode("/x", &message).unwrap();
            assert_eq!(found, Compressed { stamp, format, bytes: &bytes });
            for end in 0..message.len() {
                let error = decode("/x", &message[..end]).unwrap_err().to_string();
                assert!(error.starts_with("a message of /x "), "{error}");
            }
        }
    }
}
