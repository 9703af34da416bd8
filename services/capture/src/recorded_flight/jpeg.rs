//! Checks of a JPEG before decoding: decoders fill missing data with gray without an error.

/// Maximum number of bytes after the end marker, which some cameras write.
const TAIL: usize = 65_536;

/// The size of a complete picture: columns and rows. The error is the reason of a failed check
/// (ITU-T T.81, annex B).
pub(crate) fn size(bytes: &[u8]) -> Result<(u32, u32), String> {
    if !bytes.starts_with(&[0xFF, 0xD8]) {
        return Err("it is no JPEG".to_owned());
    }
    let tail = &bytes[bytes.len().saturating_sub(TAIL)..];
    if !tail.windows(2).any(|pair| pair == [0xFF, 0xD9]) {
        return Err("it was cut short: its end marker is missing".to_owned());
    }
    let damaged = || "its markers are damaged".to_owned();
    let mut rest = &bytes[2..];
    loop {
        let [0xFF, marker, high, low, ..] = *rest else { return Err(damaged()) };
        let length = usize::from(u16::from_be_bytes([high, low]));
        let segment = rest.get(4..2 + length).ok_or_else(damaged)?;
        match marker {
            // Frame headers; DHT, JPG and DAC markers are in the same range.
            0xC0..=0xCF if !matches!(marker, 0xC4 | 0xC8 | 0xCC) => {
                let [_, y1, y0, x1, x0, ..] = *segment else { return Err(damaged()) };
                let side = |bytes| u32::from(u16::from_be_bytes(bytes));
                return Ok((side([x1, x0]), side([y1, y0])));
            }
            0x01 | 0xD0..=0xDA => return Err(damaged()),
            _ => rest = &rest[2 + length..],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_size_is_found_and_damage_is_named() {
        let picture = |marker: u8| {
            let mut bytes = vec![0xFF, 0xD8, 0xFF, 0xE0, 0, 4, 1, 2, 0xFF, marker, 0, 11, 8];
            bytes.extend([2, 0, 4, 0, 1, 1, 0x11, 0, 0xFF, 0xDA, 0, 2, 7, 7, 0xFF, 0xD9]);
            bytes
        };
        assert_eq!(size(&picture(0xC0)), Ok((1024, 512)));
        assert_eq!(size(&picture(0xC2)), Ok((1024, 512)));
        assert_eq!(size(&picture(0xC4)), Err("its markers are damaged".to_owned()));
        let whole = picture(0xC0);
        for end in 0..whole.len() {
            assert!(size(&whole[..end]).is_err(), "{end} bytes");
        }
        let mut damaged = whole;
        damaged[8] = 0;
        assert!(size(&damaged).is_err());
    }
}
