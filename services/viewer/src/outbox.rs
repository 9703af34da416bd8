//! Messages that wait for one page.
//!
//! A page that reads slowly gets the newest messages. Of most kinds one message waits, and a newer
//! one replaces it. A page acknowledges the pictures that it has shown, and only a few are under
//! way at once. So neither this process nor the system's buffers fill up with old pictures.

use std::collections::VecDeque;

/// The kind of a message, which decides how it waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum OutboxKind {
    /// Must arrive; only a newer one replaces it.
    Hello,
    /// One for each frame; the oldest is dropped where too many wait.
    Frame,
    // Only the newest of each of the following kinds waits.
    Stages,
    Swarm,
    Status,
    Overview,
    /// Part of an answer to the page: it must arrive, and in order. The sender waits for the page.
    Answer,
    /// Only the newest waits, and it needs a credit.
    Picture,
    /// Only the newest of each body waits.
    Closeup(u32),
}

/// Maximum frames that wait.
const MOST_FRAMES: usize = 32;
/// Maximum bodies whose close-ups wait.
const MOST_CLOSEUPS: usize = 16;
/// Maximum pictures that are under way to a page.
const CREDITS: u32 = 3;

/// Messages for one page, in the order in which they came.
#[derive(Debug)]
pub(crate) struct PageOutbox<M> {
    waiting: VecDeque<(OutboxKind, M)>,
    wants_pictures: bool,
    under_way: u32,
}

impl<M> Default for PageOutbox<M> {
    fn default() -> Self {
        Self { waiting: VecDeque::new(), wants_pictures: false, under_way: 0 }
    }
}

impl<M> PageOutbox<M> {
    /// Queues a message. Returns false if this page does not take it.
    pub(crate) fn put(&mut self, kind: OutboxKind, message: M) -> bool {
        match kind {
            OutboxKind::Picture if !self.takes_pictures() => return false,
            OutboxKind::Picture => self.under_way += 1,
            OutboxKind::Closeup(_) if !self.wants_pictures => return false,
            _ => {}
        }
        let is_kind = |waiting: &(OutboxKind, M)| waiting.0 == kind;
        let count =
            |of: fn(&OutboxKind) -> bool| self.waiting.iter().filter(|(kind, _)| of(kind)).count();
        let replaced = match kind {
            OutboxKind::Frame if count(|kind| *kind == OutboxKind::Frame) < MOST_FRAMES => None,
            OutboxKind::Answer => None,
            OutboxKind::Closeup(_) if !self.waiting.iter().any(is_kind) => {
                let is_full = count(|kind| matches!(kind, OutboxKind::Closeup(_))) >= MOST_CLOSEUPS;
                let oldest = |(kind, _): &(OutboxKind, M)| matches!(kind, OutboxKind::Closeup(_));
                is_full.then(|| self.waiting.iter().position(oldest)).flatten()
            }
            _ => self.waiting.iter().position(is_kind),
        };
        if let Some(at) = replaced {
            self.waiting.remove(at);
            // A dropped picture is never shown, so it returns its credit.
            self.under_way -= u32::from(kind == OutboxKind::Picture);
        }
        self.waiting.push_back((kind, message));
        true
    }

    pub(crate) fn take(&mut self) -> Option<M> {
        self.waiting.pop_front().map(|(_, message)| message)
    }

    /// Number of messages that wait.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Whether a picture may be sent to it now.
    pub(crate) fn takes_pictures(&self) -> bool {
        self.wants_pictures && self.under_way < CREDITS
    }

    /// Whether the page requests pictures, now or later.
    pub(crate) fn wants_pictures(&self) -> bool {
        self.wants_pictures
    }

    /// Sets whether the page requests pictures.
    pub(crate) fn set_wants_pictures(&mut self, wants: bool) {
        self.wants_pictures = wants;
        // Pictures under way no longer count: a page that was hidden may not have shown them.
        self.under_way = 0;
    }

    /// Notes that the page has shown or dropped a picture.
    pub(crate) fn shown(&mut self) {
        self.under_way = self.under_way.saturating_sub(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_that_reads_nothing_has_little_waiting() {
        let mut outbox = PageOutbox::default();
        outbox.set_wants_pictures(true);
        outbox.put(OutboxKind::Hello, "hello".to_owned());
        for number in 0..10_000 {
            outbox.put(OutboxKind::Frame, format!("frame {number}"));
            outbox.put(OutboxKind::Stages, format!("stages {number}"));
            outbox.put(OutboxKind::Picture, format!("picture {number}"));
            outbox.put(OutboxKind::Closeup(number), format!("closeup {number}"));
        }
        assert!(outbox.waiting.len() <= 4 + MOST_FRAMES + MOST_CLOSEUPS, "{outbox:?}");
        assert_eq!(outbox.take().as_deref(), Some("hello"), "it must arrive");
        let rest: Vec<String> = std::iter::from_fn(|| outbox.take()).collect();
        for newest in ["frame 9999", "stages 9999", "closeup 9999", "picture 9999"] {
            assert!(rest.iter().any(|text| text == newest), "{newest}");
        }
    }

    #[test]
    fn pictures_need_credit() {
        let mut outbox = PageOutbox::default();
        assert!(!outbox.put(OutboxKind::Picture, 0), "nobody asked for it");
        outbox.set_wants_pictures(true);
        for number in 0..CREDITS {
            assert!(outbox.put(OutboxKind::Picture, number));
            assert_eq!(outbox.take(), Some(number));
        }
        assert!(!outbox.takes_pictures() && !outbox.put(OutboxKind::Picture, 9));
        outbox.shown();
        assert!(outbox.put(OutboxKind::Picture, 10));
        assert_eq!(outbox.take(), Some(10));
    }

    #[test]
    fn answers_arrive_all_and_in_their_order() {
        let mut outbox = PageOutbox::default();
        outbox.set_wants_pictures(true);
        for number in 0..1000 {
            outbox.put(OutboxKind::Answer, number);
            outbox.put(OutboxKind::Overview, -1);
        }
        assert_eq!(outbox.waiting(), 1001);
        let answers: Vec<i32> = std::iter::from_fn(|| outbox.take()).filter(|n| *n >= 0).collect();
        assert_eq!(answers, (0..1000).collect::<Vec<_>>());
    }
}
