//! The line to the autopilot: opening, reading and writing, each without blocking for long.

mod decoder;
mod patience;
mod serial;
mod udp;

use std::io;

use flockeye_config::MavlinkAddress;
use mavlink::MavHeader;
use mavlink::dialects::development::MavMessage;

pub use decoder::decode;
pub(crate) use patience::SILENT;

/// The receiving half of the line.
pub enum LineReader {
    /// Datagrams.
    Udp(udp::UdpLine),
    /// Bytes of a serial line.
    Serial(serial::SerialReader),
}

/// The sending half of the line.
pub enum LineWriter {
    /// Datagrams.
    Udp(udp::UdpLine),
    /// Bytes of a serial line.
    Serial(serial::Port),
}

/// Opens the line.
///
/// # Errors
/// The address is not this machine's or is in use, the host is unknown, or the device does not
/// exist.
pub fn open(address: &MavlinkAddress) -> io::Result<(LineReader, LineWriter)> {
    let line = match address {
        MavlinkAddress::UdpIn(address) => udp::listen(*address)?,
        MavlinkAddress::UdpOut(address) => udp::connect(address)?,
        MavlinkAddress::Serial { device, baud } => {
            let (reader, writer) = serial::open(device, *baud)?;
            return Ok((LineReader::Serial(reader), LineWriter::Serial(writer)));
        }
    };
    Ok((LineReader::Udp(line.try_clone()?), LineWriter::Udp(line)))
}

impl LineReader {
    /// Waits a short time, and passes on the messages that arrived. `hear` returns whether the
    /// autopilot sent a message.
    ///
    /// # Errors
    /// The line is lost.
    pub fn read(&mut self, hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool) -> io::Result<()> {
        match self {
            Self::Udp(line) => line.read(hear),
            Self::Serial(reader) => serial::read(reader, hear),
        }
    }
}

impl LineWriter {
    /// Sends a message; false where it was dropped: nothing receives yet, or the line is full.
    ///
    /// # Errors
    /// The line is lost.
    pub fn write(&mut self, frame: &[u8]) -> io::Result<bool> {
        match self {
            Self::Udp(line) => line.write(frame),
            Self::Serial(port) => port.write(frame),
        }
    }
}
