//! Where a shader's buffers lie.

/// Whose memory the shader works in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Memory {
    /// The processor's: what either writes the other reads in place.
    Shared,
    /// The device's own: what it reads or writes is copied to or from memory that both see.
    Apart,
}
