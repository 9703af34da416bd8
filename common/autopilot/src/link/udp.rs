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

/// Longer datagrams are cut: nobody sends longer ones over a network whose packets have 1,500
/// bytes.
const MAX_DATAGRAM: usize = 2048;

/// Where the autopilot is.
#[derive(Debug)]
enum Peer {
    /// There; nobody else is heard.
    Fixed,
    /// Address that the last message came from, and its time.
    Heard(Mutex<Option<(SocketAddr, Instant)>>),
}

/// A socket, and who is at its other end. Its clone is the same line.
#[derive(Debug)]
pub struct UdpLine {
    socket: UdpSocket,
    peer: Arc<Peer>,
}

/// Listens on this machine's address.
pub(super) fn listen(address: SocketAddr) -> io::Result<UdpLine> {
    line(UdpSocket::bind(address)?, Peer::Heard(Mutex::new(None)))
}

/// Talks to this host and port.
pub(super) fn connect(address: &str) -> io::Result<UdpLine> {
    let unknown = || io::Error::other(format!("{address} has no address"));
    let address = address.to_socket_addrs()?.next().ok_or_else(unknown)?;
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => ([0; 4], 0).into(),
        SocketAddr::V6(_) => ([0u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.connect(address)?;
    line(socket, Peer::Fixed)
}

fn line(socket: UdpSocket, peer: Peer) -> io::Result<UdpLine> {
    socket.set_read_timeout(Some(TIMEOUT))?;
    socket.set_write_timeout(Some(TIMEOUT))?;
    Ok(UdpLine { socket, peer: Arc::new(peer) })
}

impl UdpLine {
    pub(super) fn try_clone(&self) -> io::Result<Self> {
        Ok(Self { socket: self.socket.try_clone()?, peer: self.peer.clone() })
    }

    /// Waits for a datagram and hands on its messages. `hear` says whether the autopilot speaks.
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
        if is_autopilot && let Peer::Heard(heard) = &*self.peer {
            let mut heard = lock(heard);
            // Messages from another address are refused while the autopilot sends.
            let is_free =
                heard.is_none_or(|(peer, last)| peer == sender || last.elapsed() > SILENT);
            if is_free {
                *heard = Some((sender, Instant::now()));
            }
        }
        Ok(())
    }

    /// Sends a message; false where nobody is there yet.
    pub(super) fn write(&self, frame: &[u8]) -> io::Result<bool> {
        let sent = match &*self.peer {
            Peer::Fixed => self.socket.send(frame),
            Peer::Heard(heard) => {
                let Some((peer, _)) = *lock(heard) else { return Ok(false) };
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

/// Whether the error only means that nobody receives now: the autopilot starts later, or its
/// network does.
fn is_nobody(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, HostUnreachable, NetworkDown, NetworkUnreachable};
    matches!(error.kind(), ConnectionRefused | HostUnreachable | NetworkDown | NetworkUnreachable)
}
