//! Distribution of views to workers, and detection of lost views.
//!
//! A worker answers all views in their order. After a timeout it counts as stalled, and its views
//! go to other workers. Until it answers, it receives a single view from time to time, in case its
//! process was replaced.

use std::collections::BTreeMap;
use std::time::Duration;

/// Views in flight by key `K`: index in the frame, or frame and index.
///
/// All times are of one monotonic clock.
#[derive(Debug, Clone)]
pub(crate) struct Dispatcher<K> {
    window: usize,
    probe_after: Duration,
    workers: Vec<WorkerRecord>,
    views: BTreeMap<K, IssuedView>,
}

#[derive(Debug, Clone, Copy, Default)]
struct WorkerRecord {
    stalled_since: Option<Duration>,
    /// Time of the last answer.
    answered: Option<Duration>,
    /// Number of timeouts since then.
    silences: u64,
    /// Whether [`Dispatcher::silent`] has not reported the last timeout yet.
    is_unreported: bool,
}

#[derive(Debug, Clone, Default)]
struct IssuedView {
    /// Attempts that were neither answered nor taken back.
    in_flight: Vec<ViewAttempt>,
    /// Number of the next attempt.
    attempts: u32,
    is_done: bool,
}

#[derive(Debug, Clone, Copy)]
struct ViewAttempt {
    number: u32,
    worker: usize,
    issued: Duration,
}

impl<K: Ord + Copy> Dispatcher<K> {
    /// A dispatcher for workers 0 to `workers` - 1, each with at most `window_per_worker` views in
    /// flight. A stalled worker gets its next view after `probe_after`.
    pub(crate) fn new(workers: usize, window_per_worker: usize, probe_after: Duration) -> Self {
        Self {
            window: window_per_worker,
            probe_after,
            workers: vec![WorkerRecord::default(); workers],
            views: BTreeMap::new(),
        }
    }

    /// The worker for the next view: the first worker with the fewest views in flight and room for
    /// another. A worker that has been stalled for `probe_after` has room for a single view.
    pub(crate) fn next_worker(&self, now: Duration) -> Option<usize> {
        (0..self.workers.len())
            .map(|worker| (self.outstanding_of(worker), worker))
            .filter(|&(count, worker)| count < self.room(worker, now))
            .min()
            .map(|(_, worker)| worker)
    }

    fn room(&self, worker: usize, now: Duration) -> usize {
        match self.workers[worker].stalled_since {
            None => self.window,
            Some(since) if now.saturating_sub(since) >= self.probe_after => self.window.min(1),
            Some(_) => 0,
        }
    }

    /// Number of the next attempt of `view`, from 0.
    pub(crate) fn next_attempt(&self, view: K) -> u32 {
        self.views.get(&view).map_or(0, |issued| issued.attempts)
    }

    /// Notes that `view` was sent to `worker`. Returns the number of this attempt, from 0.
    pub(crate) fn issued(&mut self, view: K, worker: usize, now: Duration) -> u32 {
        let issued = self.views.entry(view).or_default();
        let number = issued.attempts;
        issued.attempts += 1;
        issued.in_flight.push(ViewAttempt { number, worker, issued: now });
        number
    }

    /// Notes an answer; its worker is no longer stalled. Returns whether it is the view's first
    /// answer. The view is then done, even if that attempt was taken back.
    pub(crate) fn note_answer(
        &mut self,
        view: K,
        worker: usize,
        attempt: u32,
        now: Duration,
    ) -> bool {
        if let Some(worker) = self.workers.get_mut(worker) {
            *worker = WorkerRecord { answered: Some(now), ..WorkerRecord::default() };
        }
        let Some(issued) = self.views.get_mut(&view) else { return false };
        if attempt >= issued.attempts {
            return false;
        }
        issued.in_flight.retain(|other| (other.number, other.worker) != (attempt, worker));
        let is_first = !std::mem::replace(&mut issued.is_done, true);
        if issued.in_flight.is_empty() {
            self.views.remove(&view);
        }
        is_first
    }

    /// Marks each worker as stalled that has given no answer for `timeout`, counted from its oldest
    /// view or its last answer. All its views are taken back, because later ones would be even
    /// later.
    ///
    /// Returns the views to cut again for another worker, in rising order. Views that are done, or
    /// have another attempt in flight, are not included.
    pub(crate) fn overdue(&mut self, now: Duration, timeout: Duration) -> Vec<K> {
        let mut oldest: Vec<Option<Duration>> = vec![None; self.workers.len()];
        for attempt in self.views.values().flat_map(|issued| &issued.in_flight) {
            if let Some(oldest) = oldest.get_mut(attempt.worker) {
                *oldest = Some(oldest.map_or(attempt.issued, |other| other.min(attempt.issued)));
            }
        }
        let is_late: Vec<bool> = oldest
            .iter()
            .zip(&self.workers)
            .map(|(oldest, worker)| {
                oldest.is_some_and(|issued| {
                    let since = worker.answered.map_or(issued, |answered| answered.max(issued));
                    now.saturating_sub(since) >= timeout
                })
            })
            .collect();
        for (worker, _) in self.workers.iter_mut().zip(&is_late).filter(|(_, late)| **late) {
            worker.stalled_since = Some(now);
            worker.silences += 1;
            worker.is_unreported = true;
        }

        let mut lost = Vec::new();
        self.views.retain(|&view, issued| {
            let before = issued.in_flight.len();
            issued.in_flight.retain(|attempt| !is_late.get(attempt.worker).is_some_and(|&l| l));
            let is_idle = issued.in_flight.is_empty();
            if is_idle && before > 0 && !issued.is_done {
                lost.push(view);
            }
            !(is_idle && issued.is_done)
        });
        lost
    }

    /// Workers with a timeout since the last call, each with the number of timeouts since its last
    /// answer.
    pub(crate) fn silent(&mut self) -> Vec<(usize, u64)> {
        let unreported =
            self.workers.iter_mut().enumerate().filter(|(_, worker)| worker.is_unreported);
        unreported
            .map(|(index, worker)| {
                worker.is_unreported = false;
                (index, worker.silences)
            })
            .collect()
    }

    /// Removes all views for which `is_wanted` is false: answers of an abandoned frame are not
    /// needed.
    pub(crate) fn retain(&mut self, mut is_wanted: impl FnMut(K) -> bool) {
        self.views.retain(|&view, _| is_wanted(view));
    }

    /// Number of views in flight: neither answered nor taken back.
    pub(crate) fn outstanding(&self) -> usize {
        self.views.values().filter(|view| !view.is_done && !view.in_flight.is_empty()).count()
    }

    /// Number of views in flight at `worker`.
    pub(crate) fn outstanding_of(&self, worker: usize) -> usize {
        let attempts = self.views.values().flat_map(|issued| &issued.in_flight);
        attempts.filter(|attempt| attempt.worker == worker).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    const TIMEOUT: Duration = Duration::from_millis(100);

    fn is_stalled<K>(views: &Dispatcher<K>, worker: usize) -> bool {
        views.workers[worker].stalled_since.is_some()
    }

    fn at(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn the_least_busy_worker_comes_next_and_the_window_holds() {
        let mut views = Dispatcher::new(2, 2, at(1000));
        let mut order = Vec::new();
        for view in 0..4 {
            let worker = views.next_worker(at(0)).unwrap_or(9);
            assert_eq!(views.issued(view, worker, at(0)), 0);
            order.push(worker);
        }
        assert_eq!(order, [0, 1, 0, 1]);
        assert_eq!((views.next_worker(at(0)), views.outstanding()), (None, 4));
        assert!(views.note_answer(1, 1, 0, at(5)));
        assert_eq!((views.next_worker(at(5)), views.outstanding()), (Some(1), 3));
    }

    #[test]
    fn without_workers_there_is_no_next_one() {
        assert_eq!(Dispatcher::<u32>::new(0, 2, at(1000)).next_worker(at(0)), None);
        assert_eq!(Dispatcher::<u32>::new(3, 0, at(1000)).next_worker(at(0)), None);
    }

    #[test]
    fn a_dead_worker_loses_nobodys_view() {
        let mut views = Dispatcher::new(2, 4, at(1000));
        for view in 0..4 {
            views.issued(view, view as usize % 2, at(0));
        }
        assert!(views.note_answer(1, 1, 0, at(40)));
        assert_eq!(views.overdue(at(99), TIMEOUT), Vec::<u32>::new());
        // Worker 0 is dead; worker 1 answered 60 ms ago and is only busy.
        assert_eq!(views.overdue(at(100), TIMEOUT), [0, 2]);
        assert!(is_stalled(&views, 0) && !is_stalled(&views, 1));
        assert_eq!(views.outstanding(), 1);
        for view in [0, 2] {
            assert_eq!(views.next_worker(at(100)), Some(1));
            assert_eq!(views.issued(view, 1, at(100)), 1);
        }
        for (view, attempt) in [(3, 0), (0, 1), (2, 1)] {
            assert!(views.note_answer(view, 1, attempt, at(120)));
        }
        assert_eq!(views.outstanding(), 0);
    }

    #[test]
    fn a_late_answer_counts_once() {
        let mut views = Dispatcher::new(2, 2, at(1000));
        views.issued(7, 0, at(0));
        assert_eq!(views.overdue(at(100), TIMEOUT), [7]);
        assert_eq!(views.issued(7, 1, at(100)), 1);
        // The stalled worker answers after all, then the other one does.
        assert!(views.note_answer(7, 0, 0, at(110)));
        assert!(!is_stalled(&views, 0));
        assert_eq!((views.outstanding(), views.outstanding_of(1)), (0, 1));
        assert!(!views.note_answer(7, 1, 1, at(120)));
        assert_eq!(views.outstanding_of(1), 0);
        assert!(!views.note_answer(7, 1, 1, at(121)));
    }

    #[test]
    fn a_late_answer_before_the_view_is_cut_again_makes_that_needless() {
        let mut views = Dispatcher::new(1, 2, at(1000));
        views.issued(7, 0, at(0));
        assert_eq!(views.overdue(at(100), TIMEOUT), [7]);
        assert!(views.note_answer(7, 0, 0, at(110)));
        assert_eq!(views.overdue(at(900), TIMEOUT), Vec::<u32>::new());
    }

    #[test]
    fn attempts_that_were_never_made_answer_nothing() {
        let mut views = Dispatcher::new(1, 2, at(1000));
        views.issued(7, 0, at(0));
        assert!(!views.note_answer(7, 0, 1, at(1)));
        assert!(!views.note_answer(8, 5, 0, at(1)));
        assert_eq!(views.outstanding(), 1);
    }

    #[test]
    fn a_stalled_worker_is_tried_with_one_view_now_and_then() {
        let mut views = Dispatcher::new(1, 3, at(500));
        views.issued(0, 0, at(0));
        assert_eq!(views.overdue(at(100), TIMEOUT), [0]);
        assert_eq!((views.silent(), views.silent()), (vec![(0, 1)], vec![]));
        assert_eq!(views.next_worker(at(599)), None);
        assert_eq!(views.next_worker(at(600)), Some(0));
        views.issued(0, 0, at(600));
        assert_eq!(views.next_worker(at(600)), None);
        assert_eq!(views.overdue(at(700), TIMEOUT), [0]);
        assert_eq!(views.silent(), [(0, 2)]);
        assert_eq!(views.next_worker(at(1199)), None);
    }

    #[test]
    fn abandoned_views_are_forgotten() {
        let mut views = Dispatcher::new(1, 3, at(1000));
        views.issued((4, 0), 0, at(0));
        views.issued((5, 0), 0, at(0));
        views.retain(|(frame, _)| frame == 5);
        assert_eq!(views.outstanding(), 1);
        assert!(!views.note_answer((4, 0), 0, 0, at(1)));
        assert!(views.note_answer((5, 0), 0, 0, at(1)));
    }

    proptest! {
        /// Whoever dies, answers late or twice: each view is done exactly once, as long as one
        /// worker lives.
        #[test]
        fn every_view_is_done_once(
            workers in 1..5usize,
            window in 1..4usize,
            views in 1..20u32,
            luck in proptest::collection::vec(0..10u8, 600),
        ) {
            let mut dispatcher = Dispatcher::new(workers, window, at(300));
            let mut pending: BTreeSet<u32> = (0..views).collect();
            let mut held: Vec<(u32, usize, u32)> = Vec::new();
            let mut done = Vec::new();
            let mut luck = luck.into_iter();
            let mut now = at(0);
            // Chance rules while there is any; then worker 0 answers all it gets.
            while done.len() < views as usize {
                now += at(20);
                prop_assert!(now < at(1_000_000), "{dispatcher:?}");
                for view in dispatcher.overdue(now, TIMEOUT) {
                    prop_assert!(pending.insert(view));
                }
                while let Some(worker) = dispatcher.next_worker(now) {
                    let Some(view) = pending.pop_first() else { break };
                    let attempt = dispatcher.issued(view, worker, now);
                    held.push((view, worker, attempt));
                }
                let mut kept = Vec::new();
                for (view, worker, attempt) in std::mem::take(&mut held) {
                    let chance = luck.next().unwrap_or(if worker == 0 { 9 } else { 0 });
                    if chance >= 5 && dispatcher.note_answer(view, worker, attempt, now) {
                        done.push(view);
                        pending.remove(&view);
                    }
                    if chance < 6 {
                        kept.push((view, worker, attempt));
                    }
                }
                held = kept;
            }
            done.sort_unstable();
            prop_assert_eq!(done, (0..views).collect::<Vec<_>>());
        }
    }
}
