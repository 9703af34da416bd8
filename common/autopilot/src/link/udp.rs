//! Datagrams to and from the autopilot or its router.

use std::io;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use mavlink::MavHeader;
use mavlink::dialects::development::MavMessage;

use super::decoder::decode;
use super::patience::{SILENT, TIMEOUT, is_timeout};
use flockeye_runtime::lock::lock;

/// Maximum length of a datagram, bytes; longer ones are cut. Packets of the usual networks have at
/// most 1,500 bytes.
const MAX_DATAGRAM: usize = 2048;

/// Address of the autopilot's last message, and its time of arrival; none before the first.
type LastSender = Mutex<Option<(SocketAddr, Instant)>>;

/// A UDP socket and the address at its other end. A clone shares both.
#[derive(Debug)]
pub struct UdpLine {
    socket: UdpSocket,
    /// The autopilot's address where the socket listens; none where it is connected to one host.
    last_sender: Option<Arc<LastSender>>,
}

/// Listens on this machine's address.
pub(super) fn listen(address: SocketAddr) -> io::Result<UdpLine> {
    line(UdpSocket::bind(address)?, Some(Arc::default()))
}

/// Connects to this host and port.
pub(super) fn connect(address: &str) -> io::Result<UdpLine> {
    let unknown = || io::Error::other(format!("{address} has no address"));
    let address = address.to_socket_addrs()?.next().ok_or_else(unknown)?;
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => ([0; 4], 0).into(),
        SocketAddr::V6(_) => ([0u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.connect(address)?;
    line(socket, None)
}

fn line(socket: UdpSocket, last_sender: Option<Arc<LastSender>>) -> io::Result<UdpLine> {
    socket.set_read_timeout(Some(TIMEOUT))?;
    socket.set_write_timeout(Some(TIMEOUT))?;
    Ok(UdpLine { socket, last_sender })
}

impl UdpLine {
    pub(super) fn try_clone(&self) -> io::Result<Self> {
        Ok(Self { socket: self.socket.try_clone()?, last_sender: self.last_sender.clone() })
    }

    /// Waits for a datagram and passes on its messages. `hear` returns whether the autopilot sent a
    /// message.
    pub(super) fn read(
        &self,
        hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool,
    ) -> io::Result<()> {
        let mut datagram = [0; MAX_DATAGRAM];
        let (length, sender) = match self.socket.recv_from(&mut datagram) {
            Ok(received) => received,
            Err(error) if is_timeout(&error) || is_nobody(&error) => return Ok(()),
            Err(error) => return Err(error),
        };
        let mut is_autopilot = false;
        decode(&datagram[..length], |header, message| is_autopilot |= hear(header, message));
        if is_autopilot && let Some(last_sender) = &self.last_sender {
            let mut last_sender = lock(last_sender);
            // Messages from another address are refused while the autopilot sends.
            let is_free =
                last_sender.is_none_or(|(peer, last)| peer == sender || last.elapsed() > SILENT);
            if is_free {
                *last_sender = Some((sender, Instant::now()));
            }
        }
        Ok(())
    }

    /// Sends a message; false where the autopilot's address is not known yet or nothing receives
    /// there.
    pub(super) fn write(&self, frame: &[u8]) -> io::Result<bool> {
        let sent = match &self.last_sender {
            None => self.socket.send(frame),
            Some(last_sender) => {
                let Some((peer, _)) = *lock(last_sender) else { return Ok(false) };
                self.socket.send_to(frame, peer)
            }
        };
        match sent {
            Ok(_) => Ok(true),
            Err(error) if is_timeout(&error) || is_nobody(&error) => Ok(false),
            Err(error) => Err(error),
        }
    }
}

/// Whether the error only means that nothing receives now: the autopilot or its network starts
/// later.
fn is_nobody(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, HostUnreachable, NetworkDown, NetworkUnreachable};
    matches!(error.kind(), ConnectionRefused | HostUnreachable | NetworkDown | NetworkUnreachable)
}
