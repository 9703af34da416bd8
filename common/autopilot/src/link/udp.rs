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

/// Longer datagrams are cut: nobody sends longer ones over a network whose packets have 1,500 bytes.
const MAX_DATAGRAM: usize = 2048;

/// Where the autopilot is.
#[derive(Debug)]
enum Peer {
    /// There; nobody else is heard.
    Fixed,
    /// Address that the last message came from, and its time.
    Heard(Mutex<Option<(SocketAddr, Instant)>>),
}

/// The half that receives.
#[derive(Debug)]
pub(crate) struct UdpReader {
    socket: UdpSocket,
    peer: Arc<Peer>,
    datagram: Box<[u8]>,
}

/// The half that sends.
#[derive(Debug)]
pub(crate) struct UdpWriter {
    socket: UdpSocket,
    peer: Arc<Peer>,
}

/// Listens on this machine's address.
pub(crate) fn listen(address: SocketAddr) -> io::Result<(UdpReader, UdpWriter)> {
    halves(UdpSocket::bind(address)?, Peer::Heard(Mutex::new(None)))
}

/// Talks to this host and port.
pub(crate) fn connect(address: &str) -> io::Result<(UdpReader, UdpWriter)> {
    let unknown = || io::Error::other(format!("{address} has no address"));
    let address = address.to_socket_addrs()?.next().ok_or_else(unknown)?;
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => ([0; 4], 0).into(),
        SocketAddr::V6(_) => ([0u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.connect(address)?;
    halves(socket, Peer::Fixed)
}

fn halves(socket: UdpSocket, peer: Peer) -> io::Result<(UdpReader, UdpWriter)> {
    socket.set_read_timeout(Some(TIMEOUT))?;
    socket.set_write_timeout(Some(TIMEOUT))?;
    let peer = Arc::new(peer);
    let writer = UdpWriter { socket: socket.try_clone()?, peer: peer.clone() };
    let datagram = vec![0; MAX_DATAGRAM].into_boxed_slice();
    Ok((UdpReader { socket, peer, datagram }, writer))
}

impl UdpReader {
    /// Waits for a datagram and hands on its messages. `hear` says whether the autopilot speaks.
    pub(crate) fn read(
        &mut self,
        hear: &mut dyn FnMut(MavHeader, &MavMessage) -> bool,
    ) -> io::Result<()> {
        let (length, sender) = match self.socket.recv_from(&mut self.datagram) {
            Ok(received) => received,
            Err(error) if is_timeout(&error) || is_nobody(&error) => return Ok(()),
            Err(error) => return Err(error),
        };
        let mut is_autopilot = false;
        decode(&self.datagram[..length], |header, message| is_autopilot |= hear(header, message));
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
}

impl UdpWriter {
    /// Sends a message; false where nobody is there yet.
    pub(crate) fn write(&mut self, frame: &[u8]) -> io::Result<bool> {
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
