//! JPEG encoding of frames.

use anyhow::ensure;
use opencv::core::{Mat, MatTraitConst, Rect, Vector};
use opencv::imgcodecs::{IMWRITE_JPEG_QUALITY, imencode};

/// JPEG quality, 0 to 100; details of the size of marker cells are preserved.
const QUALITY: i32 = 90;

/// Encodes 8-bit luma, rows of `stride` bytes, as JPEG.
///
/// # Errors
/// Too few pixels, or an error of OpenCV.
pub(crate) fn encode(
    pixels: &[u8],
    width: u32,
    height: u32,
    stride: u32,
) -> anyhow::Result<Vec<u8>> {
    let bytes = stride as usize * height as usize;
    ensure!(
        pixels.len() >= bytes && width <= stride && width > 0,
        "{} bytes are no picture of {width}x{height} pixels in rows of {stride}",
        pixels.len()
    );
    let (rows, columns) = (i32::try_from(height)?, i32::try_from(stride)?);
    let whole = Mat::new_rows_cols_with_data(rows, columns, &pixels[..bytes])?;
    let picture = whole.roi(Rect::new(0, 0, i32::try_from(width)?, rows))?;
    let mut jpeg = Vector::<u8>::new();
    let is_done = imencode(
        ".jpg",
        &picture,
        &mut jpeg,
        &Vector::from_slice(&[IMWRITE_JPEG_QUALITY, QUALITY]),
    )?;
    ensure!(is_done, "OpenCV does not write JPEG here");
    Ok(jpeg.into())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use opencv::imgcodecs::{IMREAD_GRAYSCALE, imdecode};

    #[test]
    fn a_picture_is_its_columns_without_what_fills_the_rows() {
        // Bright pixels, and black ones behind each row.
        let pixels: Vec<u8> = (0..32 * 48).map(|k| if k % 48 < 40 { 200 } else { 0 }).collect();
        let jpeg = encode(&pixels, 40, 32, 48).unwrap();
        let read = imdecode(&Vector::<u8>::from_slice(&jpeg), IMREAD_GRAYSCALE).unwrap();
        assert_eq!((read.cols(), read.rows()), (40, 32));
        let last = *read.at_2d::<u8>(31, 39).unwrap();
        assert!(last.abs_diff(200) < 8, "{last}");
        let error = encode(&pixels[1..], 40, 32, 48).unwrap_err().to_string();
        assert!(error.contains("no picture of 40x32"), "{error}");
    }
}
