//! Names of bounded length inside shared-memory types.

use std::fmt;

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

/// UTF-8 text of at most `N` bytes, filled up with zero bytes.
///
/// A name that does not fit is cut between two characters. Bytes that are no UTF-8 (a foreign stage
/// may write anything) are shown as U+FFFD and never trusted.
#[derive(Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
#[repr(C)]
pub struct Text<const N: usize> {
    bytes: [u8; N],
}

// SAFETY: one array of bytes, for which every bit pattern is valid; no padding.
unsafe impl<const N: usize> Zeroable for Text<N> {}
// SAFETY: as above; `repr(C)`, `Copy`, `'static`.
unsafe impl<const N: usize> Pod for Text<N> {}

impl<const N: usize> Text<N> {
    /// The text without the zero bytes behind it.
    pub fn to_string_lossy(&self) -> std::borrow::Cow<'_, str> {
        let length = self.bytes.iter().position(|&byte| byte == 0).unwrap_or(N);
        String::from_utf8_lossy(&self.bytes[..length])
    }
}

impl<const N: usize> Default for Text<N> {
    fn default() -> Self {
        Self { bytes: [0; N] }
    }
}

impl<const N: usize> From<&str> for Text<N> {
    fn from(text: &str) -> Self {
        let mut length = text.len().min(N);
        while !text.is_char_boundary(length) {
            length -= 1;
        }
        let mut bytes = [0; N];
        bytes[..length].copy_from_slice(&text.as_bytes()[..length]);
        Self { bytes }
    }
}

impl<const N: usize> fmt::Display for Text<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.to_string_lossy())
    }
}

impl<const N: usize> fmt::Debug for Text<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.to_string_lossy(), f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_names_are_cut_at_a_character() {
        let text = Text::<4>::from("abcä");
        assert_eq!(text.to_string_lossy(), "abc");
        assert_eq!(Text::<5>::from("abcä").to_string_lossy(), "abcä");
    }

    #[test]
    fn foreign_bytes_do_not_panic() {
        let text: Text<3> = bytemuck::cast([0xff, b'a', 0]);
        assert_eq!(text.to_string(), "\u{fffd}a");
    }
}
