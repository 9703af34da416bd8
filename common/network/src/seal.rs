//! Who vouches that a report is of the observer that its key names.

/// Signs what this drone says, and checks what the others say.
///
/// What it writes travels beside each report, as Zenoh's attachment.
pub trait Seal: std::fmt::Debug + Send + Sync {
    /// What goes with `payload`, said under `key` now.
    fn seal(&self, key: &str, payload: &[u8]) -> Vec<u8>;

    /// Checks what came with `payload`. An answer to a query may be one that was published too, so it is no
    /// replay.
    ///
    /// # Errors
    /// Why it does not count, for people.
    fn check(
        &self,
        key: &str,
        payload: &[u8],
        seal: Option<&[u8]>,
        is_answer: bool,
    ) -> Result<(), String>;
}
