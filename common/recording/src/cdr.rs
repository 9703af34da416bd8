//! Plain CDR, little-endian, after an encapsulation header of four bytes. Sources: OMG CORBA 3.4,
//! 9.3; DDSI-RTPS 2.3, 10.2.

/// `CDR_LE`, no options.
const ENCAPSULATION: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// A CDR message that is being written.
pub(crate) struct CdrWriter {
    bytes: Vec<u8>,
}

impl CdrWriter {
    /// Begins a message, with memory for `bytes` bytes.
    pub(crate) fn with_capacity(bytes: usize) -> Self {
        let mut all = Vec::with_capacity(bytes + ENCAPSULATION.len());
        all.extend_from_slice(&ENCAPSULATION);
        Self { bytes: all }
    }

    /// Appends numbers of `size` bytes each: consecutive, little-endian.
    pub(crate) fn numbers(&mut self, size: usize, numbers: &[u8]) {
        if !numbers.is_empty() {
            self.align(size);
        }
        self.bytes.extend_from_slice(numbers);
    }

    /// A number of 32 bits.
    pub(crate) fn u32(&mut self, number: u32) {
        self.numbers(4, &number.to_le_bytes());
    }

    /// Appends the length of a sequence or text.
    pub(crate) fn length(&mut self, length: usize) {
        // The contract limits messages to far less than 2^32 bytes.
        self.u32(u32::try_from(length).unwrap_or(u32::MAX));
    }

    /// Appends a text and its final zero byte, which CDR includes in the length.
    pub(crate) fn text(&mut self, text: &[u8]) {
        self.length(text.len() + 1);
        self.bytes.extend_from_slice(text);
        self.bytes.push(0);
    }

    /// The finished message.
    pub(crate) fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Pads to a multiple of `size`. CDR counts from the end of the encapsulation header.
    fn align(&mut self, size: usize) {
        let place = self.bytes.len() - ENCAPSULATION.len();
        self.bytes.resize(self.bytes.len() + place.next_multiple_of(size) - place, 0);
    }
}

/// A CDR message that is being read. No method reads beyond its end.
pub(crate) struct CdrReader<'b> {
    bytes: &'b [u8],
    place: usize,
}

impl<'b> CdrReader<'b> {
    /// Begins a message.
    pub(crate) fn new(message: &'b [u8]) -> Result<Self, String> {
        match message.strip_prefix(&ENCAPSULATION) {
            Some(bytes) => Ok(Self { bytes, place: 0 }),
            None => Err("is not in little-endian CDR".to_owned()),
        }
    }

    /// `count` numbers of `size` bytes each.
    pub(crate) fn numbers(&mut self, size: usize, count: usize) -> Result<&'b [u8], String> {
        if count == 0 {
            return Ok(&[]);
        }
        self.place = self.place.next_multiple_of(size);
        self.take(size.saturating_mul(count))
    }

    /// A number of 32 bits.
    pub(crate) fn u32(&mut self) -> Result<u32, String> {
        let bytes = self.numbers(4, 1)?;
        // `numbers` returns exactly four bytes.
        Ok(u32::from_le_bytes(bytes.try_into().unwrap_or_default()))
    }

    /// A text, without its final zero byte.
    pub(crate) fn text(&mut self) -> Result<&'b [u8], String> {
        let length = self.u32()? as usize;
        let text = self.take(length)?;
        text.strip_suffix(&[0]).ok_or_else(|| "has a text without its end".to_owned())
    }

    /// The bytes that were not read; empty in a valid message.
    pub(crate) fn rest(self) -> &'b [u8] {
        self.bytes.get(self.place..).unwrap_or_default()
    }

    fn take(&mut self, length: usize) -> Result<&'b [u8], String> {
        let end = self.place.saturating_add(length);
        let Some(taken) = self.bytes.get(self.place..end) else {
            return Err(format!("ends after {} bytes, where {end} are needed", self.bytes.len()));
        };
        self.place = end;
        Ok(taken)
    }
}
