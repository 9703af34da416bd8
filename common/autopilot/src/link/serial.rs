//! Bytes to and from the autopilot over a serial line.

use std::io::{self, Read, Write};

use mavlink::dialects::development::MavMessage;
use mavlink::error::MessageReadError;
use mavlink::{MavHeader, MavlinkReader};
use serialport::{DataBits, FlowControl, Parity, StopBits, TTYPort};

use super::{TIMEOUT, is_timeout};

/// The half that receives.
pub(crate) struct SerialReader {
    reader: MavlinkReader<OneRead<TTYPort>>,
}

/// The half that sends.
#[derive(Debug)]
pub(crate) struct SerialWriter {
    port: TTYPort,
}

/// Opens a device, which no other program can open then.
pub(crate) fn open(device: &str, baud: u32) -> io::Result<(SerialReader, SerialWriter)> {
    let port = serialport::new(device, baud)
        .data_bits(DataBits::Eight)
        .parity(Parity::None)
        .stop_bits(StopBits::One)
        .flow_control(FlowControl::None)
        .timeout(TIMEOUT)
        .open_native()?;
    let writer = SerialWriter { port: port.try_clone_native()? };
    let source = OneRead { source: port, has_read: false };
    Ok((SerialReader { reader: MavlinkReader::new(source) }, writer))
}

impl SerialReader {
    /// Waits for a message and hands it on.
    pub(crate) fn read(
        &mut self,
        hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool,
    ) -> io::Result<()> {
        match self.reader.read_any_message() {
            Ok((header, message)) => {
                hear(header, &message);
                Ok(())
            }
            // A message of another dialect.
            Err(MessageReadError::Parse(_)) => Ok(()),
            Err(MessageReadError::Io(error)) if is_timeout(&error) => Ok(()),
            Err(MessageReadError::Io(error)) => Err(error),
        }
    }
}

impl SerialWriter {
    /// Sends a message; false where the line takes no more. Half a message does no harm: readers find the next.
    pub(crate) fn write(&mut self, frame: &[u8]) -> io::Result<bool> {
        match self.port.write_all(frame) {
            Ok(()) => Ok(true),
            Err(error) if is_timeout(&error) => Ok(false),
            Err(error) => Err(error),
        }
    }
}

/// Gives up after each read. A line with the wrong rate gives bytes without end and never a message; whoever
/// reads until a message comes would never see that it shall stop.
struct OneRead<R> {
    source: R,
    has_read: bool,
}

impl<R: Read> Read for OneRead<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if std::mem::take(&mut self.has_read) {
            return Err(io::ErrorKind::TimedOut.into());
        }
        let count = self.source.read(buffer)?;
        self.has_read = true;
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_without_end_does_not_keep_the_reader() {
        let noise = OneRead { source: io::repeat(0xfd), has_read: false };
        let mut reader = MavlinkReader::new(noise);
        for _ in 0..1000 {
            let read = reader.read_any_message::<MavMessage>();
            assert!(
                matches!(&read, Err(MessageReadError::Io(error)) if is_timeout(error)),
                "{read:?}"
            );
        }
    }
}
