//! The launcher's side of the control channel. It is polled, and never waits for a client.

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context;

use super::{ControlRequest, MAX_REQUEST_BYTES, Reply, socket_path};

/// Timeout of a client that has not sent its request.
const REQUEST_TIME: Duration = Duration::from_secs(2);
/// Maximum number of clients at once; further clients wait.
const MAX_CLIENTS: usize = 16;

/// Number of a connected client.
pub(crate) type ClientId = u64;

struct ControlClient {
    stream: UnixStream,
    received: Vec<u8>,
    since: Instant,
    has_asked: bool,
}

/// The socket, and the connected clients.
pub(crate) struct Server {
    listener: UnixListener,
    clients: BTreeMap<ClientId, ControlClient>,
    next: ClientId,
}

impl Server {
    /// Opens the socket of the instance in `folder`.
    ///
    /// # Errors
    /// The system's reason.
    pub(crate) fn open(folder: &Path) -> anyhow::Result<Self> {
        let path = socket_path(folder);
        let context = || format!("cannot open the control channel {}", path.display());
        // A killed launcher leaves its socket. Only one launcher at a time owns the instance.
        drop(std::fs::remove_file(&path));
        // The folder is accessible to its owner only, so no other user reaches the socket before
        // its mode is set.
        let listener = UnixListener::bind(&path).with_context(context)?;
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600))
            .with_context(context)?;
        listener.set_nonblocking(true).with_context(context)?;
        Ok(Self { listener, clients: BTreeMap::new(), next: 0 })
    }

    /// Requests received since the last call. Clients that send no request get an error and are
    /// dropped.
    pub(crate) fn poll(&mut self) -> Vec<(ClientId, ControlRequest)> {
        while self.clients.len() < MAX_CLIENTS
            && let Ok((stream, _)) = self.listener.accept()
        {
            if let Err(error) = stream.set_nonblocking(true) {
                tracing::debug!("a control client is dropped: {error}");
                continue;
            }
            let client = ControlClient {
                stream,
                received: Vec::new(),
                since: Instant::now(),
                has_asked: false,
            };
            self.clients.insert(self.next, client);
            self.next += 1;
        }
        let mut requests = Vec::new();
        let mut refused = Vec::new();
        let mut gone = Vec::new();
        for (&id, client) in &mut self.clients {
            match client.receive() {
                ClientInput::Request(request) => requests.push((id, request)),
                ClientInput::Nonsense(reason) => refused.push((id, reason)),
                ClientInput::Closed => gone.push(id),
                ClientInput::Nothing => {}
            }
        }
        for (id, reason) in refused {
            self.reply(id, &Reply::Failed(reason));
        }
        for id in gone {
            self.clients.remove(&id);
        }
        requests
    }

    /// Sends a reply. The last reply closes the connection, and so does a client that does not
    /// read.
    pub(crate) fn reply(&mut self, id: ClientId, reply: &Reply) {
        let Some(client) = self.clients.get_mut(&id) else { return };
        let is_sent = serde_json::to_vec(reply).is_ok_and(|mut line| {
            line.push(b'\n');
            client.stream.write_all(&line).is_ok()
        });
        if reply.is_last() || !is_sent {
            self.clients.remove(&id);
        }
    }
}

/// Input of a client.
enum ClientInput {
    Nothing,
    Request(ControlRequest),
    Nonsense(String),
    Closed,
}

impl ControlClient {
    fn receive(&mut self) -> ClientInput {
        let mut chunk = [0; 4096];
        loop {
            match self.stream.read(&mut chunk) {
                Ok(0) => return ClientInput::Closed,
                // After its request, further bytes of a client are ignored.
                Ok(_) if self.has_asked => {}
                Ok(count) => self.received.extend_from_slice(&chunk[..count]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return ClientInput::Closed,
            }
            if self.received.len() > MAX_REQUEST_BYTES {
                return ClientInput::Nonsense(format!(
                    "a request of over {MAX_REQUEST_BYTES} bytes"
                ));
            }
        }
        if self.has_asked {
            return ClientInput::Nothing;
        }
        let Some(end) = self.received.iter().position(|&byte| byte == b'\n') else {
            return match self.since.elapsed() > REQUEST_TIME {
                true => ClientInput::Nonsense("no request came: one line of JSON".to_owned()),
                false => ClientInput::Nothing,
            };
        };
        match serde_json::from_slice(&self.received[..end]) {
            Ok(request) => {
                self.has_asked = true;
                ClientInput::Request(request)
            }
            Err(error) => ClientInput::Nonsense(format!("not a request: {error}")),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::io::{BufRead, BufReader};
    use tempfile::TempDir;

    fn line(stream: &UnixStream) -> String {
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let mut text = String::new();
        BufReader::new(stream).read_line(&mut text).unwrap();
        text
    }

    fn poll_until(server: &mut Server, count: usize) -> Vec<(ClientId, ControlRequest)> {
        let start = Instant::now();
        let mut found = Vec::new();
        while found.len() < count && start.elapsed() < Duration::from_secs(20) {
            found.extend(server.poll());
        }
        found
    }

    #[test]
    fn only_the_owner_can_use_it_and_requests_are_answered() {
        let folder = TempDir::new().unwrap();
        let mut server = Server::open(folder.path()).unwrap();
        let mode = std::fs::metadata(socket_path(folder.path())).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let mut client = UnixStream::connect(socket_path(folder.path())).unwrap();
        client.write_all(b"{\"command\":\"sta").unwrap();
        assert!(server.poll().is_empty());
        client.write_all(b"tus\"}\n").unwrap();
        let found = poll_until(&mut server, 1);
        assert_eq!(found[0].1, ControlRequest::Status);
        server.reply(found[0].0, &Reply::done("all is well"));
        assert!(line(&client).contains("all is well"));
    }

    #[test]
    fn garbage_is_answered_and_dropped_and_holds_nobody_up() {
        let folder = TempDir::new().unwrap();
        let mut server = Server::open(folder.path()).unwrap();
        let silent = UnixStream::connect(socket_path(folder.path())).unwrap();
        let mut babbler = UnixStream::connect(socket_path(folder.path())).unwrap();
        babbler.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
        let mut client = UnixStream::connect(socket_path(folder.path())).unwrap();
        client.write_all(b"{\"command\":\"status\"}\n").unwrap();
        assert_eq!(poll_until(&mut server, 1).len(), 1);
        assert!(line(&babbler).contains("not a request"));
        let start = Instant::now();
        while server.clients.len() > 1 && start.elapsed() < Duration::from_secs(20) {
            assert!(server.poll().is_empty());
        }
        assert!(line(&silent).contains("no request came"));
    }
}
