//! All open pages.

use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use flockeye_runtime::lock::lock;
use tungstenite::Message;

use crate::outbox::{OutboxKind, PageOutbox};
use crate::remote::{Move, Remote};
use crate::request::HttpRefusal;
use crate::wire::{self, TextMessage};

/// Maximum pages that are open at once.
pub(crate) const MOST_PAGES: usize = 16;

/// All open pages. The ports' thread puts messages in and never waits.
#[derive(Default)]
pub(crate) struct Pages {
    state: Mutex<State>,
    changed: Condvar,
    player: Option<StartPlayer>,
}

/// Starts a recording's player for one page, which runs until the page's [`Remote`] is closed.
pub(crate) type StartPlayer = Box<dyn Fn(Arc<OpenPage>) -> io::Result<()> + Send + Sync>;

#[derive(Default)]
struct State {
    pages: Vec<Arc<OpenPage>>,
    /// The first messages for a page that opens later.
    hello: Option<Message>,
    status: Option<Message>,
    overview: Option<Message>,
}

/// Requests of pages and clients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Demand {
    /// Whether a page is open, or a client has subscribed to any channel.
    pub anything: bool,
    pub pictures: bool,
    pub closeups: bool,
}

impl Demand {
    /// The union of both demands.
    pub(crate) fn or(self, other: Self) -> Self {
        Self {
            anything: self.anything || other.anything,
            pictures: self.pictures || other.pictures,
            closeups: self.closeups || other.closeups,
        }
    }
}

/// One open page, which its own thread and the ports' thread share.
pub(crate) struct OpenPage {
    outbox: Mutex<PageOutbox<Message>>,
    /// A byte in this stream signals that a message waits.
    bell: UnixStream,
    ringing: UnixStream,
    /// Requests to the page's player; none where it shows a running pipeline.
    pub remote: Option<Remote>,
}

impl Pages {
    /// Pages that each have a player of their own.
    pub(crate) fn with_players(player: StartPlayer) -> Self {
        Self { player: Some(player), ..Self::default() }
    }

    /// Opens a new page.
    ///
    /// # Errors
    /// [`HttpRefusal::Full`] where too many are open, or the system has no more descriptors.
    pub(crate) fn open(&self) -> Result<Arc<OpenPage>, HttpRefusal> {
        let mut state = lock(&self.state);
        if state.pages.len() >= MOST_PAGES {
            return Err(HttpRefusal::Full);
        }
        let page = Arc::new(OpenPage::new(self.player.is_some()).map_err(|_| HttpRefusal::Full)?);
        let first = [
            (OutboxKind::Hello, &state.hello),
            (OutboxKind::Status, &state.status),
            (OutboxKind::Overview, &state.overview),
        ];
        for (kind, message) in first {
            if let Some(message) = message {
                page.put(kind, message.clone());
            }
        }
        if let Some(player) = &self.player {
            player(page.clone()).map_err(|_| HttpRefusal::Full)?;
        }
        state.pages.push(page.clone());
        drop(state);
        self.changed.notify_all();
        Ok(page)
    }

    /// Closes a page.
    pub(crate) fn close(&self, page: &Arc<OpenPage>) {
        if let Some(remote) = &page.remote {
            remote.close();
        }
        lock(&self.state).pages.retain(|open| !Arc::ptr_eq(open, page));
        self.changed.notify_all();
    }

    /// Signals that the demand of a page has changed.
    pub(crate) fn changed(&self) {
        self.changed.notify_all();
    }

    /// Puts a message into each page's outbox.
    pub(crate) fn put(&self, kind: OutboxKind, message: &Message) {
        let mut state = lock(&self.state);
        match kind {
            OutboxKind::Hello => state.hello = Some(message.clone()),
            OutboxKind::Status => state.status = Some(message.clone()),
            OutboxKind::Overview => state.overview = Some(message.clone()),
            _ => {}
        }
        for page in &state.pages {
            page.put(kind, message.clone());
        }
    }

    /// Puts a text message into each page's outbox.
    pub(crate) fn tell(&self, message: &TextMessage<'_>) {
        self.put(message.kind(), &wire::text(message));
    }

    /// The union of all pages' demands.
    pub(crate) fn wanted(&self) -> Demand {
        let state = lock(&self.state);
        // A page shows pictures and close-ups, or neither.
        let pictures = state.pages.iter().any(|page| page.outbox(|outbox| outbox.wants_pictures()));
        Demand { anything: !state.pages.is_empty(), pictures, closeups: pictures }
    }

    /// Whether any page can take a picture now.
    pub(crate) fn takes_pictures(&self) -> bool {
        lock(&self.state).pages.iter().any(|page| page.outbox(|outbox| outbox.takes_pictures()))
    }

    /// Waits for a change, at most `at_most`.
    pub(crate) fn wait(&self, at_most: Duration) {
        let state = lock(&self.state);
        // The caller checks again after a wake-up and after a timeout.
        drop(self.changed.wait_timeout(state, at_most).unwrap_or_else(PoisonError::into_inner));
    }
}

impl OpenPage {
    fn new(has_player: bool) -> io::Result<Self> {
        let (bell, ringing) = UnixStream::pair()?;
        bell.set_nonblocking(true)?;
        ringing.set_nonblocking(true)?;
        let remote = has_player.then(Remote::default);
        Ok(Self { outbox: Mutex::default(), bell, ringing, remote })
    }

    /// Passes a request of the page to its player. False where it has none.
    pub(crate) fn ask(&self, wish: Move) -> bool {
        self.remote.as_ref().map(|remote| remote.ask(wish)).is_some()
    }

    /// Puts a message into its outbox.
    pub(crate) fn put(&self, kind: OutboxKind, message: Message) {
        if self.outbox(|outbox| outbox.put(kind, message)) {
            // A full stream already signals that a message waits.
            let _ = (&self.bell).write(&[1]);
        }
    }

    /// Gives `look` access to the outbox.
    pub(crate) fn outbox<R>(&self, look: impl FnOnce(&mut PageOutbox<Message>) -> R) -> R {
        look(&mut lock(&self.outbox))
    }

    /// A descriptor that is readable while a message waits.
    pub(crate) fn ringing(&self) -> BorrowedFd<'_> {
        self.ringing.as_fd()
    }

    /// Empties the stream of signals.
    pub(crate) fn hush(&self) {
        let mut rings = [0; 64];
        while (&self.ringing).read(&mut rings).is_ok_and(|read| read > 0) {}
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_late_page_gets_the_hello_and_pages_are_bounded() {
        let all = Pages::default();
        assert_eq!(all.wanted(), Demand::default());
        all.put(OutboxKind::Hello, &Message::text("hello"));
        all.put(OutboxKind::Frame, &Message::text("too early"));
        let pages: Vec<_> = (0..MOST_PAGES).map(|_| all.open().unwrap()).collect();
        assert_eq!(all.open().err(), Some(HttpRefusal::Full));
        let first = pages[0].outbox(|outbox| (outbox.take(), outbox.take()));
        assert_eq!(first, (Some(Message::text("hello")), None));
        assert_eq!(all.wanted(), Demand { anything: true, ..Demand::default() });
        pages[3].outbox(|outbox| outbox.set_wants_pictures(true));
        assert!(all.wanted().pictures && all.takes_pictures());
        pages.iter().for_each(|page| all.close(page));
        assert_eq!(all.wanted(), Demand::default());
    }
}
