//! Bytes to and from the autopilot over a serial line.
//!
//! The device is opened here and not by `mavlink`. Its connection reads until a message arrives,
//! and writes until the line accepts everything, so its calls may never return.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::time::Instant;

use mavlink::dialects::development::MavMessage;
use mavlink::error::MessageReadError;
use mavlink::{MavHeader, MavlinkReader};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;
use rustix::termios::{ControlModes, OptionalActions, ioctl_tiocexcl, tcgetattr, tcsetattr};

use super::patience::{TIMEOUT, is_timeout};

/// The receiving half of the line.
pub(super) type SerialReader = MavlinkReader<OneRead<Port>>;

/// Opens a device exclusively. The halves receive and send.
pub(super) fn open(device: &str, baud: u32) -> io::Result<(SerialReader, Port)> {
    // The flags skip the wait for a carrier, and prevent a controlling terminal.
    let flags = (OFlags::NONBLOCK | OFlags::NOCTTY).bits();
    let flags = i32::try_from(flags).map_err(io::Error::other)?;
    let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(device)?;
    ioctl_tiocexcl(&file)?;
    // Eight bits, no parity, one stop bit, no flow control.
    let mut line = tcgetattr(&file)?;
    line.make_raw();
    line.control_modes.remove(ControlModes::CSTOPB | ControlModes::CRTSCTS);
    line.control_modes.insert(ControlModes::CREAD | ControlModes::CLOCAL);
    line.set_speed(baud)?;
    tcsetattr(&file, OptionalActions::Now, &line)?;
    let port = Port(file.try_clone()?);
    let source = OneRead { source: Port(file), has_read: false };
    Ok((MavlinkReader::new(source), port))
}

/// Waits for a message and passes it on.
pub(super) fn read(
    reader: &mut SerialReader,
    hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool,
) -> io::Result<()> {
    match reader.read_any_message() {
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

/// An open device. No call blocks for longer than [`TIMEOUT`].
pub struct Port(File);

impl Port {
    /// Sends a message; false where the line is full. An incomplete message does no harm: readers
    /// find the next.
    pub(super) fn write(&mut self, frame: &[u8]) -> io::Result<bool> {
        match self.write_all(frame) {
            Ok(()) => Ok(true),
            Err(error) if is_timeout(&error) => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn write_all(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        let began = Instant::now();
        while !bytes.is_empty() {
            if began.elapsed() > TIMEOUT {
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.wait(PollFlags::OUT)?;
            match self.0.write(bytes) {
                Ok(count) => bytes = &bytes[count..],
                // The buffer had less room than reported.
                Err(error) if is_timeout(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    fn wait(&self, wanted: PollFlags) -> io::Result<()> {
        let mut waiting = [PollFd::new(&self.0, wanted)];
        let timeout = Timespec::try_from(TIMEOUT).map_err(io::Error::other)?;
        if poll(&mut waiting, Some(&timeout))? == 0 {
            return Err(io::ErrorKind::TimedOut.into());
        }
        // If the line is lost, reading and writing return the reason.
        Ok(())
    }
}

impl Read for Port {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.wait(PollFlags::IN)?;
        self.0.read(buffer)
    }
}

/// Reports a timeout after each read. A line with the wrong rate yields endless bytes and never a
/// message. So a reader that waits for a message would never stop.
pub struct OneRead<R> {
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
