//! The bytes of plain CDR, little-endian, after the four bytes of an encapsulation header (OMG
//! CORBA 3.4, 9.3; DDSI-RTPS 2.3, 10.2).

/// `CDR_LE`, no options.
const ENCAPSULATION: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// Bytes that are being written.
pub(crate) struct CdrWriter {
    bytes: Vec<u8>,
}

impl CdrWriter {
    /// Begins a message; it is expected to have so many bytes.
    pub(crate) fn with_capacity(bytes: usize) -> Self {
        let mut all = Vec::with_capacity(bytes + ENCAPSULATION.len());
        all.extend_from_slice(&ENCAPSULATION);
        Self { bytes: all }
    }

    /// Numbers of `size` bytes each, which lie one after the other, little-endian.
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

    /// A length of a sequence or text.
    pub(crate) fn length(&mut self, length: usize) {
        // Messages are bounded by the contract, far below 2^32.
        self.u32(u32::try_from(length).unwrap_or(u32::MAX));
    }

    /// A text, with the zero byte behind it that CDR counts.
    pub(crate) fn text(&mut self, text: &[u8]) {
        self.length(text.len() + 1);
        self.bytes.extend_from_slice(text);
        self.bytes.push(0);
    }

    /// The message.
    pub(crate) fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Alignment counts from after the encapsulation header.
    fn align(&mut self, size: usize) {
        let place = self.bytes.len() - ENCAPSULATION.len();
        self.bytes.resize(self.bytes.len() + place.next_multiple_of(size) - place, 0);
    }
}

/// Bytes that are being read. Everything is bounded by what is there.
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
        // `numbers` gives as many bytes as were asked for.
        Ok(u32::from_le_bytes(bytes.try_into().unwrap_or_default()))
    }

    /// A text, without the zero byte behind it.
    pub(crate) fn text(&mut self) -> Result<&'b [u8], String> {
        let length = self.u32()? as usize;
        let text = self.take(length)?;
        text.strip_suffix(&[0]).ok_or_else(|| "has a text without its end".to_owned())
    }

    /// What follows, of which there must be no more.
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
