//! One connection: a request with its answer, or a page's socket.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde::Deserialize;
use tungstenite::protocol::{CloseFrame, Role, WebSocketConfig, frame::coding::CloseCode};
use tungstenite::{Error, Message, WebSocket};

use crate::explaining::{Explainer, PoseQuestion};
use crate::files;
use crate::pages::{OpenPage, Pages};
use crate::remote::{Move, Remote};
use crate::request::{Access, HttpAnswer, HttpRefusal, MAX_HEAD, answer};

/// Timeout of a request.
const REQUEST_TIME: Duration = Duration::from_secs(5);
/// Timeout of an answer.
const ANSWER_TIME: Duration = Duration::from_secs(5);
/// Timeout after which a page that reads nothing is closed.
const STALLED: Duration = Duration::from_secs(20);
/// Time for which the rest of a refused request is read, so that the browser reads the answer.
const LINGER: Duration = Duration::from_millis(200);
/// Maximum length of a page's message, bytes.
const MAX_COMMAND: usize = 1024;

#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Command {
    /// Whether the page requests pictures: a hidden page does not.
    Pictures(bool),
    /// The page has shown or dropped this many further pictures.
    Shown(u32),
    /// The page seeks this time of a recording, seconds from the beginning.
    Seek(f64),
    /// The page steps this many frames of a recording on, or back.
    Step(i32),
    /// The page plays a recording at this speed, seconds a second; 0 stops it.
    Play(f64),
}

impl Command {
    /// The request to the player; none for the other commands.
    fn wish(self) -> Option<Move> {
        match self {
            Self::Seek(to_s) => Some(Move::Seek(to_s)),
            Self::Step(frames) => Some(Move::Step(frames)),
            Self::Play(speed) => Some(Move::Play(speed)),
            Self::Pictures(_) | Self::Shown(_) => None,
        }
    }
}

/// Serves a connection until it ends. Its errors concern only the other end, so they go to the
/// debug log.
pub(crate) fn serve(mut stream: TcpStream, access: &Access, pages: &Pages, explainer: &Explainer) {
    if let Err(error) = try_serve(&mut stream, access, pages, explainer) {
        tracing::debug!("a connection ended: {error}");
    }
}

fn try_serve(
    stream: &mut TcpStream,
    access: &Access,
    pages: &Pages,
    explainer: &Explainer,
) -> io::Result<()> {
    stream.set_write_timeout(Some(ANSWER_TIME))?;
    stream.set_nodelay(true)?;
    let (asked, rest) = read_request(stream, access)?;
    match asked {
        HttpAnswer::File { file, with_body } => {
            send(stream, (200, "OK"), file.media_type, file.content, with_body)
        }
        HttpAnswer::Granted => {
            send(stream, (200, "OK"), "text/plain; charset=utf-8", b"granted", true)
        }
        HttpAnswer::Explain(question) => explain(stream, explainer, &question),
        HttpAnswer::Refused(refusal) => refuse(stream, refusal),
        HttpAnswer::Socket { accept } => match pages.open() {
            Err(refusal) => refuse(stream, refusal),
            Ok(page) => {
                let outcome = open_socket(stream, &accept, rest, &page, pages);
                pages.close(&page);
                outcome
            }
        },
    }
}

/// Reads a request, and the bytes behind it that have arrived.
fn read_request(stream: &mut TcpStream, access: &Access) -> io::Result<(HttpAnswer, Vec<u8>)> {
    let deadline = Instant::now() + REQUEST_TIME;
    let mut bytes = Vec::new();
    let mut chunk = [0; 1024];
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok((HttpAnswer::Refused(HttpRefusal::TooSlow), Vec::new()));
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut chunk) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(read) => bytes.extend_from_slice(&chunk[..read]),
            Err(error) if is_not_yet(&error) => continue,
            Err(error) => return Err(error),
        }
        if let Some((asked, length)) = answer(&bytes, access) {
            return Ok((asked, bytes.split_off(length.min(bytes.len()))));
        }
        debug_assert!(bytes.len() < MAX_HEAD + chunk.len(), "longer heads are refused");
    }
}

fn refuse(stream: &mut TcpStream, refusal: HttpRefusal) -> io::Result<()> {
    let text = format!("{refusal}\n");
    send(stream, refusal.status(), "text/plain; charset=utf-8", text.as_bytes(), true)?;
    // Unread bytes would reset the connection, and the answer would be lost.
    stream.shutdown(Shutdown::Write)?;
    stream.set_read_timeout(Some(LINGER))?;
    let start = Instant::now();
    let mut rest = [0; 4096];
    while start.elapsed() < LINGER && stream.read(&mut rest).is_ok_and(|read| read > 0) {}
    Ok(())
}

/// Answers with the length of the text (4 bytes, little endian), the text, and the picture. Without
/// an explanation it answers with the reason.
fn explain(
    stream: &mut TcpStream,
    explainer: &Explainer,
    question: &PoseQuestion,
) -> io::Result<()> {
    match explainer.answer(question) {
        Ok((text, png)) => {
            let length = u32::try_from(text.len()).unwrap_or(0).to_le_bytes();
            let body = [&length[..], text.as_bytes(), &png].concat();
            send(stream, (200, "OK"), "application/octet-stream", &body, true)
        }
        Err(reason) => {
            let text = reason.to_string();
            send(stream, (409, "Conflict"), "text/plain; charset=utf-8", text.as_bytes(), true)
        }
    }
}

fn send(
    stream: &mut TcpStream,
    (status, reason): (u16, &str),
    media_type: &str,
    body: &[u8],
    with_body: bool,
) -> io::Result<()> {
    let head = format!(
        "HTTP/1.1 {status} {reason}\r\nContent-Type: {media_type}\r\nContent-Length: {}\r\n\
         Content-Security-Policy: {}\r\nX-Content-Type-Options: nosniff\r\n\
         Referrer-Policy: no-referrer\r\nCross-Origin-Opener-Policy: same-origin\r\n\
         Cross-Origin-Resource-Policy: same-origin\r\nCache-Control: no-store\r\n\
         Connection: close\r\n\r\n",
        body.len(),
        files::POLICY
    );
    stream.write_all(head.as_bytes())?;
    if with_body {
        stream.write_all(body)?;
    }
    stream.flush()
}

fn open_socket(
    stream: &mut TcpStream,
    accept: &str,
    rest: Vec<u8>,
    page: &Arc<OpenPage>,
    pages: &Pages,
) -> io::Result<()> {
    let head = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Accept: {accept}\r\n\r\n"
    );
    stream.write_all(head.as_bytes())?;
    stream.set_nonblocking(true)?;
    let limits = WebSocketConfig::default()
        .max_message_size(Some(MAX_COMMAND))
        .max_frame_size(Some(MAX_COMMAND))
        .read_buffer_size(4096);
    let mut socket = WebSocket::from_partially_read(&mut *stream, rest, Role::Server, Some(limits));
    match talk(&mut socket, page, pages) {
        // The browser has closed the page.
        Err(Error::ConnectionClosed | Error::AlreadyClosed) => Ok(()),
        Err(Error::Io(error)) => Err(error),
        Err(error) => Err(io::Error::other(error)),
        Ok(()) => Ok(()),
    }
}

/// Sends the page's waiting messages and reads its commands, until one of the two ends the
/// connection.
fn talk(
    socket: &mut WebSocket<&mut TcpStream>,
    page: &OpenPage,
    pages: &Pages,
) -> Result<(), Error> {
    let mut unsent_since: Option<Instant> = None;
    loop {
        page.hush();
        hear(socket, page, pages)?;
        if unsent_since.is_some() && is_sent(socket.flush())? {
            unsent_since = None;
        }
        while unsent_since.is_none()
            && let Some(message) = page.outbox(|outbox| outbox.take())
        {
            // Bytes that the system does not accept now stay in the socket's own buffer.
            let is_written = is_sent(socket.write(message))?;
            if !(is_written && is_sent(socket.flush())?) {
                unsent_since = Some(Instant::now());
            }
        }
        if unsent_since.is_some_and(|since| since.elapsed() > STALLED) {
            return Err(Error::Io(io::ErrorKind::TimedOut.into()));
        }
        let mut interest = PollFlags::IN;
        interest.set(PollFlags::OUT, unsent_since.is_some());
        let stream: &TcpStream = socket.get_ref();
        let bell = page.ringing();
        let mut waited = vec![PollFd::new(stream, interest)];
        if unsent_since.is_none() {
            waited.push(PollFd::from_borrowed_fd(bell, PollFlags::IN));
        }
        let at_most = Timespec { tv_sec: 1, tv_nsec: 0 };
        match poll(&mut waited, Some(&at_most)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(Error::Io(error.into())),
        }
    }
}

/// Whether all bytes were sent; false where the system accepts no more now.
fn is_sent(outcome: Result<(), Error>) -> Result<bool, Error> {
    match outcome {
        Ok(()) => Ok(true),
        Err(Error::Io(error)) if is_not_yet(&error) => Ok(false),
        Err(error) => Err(error),
    }
}

/// Reads the page's commands.
fn hear(
    socket: &mut WebSocket<&mut TcpStream>,
    page: &OpenPage,
    pages: &Pages,
) -> Result<(), Error> {
    loop {
        match socket.read() {
            Ok(Message::Text(text)) => match serde_json::from_str(text.as_str()) {
                Ok(Command::Pictures(wants)) => {
                    page.outbox(|outbox| outbox.set_wants_pictures(wants));
                    pages.changed();
                    page.remote.iter().for_each(Remote::wake);
                }
                Ok(Command::Shown(count)) => {
                    page.outbox(|outbox| (0..count.min(8)).for_each(|_| outbox.shown()));
                    page.remote.iter().for_each(Remote::wake);
                }
                Ok(other) => {
                    if !other.wish().is_some_and(|wish| page.ask(wish)) {
                        return close_on(socket);
                    }
                }
                Err(_) => return close_on(socket),
            },
            Ok(Message::Binary(_)) => return close_on(socket),
            // The library answers pings and closing.
            Ok(_) => {}
            Err(Error::Io(error)) if is_not_yet(&error) => return Ok(()),
            Err(error) => return Err(error),
        }
    }
}

/// Closes the socket of a page that sends anything else.
fn close_on(socket: &mut WebSocket<&mut TcpStream>) -> Result<(), Error> {
    let reason = "a page says nothing else than docs/RECORDING.md has".into();
    is_sent(socket.close(Some(CloseFrame { code: CloseCode::Policy, reason })))?;
    is_sent(socket.flush())?;
    Err(Error::ConnectionClosed)
}

fn is_not_yet(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted
    )
}
