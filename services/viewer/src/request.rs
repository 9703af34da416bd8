//! HTTP requests of a browser, and which of them are allowed.
//!
//! A page from elsewhere must not read this page's socket: its `Origin` differs. Nor may it reach
//! this machine under another name (DNS rebinding). So on loopback only names of loopback are
//! answered, and elsewhere every socket needs the token.

use std::net::IpAddr;

use tungstenite::handshake::derive_accept_key;

use crate::explaining::PoseQuestion;
use crate::files::{self, PageFile};

/// Maximum length of a request's head, bytes.
pub(crate) const MAX_HEAD: usize = 8 * 1024;
/// Maximum header lines of a request.
const MAX_HEADERS: usize = 64;

/// The rules for which requests are served.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Access {
    /// The token that a socket needs, if any.
    pub token: Option<String>,
    /// Whether only this machine can connect.
    pub is_loopback: bool,
}

/// The answer to a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum HttpAnswer {
    /// A file of the page. `with_body`: the method is `GET` and not `HEAD`.
    File {
        file: &'static PageFile,
        with_body: bool,
    },
    /// The page's socket may be opened. `accept` is the key that the browser expects.
    Socket {
        accept: String,
    },
    /// The token is right. A page checks it so, because a browser does not report why a socket was
    /// refused.
    Granted,
    /// A question that the page may ask.
    Explain(PoseQuestion),
    Refused(HttpRefusal),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum HttpRefusal {
    #[error("this is no request of HTTP/1.1")]
    Malformed,
    #[error("the head of the request is longer than {MAX_HEAD} bytes")]
    TooLong,
    #[error("the request did not come in time")]
    TooSlow,
    #[error("there is nothing here. The page is at /")]
    NotFound,
    #[error("only GET and HEAD are answered")]
    Method,
    #[error("on loopback only localhost, 127.0.0.1 and [::1] are answered")]
    Host,
    #[error("only this page's own scripts may open its socket")]
    Origin,
    #[error("the token is wrong or missing. Cure: open the address that `flockeye view` printed")]
    Token,
    #[error("this address is a WebSocket of version 13")]
    NoUpgrade,
    #[error("ask as /explain?target=NAME&frame=SOURCE.EPOCH.NUMBER")]
    Question,
    #[error("too many pages are open. Cure: close one")]
    Full,
}

impl HttpRefusal {
    pub(crate) fn status(self) -> (u16, &'static str) {
        match self {
            Self::Malformed | Self::Question => (400, "Bad Request"),
            Self::Token => (401, "Unauthorized"),
            Self::Host | Self::Origin => (403, "Forbidden"),
            Self::NotFound => (404, "Not Found"),
            Self::Method => (405, "Method Not Allowed"),
            Self::TooSlow => (408, "Request Timeout"),
            Self::NoUpgrade => (426, "Upgrade Required"),
            Self::TooLong => (431, "Request Header Fields Too Large"),
            Self::Full => (503, "Service Unavailable"),
        }
    }
}

/// The answer to the bytes received so far, and the request's length in bytes. `None`: the request
/// is not complete.
pub(crate) fn answer(bytes: &[u8], access: &Access) -> Option<(HttpAnswer, usize)> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    let refused = |refusal| Some((HttpAnswer::Refused(refusal), bytes.len()));
    match request.parse(bytes) {
        Ok(httparse::Status::Complete(length)) if length <= MAX_HEAD => {
            let outcome = outcome(&request, access);
            Some((outcome.unwrap_or_else(HttpAnswer::Refused), length))
        }
        Ok(httparse::Status::Partial) if bytes.len() < MAX_HEAD => None,
        Ok(_) | Err(httparse::Error::TooManyHeaders) => refused(HttpRefusal::TooLong),
        Err(_) => refused(HttpRefusal::Malformed),
    }
}

fn outcome(
    request: &httparse::Request<'_, '_>,
    access: &Access,
) -> Result<HttpAnswer, HttpRefusal> {
    let (Some(method), Some(target)) = (request.method, request.path) else {
        return Err(HttpRefusal::Malformed);
    };
    if !matches!(method, "GET" | "HEAD") {
        return Err(HttpRefusal::Method);
    }
    let host = only(request, "host").ok_or(HttpRefusal::Malformed)?;
    if access.is_loopback && !is_loopback_name(host) {
        return Err(HttpRefusal::Host);
    }
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    match path {
        "/live" => {
            check_socket(request, host, query, access)?;
            let key = only(request, "sec-websocket-key").ok_or(HttpRefusal::NoUpgrade)?;
            let is_websocket = has_word(request, "upgrade", "websocket")
                && has_word(request, "connection", "upgrade")
                && only(request, "sec-websocket-version") == Some("13")
                // Length of sixteen bytes in base 64.
                && key.len() == 24
                && method == "GET";
            if !is_websocket {
                return Err(HttpRefusal::NoUpgrade);
            }
            Ok(HttpAnswer::Socket { accept: derive_accept_key(key.as_bytes()) })
        }
        "/access" => check_socket(request, host, query, access).map(|()| HttpAnswer::Granted),
        "/explain" => {
            check_socket(request, host, query, access)?;
            let question = PoseQuestion::of_query(query).ok_or(HttpRefusal::Question)?;
            // An explanation takes time and a processor, so only GET starts one.
            (method == "GET").then_some(HttpAnswer::Explain(question)).ok_or(HttpRefusal::Method)
        }
        _ => {
            let file = files::find(path).ok_or(HttpRefusal::NotFound)?;
            Ok(HttpAnswer::File { file, with_body: method == "GET" })
        }
    }
}

fn check_socket(
    request: &httparse::Request<'_, '_>,
    host: &str,
    query: &str,
    access: &Access,
) -> Result<(), HttpRefusal> {
    // Programs send no `Origin`; browsers always do where it matters.
    if let Some(origin) = header(request, "origin").next() {
        let authority = origin.split_once("://").map(|(_, authority)| authority);
        if authority != Some(host) {
            return Err(HttpRefusal::Origin);
        }
    }
    let given = query.split('&').find_map(|pair| pair.strip_prefix("token=")).unwrap_or("");
    match &access.token {
        Some(token) if !is_same(token, given) => Err(HttpRefusal::Token),
        _ => Ok(()),
    }
}

/// Compares in a time that does not depend on the place of the first difference.
fn is_same(token: &str, given: &str) -> bool {
    let differ = token.bytes().zip(given.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
    token.len() == given.len() && differ == 0
}

fn header<'r>(
    request: &'r httparse::Request<'_, '_>,
    name: &'static str,
) -> impl Iterator<Item = &'r str> {
    let of_name =
        request.headers.iter().filter(move |header| header.name.eq_ignore_ascii_case(name));
    of_name.filter_map(|header| std::str::from_utf8(header.value).ok())
}

/// The value of a header that occurs exactly once.
fn only<'r>(request: &'r httparse::Request<'_, '_>, name: &'static str) -> Option<&'r str> {
    let mut values = header(request, name);
    let value = values.next()?;
    values.next().is_none().then(|| value.trim())
}

fn has_word(request: &httparse::Request<'_, '_>, name: &'static str, word: &str) -> bool {
    header(request, name)
        .any(|value| value.split(',').any(|part| part.trim().eq_ignore_ascii_case(word)))
}

fn is_loopback_name(host: &str) -> bool {
    // An IPv6 address stands in brackets; a port may follow.
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or(""),
        None => host.rsplit_once(':').map_or(host, |(name, _)| name),
    };
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// Whether a token can be part of an address without encoding.
pub(crate) fn is_token(token: &str) -> bool {
    (8..=128).contains(&token.len())
        && token.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.~".contains(&byte))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn local() -> Access {
        Access { token: None, is_loopback: true }
    }

    fn guarded() -> Access {
        Access { token: Some("open-sesame".into()), is_loopback: false }
    }

    fn ask(lines: &[&str], access: &Access) -> HttpAnswer {
        let text = format!("{}\r\n\r\n", lines.join("\r\n"));
        answer(text.as_bytes(), access).unwrap().0
    }

    const SOCKET: [&str; 4] = [
        "Connection: keep-alive, Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    ];

    fn open(target: &str, host: &str, more: &[&str], access: &Access) -> HttpAnswer {
        let (first, host) = (format!("GET {target} HTTP/1.1"), format!("Host: {host}"));
        ask(&[&[first.as_str(), host.as_str()][..], &SOCKET, more].concat(), access)
    }

    #[test]
    fn files_are_found_and_nothing_else() {
        let page =
            |path: &str| ask(&[&format!("GET {path} HTTP/1.1"), "Host: localhost:1"], &local());
        assert!(matches!(page("/"), HttpAnswer::File { with_body: true, .. }));
        assert!(matches!(page("/?token=x"), HttpAnswer::File { .. }));
        for path in ["/../Cargo.toml", "/%2e%2e/x", "/page/index.html", "//", "/nothing", "*"] {
            assert_eq!(page(path), HttpAnswer::Refused(HttpRefusal::NotFound), "{path}");
        }
        let head = ask(&["HEAD / HTTP/1.1", "Host: localhost"], &local());
        assert!(matches!(head, HttpAnswer::File { with_body: false, .. }));
        let post = ask(&["POST / HTTP/1.1", "Host: localhost"], &local());
        assert_eq!(post, HttpAnswer::Refused(HttpRefusal::Method));
    }

    #[test]
    fn garbage_and_what_is_too_long_is_refused() {
        let refused = |bytes: &[u8]| answer(bytes, &local()).map(|(answer, _)| answer);
        for garbage in
            [&b"\x16\x03\x01\x02\x00"[..], b"GET\r\n\r\n", b"GET / HTTP/1.1\r\n\xff: x\r\n\r\n"]
        {
            assert_eq!(
                refused(garbage),
                Some(HttpAnswer::Refused(HttpRefusal::Malformed)),
                "{garbage:?}"
            );
        }
        assert_eq!(refused(b"GET / HTTP/1.1\r\nHost: loc"), None, "more may come");
        let endless = [&b"GET / HTTP/1.1\r\nX: "[..], &vec![b'x'; MAX_HEAD]].concat();
        assert_eq!(refused(&endless), Some(HttpAnswer::Refused(HttpRefusal::TooLong)));
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "A: b\r\n".repeat(MAX_HEADERS + 1));
        assert_eq!(refused(many.as_bytes()), Some(HttpAnswer::Refused(HttpRefusal::TooLong)));
        let hostless = ask(&["GET / HTTP/1.1"], &local());
        assert_eq!(hostless, HttpAnswer::Refused(HttpRefusal::Malformed));
        let two = ask(&["GET / HTTP/1.1", "Host: localhost", "Host: evil"], &local());
        assert_eq!(two, HttpAnswer::Refused(HttpRefusal::Malformed));
    }

    #[test]
    fn a_socket_opens_for_this_page_alone() {
        let accept = "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=".to_owned();
        let granted = HttpAnswer::Socket { accept };
        for host in ["localhost:8760", "127.0.0.1:8760", "[::1]:8760"] {
            let own = format!("Origin: http://{host}");
            assert_eq!(open("/live", host, &[&own], &local()), granted, "{host}");
            assert_eq!(open("/live", host, &[], &local()), granted, "a program at {host}");
        }
        let foreign = open("/live", "localhost:8760", &["Origin: http://evil.example"], &local());
        assert_eq!(foreign, HttpAnswer::Refused(HttpRefusal::Origin));
        for rebound in ["evil.example:8760", "127.0.0.1.evil.example", "", "[evil"] {
            let own = format!("Origin: http://{rebound}");
            let answer = open("/live", rebound, &[&own], &local());
            assert_eq!(answer, HttpAnswer::Refused(HttpRefusal::Host), "{rebound}");
        }
        let plain = ask(&["GET /live HTTP/1.1", "Host: localhost"], &local());
        assert_eq!(plain, HttpAnswer::Refused(HttpRefusal::NoUpgrade));
    }

    #[test]
    fn a_question_needs_what_a_socket_needs() {
        let asked = "/explain?target=alpha&frame=1.0.38";
        let page = |target: &str, more: &[&str]| {
            let (first, host) = (format!("GET {target} HTTP/1.1"), "Host: localhost:1");
            ask(&[&[first.as_str(), host][..], more].concat(), &local())
        };
        assert!(matches!(page(asked, &[]), HttpAnswer::Explain(_)));
        assert!(matches!(page(asked, &["Origin: http://localhost:1"]), HttpAnswer::Explain(_)));
        let foreign = page(asked, &["Origin: http://evil.example"]);
        assert_eq!(foreign, HttpAnswer::Refused(HttpRefusal::Origin));
        let vague = page("/explain?target=alpha", &[]);
        assert_eq!(vague, HttpAnswer::Refused(HttpRefusal::Question));
        let head = ask(&[&format!("HEAD {asked} HTTP/1.1"), "Host: localhost:1"], &local());
        assert_eq!(head, HttpAnswer::Refused(HttpRefusal::Method));
        let line = format!("GET {asked} HTTP/1.1");
        let elsewhere = ask(&[&line, "Host: 10.0.0.7:8760"], &guarded());
        assert_eq!(elsewhere, HttpAnswer::Refused(HttpRefusal::Token));
    }

    #[test]
    fn elsewhere_a_socket_needs_the_token() {
        let ask = |query: &str| open(&format!("/live{query}"), "10.0.0.7:8760", &[], &guarded());
        assert!(matches!(ask("?token=open-sesame"), HttpAnswer::Socket { .. }));
        for query in
            ["", "?token=", "?token=open-sesamf", "?token=open-sesame1", "?TOKEN=open-sesame"]
        {
            assert_eq!(ask(query), HttpAnswer::Refused(HttpRefusal::Token), "{query}");
        }
    }

    #[test]
    fn tokens_stand_in_addresses() {
        assert!(is_token("open-sesame"));
        for token in ["", "short", "with space", "percent%20", "ümlaut-ümlaut"] {
            assert!(!is_token(token), "{token}");
        }
    }
}
