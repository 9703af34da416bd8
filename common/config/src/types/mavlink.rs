//! Where an autopilot is, as text.

use std::fmt;
use std::net::SocketAddr;

/// Where an autopilot is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MavlinkAddress {
    /// It is listened for on this machine's address and port; answers go to whoever speaks for the autopilot.
    UdpIn(SocketAddr),
    /// It, or its router, listens there: host and port.
    UdpOut(String),
    /// On a serial line.
    Serial {
        /// The device.
        device: String,
        /// Bits a second.
        baud: u32,
    },
}

impl MavlinkAddress {
    /// Reads `udpin:ADDRESS:PORT` (or `udp:`, which is the same), `udpout:HOST:PORT` or `serial:DEVICE:BAUD`.
    ///
    /// # Errors
    /// What is wrong with the text, and what would be right.
    pub fn parse(text: &str) -> Result<Self, String> {
        Self::parse_after("", text)
    }

    /// The same where `before` stands before the text, as in `mavlink:serial:DEVICE:BAUD`.
    ///
    /// # Errors
    /// As [`parse`](Self::parse).
    pub fn parse_after(before: &str, text: &str) -> Result<Self, String> {
        match text.split_once(':') {
            Some((way @ ("udpin" | "udp"), address)) => match address.parse::<SocketAddr>() {
                Ok(address) => Ok(Self::UdpIn(address)),
                Err(_) => Err(format!("has no address to listen on: {before}{way}:0.0.0.0:14550")),
            },
            Some(("udpout", address)) => match address.rsplit_once(':') {
                Some((host, port))
                    if !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port != 0) =>
                {
                    Ok(Self::UdpOut(address.to_owned()))
                }
                _ => {
                    Err(format!("has no host and port to send to: {before}udpout:127.0.0.1:14550"))
                }
            },
            Some(("serial", line)) => match line.rsplit_once(':').map(|(d, b)| (d, b.parse())) {
                Some((device, Ok(baud))) if !device.is_empty() && baud > 0 => {
                    Ok(Self::Serial { device: device.to_owned(), baud })
                }
                _ => Err(format!("has no device and rate: {before}serial:/dev/ttyACM0:921600")),
            },
            _ => Err(format!(
                "is no way to an autopilot: {before}udpin:ADDRESS:PORT, {before}udpout:HOST:PORT or \
                 {before}serial:DEVICE:BAUD"
            )),
        }
    }

    /// What to do where the line cannot be opened or is lost.
    pub fn cure(&self) -> &'static str {
        match self {
            Self::UdpIn(_) => {
                "check that the address is this machine's and no other program has it (ss -lnup)"
            }
            Self::UdpOut(_) => "check the host's name and the network",
            Self::Serial { .. } => {
                "check the cable, the device, that this user may open it (group dialout) and that no other \
                 program has it"
            }
        }
    }
}

impl fmt::Display for MavlinkAddress {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpIn(address) => write!(formatter, "udpin:{address}"),
            Self::UdpOut(address) => write!(formatter, "udpout:{address}"),
            Self::Serial { device, baud } => write!(formatter, "serial:{device}:{baud}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_told_apart_and_written_back() {
        let serial = MavlinkAddress::Serial { device: "/dev/ttyACM0".into(), baud: 921_600 };
        assert_eq!(MavlinkAddress::parse("serial:/dev/ttyACM0:921600"), Ok(serial));
        let listening = MavlinkAddress::parse("udp:0.0.0.0:14550");
        assert_eq!(listening, Ok(MavlinkAddress::UdpIn(([0, 0, 0, 0], 14550).into())));
        for text in ["udpin:127.0.0.1:14540", "udpout:fc.local:14550", "serial:/dev/ttyS1:57600"] {
            assert_eq!(MavlinkAddress::parse(text).map(|link| link.to_string()), Ok(text.into()));
        }
    }

    #[test]
    fn wrong_addresses_say_what_is_right() {
        for (text, cure) in [
            ("udpin:14540", "udpin:0.0.0.0:14550"),
            ("udpin:localhost:14540", "udpin:0.0.0.0:14550"),
            ("udpout:10.0.0.1", "udpout:127.0.0.1:14550"),
            ("udpout:10.0.0.1:0", "udpout:127.0.0.1:14550"),
            ("serial:/dev/ttyACM0", "921600"),
            ("serial:/dev/ttyACM0:0", "921600"),
            ("tcp:1.2.3.4:5760", "udpout:HOST:PORT"),
            ("", "serial:DEVICE:BAUD"),
        ] {
            let found = MavlinkAddress::parse(text);
            assert!(found.as_ref().is_err_and(|error| error.contains(cure)), "{text}: {found:?}");
        }
    }
}
