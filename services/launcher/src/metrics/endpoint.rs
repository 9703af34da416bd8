//! HTTP endpoint of the metrics. It answers one request after another, each with a deadline.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use flockeye_runtime::lock::lock;

/// Deadline for receiving a request, and for sending its answer.
const DEADLINE: Duration = Duration::from_secs(1);
/// Maximum length of a request's head, bytes.
const MAX_HEAD: usize = 8 * 1024;
/// Timeout: a launcher that has written nothing for so long hangs. A pipeline in which no frame has
/// ended is not ready.
const SILENCE: Duration = Duration::from_secs(3);

/// Content type of OpenMetrics.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
const PLAIN: &str = "text/plain; charset=utf-8";

#[derive(Debug, Clone)]
pub(crate) struct MetricsPage {
    pub text: String,
    /// Time of writing: a launcher that hangs writes no page.
    pub written: Instant,
    /// End of the last frame.
    pub last_frame: Option<Instant>,
}

/// Serves the page at this address, from a thread that ends with the process. Returns the address
/// with its port.
pub(crate) fn start(listen: SocketAddr, page: Arc<Mutex<MetricsPage>>) -> io::Result<SocketAddr> {
    let listener = TcpListener::bind(listen)?;
    let address = listener.local_addr()?;
    std::thread::Builder::new().name("metrics".to_owned()).spawn(move || {
        for connection in listener.incoming() {
            let answered = connection.and_then(|connection| serve(connection, &page));
            if let Err(error) = answered {
                tracing::debug!("a request for metrics was not answered: {error}");
            }
        }
    })?;
    Ok(address)
}

fn serve(mut connection: TcpStream, page: &Mutex<MetricsPage>) -> io::Result<()> {
    let until = Instant::now() + DEADLINE;
    connection.set_write_timeout(Some(DEADLINE))?;
    let mut head = Vec::new();
    let mut some = [0; 1024];
    let reply = loop {
        if let Some(reply) = reply(&head, || lock(page).clone()) {
            break reply;
        }
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        connection.set_read_timeout(Some(left))?;
        match connection.read(&mut some)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            length => head.extend_from_slice(&some[..length]),
        }
    };
    connection.write_all(reply.as_bytes())
}

/// Answer to the bytes received so far; `None`: more must come.
fn reply(head: &[u8], page: impl FnOnce() -> MetricsPage) -> Option<String> {
    let mut headers = [httparse::EMPTY_HEADER; 64];
    let mut request = httparse::Request::new(&mut headers);
    let (method, path) = match request.parse(head) {
        Ok(httparse::Status::Complete(_)) => (request.method?, request.path?),
        Ok(httparse::Status::Partial) if head.len() < MAX_HEAD => return None,
        Ok(_) => return Some(answer("431 Request Header Fields Too Large", PLAIN, "too long\n")),
        Err(_) => {
            return Some(answer("400 Bad Request", PLAIN, "this is no request of HTTP/1.1\n"));
        }
    };
    if method != "GET" {
        return Some(answer("405 Method Not Allowed", PLAIN, "only GET is answered\n"));
    }
    let MetricsPage { text, written, last_frame } = page();
    let health = |is_well: bool, word: &str, what: &str| match is_well {
        true => answer("200 OK", PLAIN, &format!("{word}\n")),
        false => answer("503 Service Unavailable", PLAIN, &format!("not {word}: {what}\n")),
    };
    Some(match path.split('?').next()? {
        "/metrics" => answer("200 OK", OPEN_METRICS, &text),
        "/live" => health(written.elapsed() < SILENCE, "live", "the launcher hangs"),
        "/ready" => health(
            last_frame.is_some_and(|last| last.elapsed() < SILENCE),
            "ready",
            "no frame has passed through all stages of late",
        ),
        _ => answer("404 Not Found", PLAIN, "/metrics, /live and /ready are here\n"),
    })
}

fn answer(status: &str, kind: &str, body: &str) -> String {
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn said(request: &str, last_frame: Option<Instant>) -> String {
        let page = MetricsPage { text: "a 1\n".to_owned(), written: Instant::now(), last_frame };
        reply(request.as_bytes(), || page).expect("the request is whole")
    }

    #[test]
    fn metrics_and_health_are_answered_and_nothing_else() {
        let now = Some(Instant::now());
        assert!(said("GET /metrics HTTP/1.1\r\n\r\n", now).ends_with("\r\n\r\na 1\n"));
        assert!(said("GET /ready HTTP/1.1\r\n\r\n", now).starts_with("HTTP/1.1 200"));
        assert!(said("GET /ready HTTP/1.1\r\n\r\n", None).starts_with("HTTP/1.1 503"));
        assert!(said("GET /live?a=b HTTP/1.1\r\n\r\n", None).starts_with("HTTP/1.1 200"));
        assert!(said("GET /../etc HTTP/1.1\r\n\r\n", now).starts_with("HTTP/1.1 404"));
        assert!(said("POST /metrics HTTP/1.1\r\n\r\n", now).starts_with("HTTP/1.1 405"));
        assert!(said("\u{1}\u{2}\r\n\r\n", now).starts_with("HTTP/1.1 400"));
        let endless = "GET /metrics HTTP/1.1\r\nA: ".to_owned() + &"b".repeat(MAX_HEAD);
        assert!(said(&endless, now).starts_with("HTTP/1.1 431"));
        assert_eq!(reply(b"GET /met", || panic!("it is not whole")), None);
    }

    #[test]
    fn who_says_nothing_keeps_nobody_waiting_for_long() {
        let page =
            MetricsPage { text: "a 1\n".to_owned(), written: Instant::now(), last_frame: None };
        let address = start("127.0.0.1:0".parse().unwrap(), Arc::new(Mutex::new(page))).unwrap();
        let _silent = TcpStream::connect(address).unwrap();
        let mut asking = TcpStream::connect(address).unwrap();
        asking.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        asking.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        let mut text = String::new();
        asking.read_to_string(&mut text).unwrap();
        assert!(text.starts_with("HTTP/1.1 200 OK") && text.ends_with("a 1\n"), "{text}");
    }
}
