//! The line to the autopilot: opened, read and written, each without blocking for long.

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

/// The half that receives.
pub struct LineReader(Reader);

enum Reader {
    Udp(udp::UdpReader),
    Serial(serial::SerialReader),
}

/// The half that sends.
pub struct LineWriter(Writer);

enum Writer {
    Udp(udp::UdpWriter),
    Serial(serial::SerialWriter),
}

/// Opens the line.
///
/// # Errors
/// The address is not this machine's or is taken, the host is unknown, or the device is not there.
pub fn open(address: &MavlinkAddress) -> io::Result<(LineReader, LineWriter)> {
    let (reader, writer) = match address {
        MavlinkAddress::UdpIn(address) => of_udp(udp::listen(*address)?),
        MavlinkAddress::UdpOut(address) => of_udp(udp::connect(address)?),
        MavlinkAddress::Serial { device, baud } => {
            let (reader, writer) = serial::open(device, *baud)?;
            (Reader::Serial(reader), Writer::Serial(writer))
        }
    };
    Ok((LineReader(reader), LineWriter(writer)))
}

fn of_udp((reader, writer): (udp::UdpReader, udp::UdpWriter)) -> (Reader, Writer) {
    (Reader::Udp(reader), Writer::Udp(writer))
}

impl LineReader {
    /// Waits a short time, and hands on the messages that came. `hear` says whether it was the autopilot who
    /// spoke.
    ///
    /// # Errors
    /// The line is lost.
    pub fn read(&mut self, hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool) -> io::Result<()> {
        match &mut self.0 {
            Reader::Udp(reader) => reader.read(hear),
            Reader::Serial(reader) => reader.read(hear),
        }
    }
}

impl LineWriter {
    /// Sends a message; false where it went nowhere: nobody is there yet, or the line takes no more.
    ///
    /// # Errors
    /// The line is lost.
    pub fn write(&mut self, frame: &[u8]) -> io::Result<bool> {
        match &mut self.0 {
            Writer::Udp(writer) => writer.write(frame),
            Writer::Serial(writer) => writer.write(frame),
        }
    }
}
