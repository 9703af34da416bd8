//! Pictures as ROS 2 messages. Their bytes are written at once and not one by one, because there are many.

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

/// `sensor_msgs/msg/Image` of a picture as it is. `frame` names the camera.
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

/// The picture in a `sensor_msgs/msg/Image` that [`encode_image`] gave.
///
/// # Errors
/// [`RecordingError::Message`] where the bytes are not those of such a picture.
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

/// A compressed picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compressed<'p> {
    /// Mid-exposure, UTC nanoseconds.
    pub stamp_ns: i64,
    /// Its format, such as `jpeg`.
    pub format: &'p str,
    /// Its bytes.
    pub bytes: &'p [u8],
}

/// The picture in a `sensor_msgs/msg/CompressedImage` that [`encode_compressed`] gave.
///
/// # Errors
/// [`RecordingError::Message`] where the bytes are not those of such a picture.
pub fn decode_compressed<'m>(
    channel: &str,
    message: &'m [u8],
) -> Result<Compressed<'m>, RecordingError> {
    let decode = || -> Result<Compressed<'m>, String> {
        let mut cdr = CdrReader::new(message)?;
        let (seconds, nanoseconds) = (cdr.u32()?.cast_signed(), cdr.u32()?);
        cdr.text()?;
        let format = cdr.text()?;
        let format = str::from_utf8(format).map_err(|_| "has a format that is no text")?;
        let length = cdr.u32()? as usize;
        let bytes = cdr.numbers(1, length)?;
        let stamp_ns = i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds);
        Ok(Compressed { stamp_ns, format, bytes })
    };
    decode().map_err(|reason| RecordingError::Message { channel: channel.to_owned(), reason })
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
    fn a_compressed_picture_comes_back_with_its_time() {
        let stamp = Time { sec: 1_700_000_001, nanosec: 5 };
        let message = encode_compressed(stamp, "wren/camera", "jpeg", b"picture");
        let read = decode_compressed("/frame", &message).unwrap();
        let stamp_ns = 1_700_000_001_000_000_005;
        assert_eq!(read, Compressed { stamp_ns, format: "jpeg", bytes: b"picture" });
        for end in 0..message.len() {
            assert!(decode_compressed("/frame", &message[..end]).is_err(), "{end} bytes");
        }
    }
}
