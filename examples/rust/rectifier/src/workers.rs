//! Which worker has which view of a frame, and for how long.

/// A view that its worker has not answered.
#[derive(Debug, Clone, Copy)]
pub struct GivenView {
    /// Its place in the plan.
    pub index: u32,
    /// How often it was given before.
    pub attempt: u32,
    /// Who has it.
    pub worker: usize,
    /// When it was given, CLOCK_MONOTONIC, nanoseconds.
    pub given_ns: i64,
}

/// The workers, and what each has in work.
pub struct Workers {
    in_flight: Vec<GivenView>,
    /// How often in a row each worker has not answered in time.
    silences: Vec<u64>,
    window: usize,
}

impl Workers {
    /// So many workers, each with at most `window` views.
    pub fn new(count: usize, window: usize) -> Self {
        Self { in_flight: Vec::new(), silences: vec![0; count], window }
    }

    /// Notes that a worker has a view.
    pub fn give(&mut self, view: GivenView) {
        self.in_flight.push(view);
    }

    /// Whether every view was answered.
    pub fn is_idle(&self) -> bool {
        self.in_flight.is_empty()
    }

    /// Forgets a worker's silence.
    pub fn has_spoken(&mut self, worker: u32) {
        if let Some(silence) = self.silences.get_mut(worker as usize) {
            *silence = 0;
        }
    }

    /// Takes a view that was answered out; false if nobody waits for this answer. An earlier attempt may
    /// answer too.
    pub fn is_answered(&mut self, index: u32, attempt: u32) -> bool {
        let is_it = |view: &GivenView| view.index == index && attempt <= view.attempt;
        let place = self.in_flight.iter().position(is_it);
        place.map(|place| self.in_flight.swap_remove(place)).is_some()
    }

    /// Takes a view back that was given before `given_before_ns`, with how often in a row its worker has now
    /// been silent.
    pub fn take_late(&mut self, given_before_ns: i64) -> Option<(GivenView, u64)> {
        let place = self.in_flight.iter().position(|view| view.given_ns < given_before_ns)?;
        let late = self.in_flight.swap_remove(place);
        let silence = self.silences.get_mut(late.worker)?;
        *silence += 1;
        Some((late, *silence))
    }

    /// The worker with the fewest views, if one has room. A silent worker gets a view only where the others
    /// have no room, and one at a time.
    pub fn next(&self) -> Option<usize> {
        let of_silence = |is_silent: bool| {
            let room = if is_silent { 1 } else { self.window };
            let like_it = (0..self.silences.len())
                .filter(move |&worker| (self.silences[worker] > 0) == is_silent);
            like_it.filter(move |&worker| self.load(worker) < room).min_by_key(|&w| self.load(w))
        };
        of_silence(false).or_else(|| of_silence(true))
    }

    /// Who gets a silent worker's view: another with the fewest, or the same one if it is alone.
    pub fn other_than(&self, silent: usize) -> usize {
        let others = (0..self.silences.len()).filter(|&worker| worker != silent);
        others.min_by_key(|&worker| self.load(worker)).unwrap_or(silent)
    }

    fn load(&self, worker: usize) -> usize {
        self.in_flight.iter().filter(|view| view.worker == worker).count()
    }
}
