//! The line to the autopilot: opened, read and written, each without blocking for long.

mod address;
mod decoder;
mod serial;
mod udp;

use std::io;
use std::time::Duration;

use mavlink::MavHeader;
use mavlink::dialects::development::MavMessage;

pub use address::LinkAddress;
pub use decoder::decode;

/// The longest that reading or writing blocks.
const TIMEOUT: Duration = Duration::from_millis(100);
/// An autopilot that is silent for so long may speak from elsewhere: they send heartbeats each second.
pub(crate) const SILENT: Duration = Duration::from_secs(3);

/// The half that receives.
pub(crate) enum LineReader {
    Udp(udp::UdpReader),
    Serial(serial::SerialReader),
}

/// The half that sends.
pub(crate) enum LineWriter {
    Udp(udp::UdpWriter),
    Serial(serial::SerialWriter),
}

/// Opens the line.
pub(crate) fn open(address: &LinkAddress) -> io::Result<(LineReader, LineWriter)> {
    let of_udp = |(reader, writer)| (LineReader::Udp(reader), LineWriter::Udp(writer));
    match address {
        LinkAddress::UdpIn(address) => udp::listen(*address).map(of_udp),
        LinkAddress::UdpOut(address) => udp::connect(address).map(of_udp),
        LinkAddress::Serial { device, baud } => serial::open(device, *baud)
            .map(|(reader, writer)| (LineReader::Serial(reader), LineWriter::Serial(writer))),
    }
}

impl LineReader {
    /// Waits a short time, and hands on the messages that came. `hear` says whether it was the autopilot who
    /// spoke.
    ///
    /// # Errors
    /// The line is lost.
    pub(crate) fn read(
        &mut self,
        hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool,
    ) -> io::Result<()> {
        match self {
            Self::Udp(reader) => reader.read(hear),
            Self::Serial(reader) => reader.read(hear),
        }
    }
}

impl LineWriter {
    /// Sends a message; false where it went nowhere: nobody is there yet, or the line takes no more.
    ///
    /// # Errors
    /// The line is lost.
    pub(crate) fn write(&mut self, frame: &[u8]) -> io::Result<bool> {
        match self {
            Self::Udp(writer) => writer.write(frame),
            Self::Serial(writer) => writer.write(frame),
        }
    }
}

fn is_timeout(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), TimedOut | WouldBlock | Interrupted)
}
