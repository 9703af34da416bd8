//! Borrowed images.

use thiserror::Error;

/// Reason why bytes were refused as an image.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum ImageError {
    #[error("an image of {width}x{height} has no pixel")]
    Empty { width: usize, height: usize },
    #[error(
        "rows of {width} pixels lie {stride} bytes apart; the stride must be at least the width"
    )]
    Stride { width: usize, stride: usize },
    #[error("{height} rows, {stride} bytes apart, need {needed} bytes; there are {found}")]
    TooShort { height: usize, stride: usize, needed: usize, found: usize },
}

/// An 8-bit luma image in borrowed memory, for example a view in shared memory.
///
/// It has `height` rows of `width` bytes, `stride` bytes apart. [`LumaImage::new`] has checked that
/// they lie inside `pixels`.
#[derive(Debug, Clone, Copy)]
pub struct LumaImage<'a> {
    pixels: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> LumaImage<'a> {
    /// Borrows `height` rows of `width` pixels that begin `stride` bytes apart. The memory may end
    /// with the last pixel of the last row.
    pub fn new(
        pixels: &'a [u8],
        width: usize,
        height: usize,
        stride: usize,
    ) -> Result<Self, ImageError> {
        if width == 0 || height == 0 {
            return Err(ImageError::Empty { width, height });
        }
        if stride < width {
            return Err(ImageError::Stride { width, stride });
        }
        let needed = stride.saturating_mul(height - 1).saturating_add(width);
        if needed > pixels.len() {
            return Err(ImageError::TooShort { height, stride, needed, found: pixels.len() });
        }
        Ok(Self { pixels, width, height, stride })
    }

    /// Pixels in a row.
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// Bytes from one row to the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The memory from the first pixel on, at least `stride * (height - 1) + width` bytes.
    pub fn pixels(&self) -> &'a [u8] {
        self.pixels
    }

    /// Row `y`, counted from the top. Panics if there is no such row, as for a slice.
    #[inline]
    pub fn row(&self, y: usize) -> &'a [u8] {
        &self.pixels[y * self.stride..][..self.width]
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn rows_are_where_the_stride_says() {
        let pixels: Vec<u8> = (0..11).collect();
        let image = LumaImage::new(&pixels, 3, 3, 4).expect("2 * 4 + 3 bytes are there");
        assert_eq!(image.row(2), [8, 9, 10]);
    }

    #[test]
    fn images_outside_their_memory_are_refused() {
        let pixels = [0u8; 10];
        assert_eq!(
            LumaImage::new(&pixels, 3, 3, 4).unwrap_err(),
            ImageError::TooShort { height: 3, stride: 4, needed: 11, found: 10 }
        );
        assert!(LumaImage::new(&pixels, 3, 3, 2).is_err());
        assert!(LumaImage::new(&pixels, 0, 3, 2).is_err());
        assert!(LumaImage::new(&pixels, 3, usize::MAX, usize::MAX).is_err());
    }
}
