//! Gives the core of fusion the inputs of a recorded flight again, and compares its outputs with
//! the recorded ones.
//!
//! The output of the core depends on its messages, their order, and the times of its calls. The
//! journal contains all of these, so also a flight in real time can be repeated. Each entry is one
//! call of the core. A background pass runs at once, and its answer is used at its entry in the
//! journal.

mod compared;
mod script;
#[cfg(test)]
mod tests;

use std::path::Path;

use anyhow::{Context, bail, ensure};
use flockeye_config::Resolved;
use flockeye_contract::{FrameOrder, JournalEntry, JournalKind, PlanHeader, TrackHeader};
use flockeye_recording::Ending;

pub(crate) use self::script::{NO_JOURNAL, names_message};

use self::compared::MessageComparison;
use self::script::{NextCall, Script};
use crate::recorded::{FlightMessage, LostMessages, RecordedFlight, RecordedPixels};
use flockeye_fusion::BackgroundRunner;
use flockeye_fusion::Writer;
use flockeye_fusion::configured;
use flockeye_fusion::{Core, Event, Outputs};

/// The result of a replay.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct ReplayReport {
    /// Number of frames that ended.
    pub frames: u64,
    /// Number of compared messages.
    pub messages: u64,
    /// Number of answers of background passes that were used.
    pub answers: u64,
    /// The first difference; `None`: equal bytes.
    pub difference: Option<String>,
    /// The reason if the comparison ends before the recording.
    pub end: Option<String>,
    /// Number of plans that are not in the recording.
    pub lost_plans: u64,
    /// Number of recorded messages of fusion that were not compared.
    pub left: u64,
    /// Messages that are missing in the recording, or may be missing.
    pub lost: LostMessages,
}

/// Replays a recording with its views (`flockeye record --frames views`).
///
/// # Errors
/// The recording has no journal from fusion's beginning, or no pixels, or its configuration is not
/// valid any more.
pub(crate) fn replay(path: &Path) -> anyhow::Result<ReplayReport> {
    let mut recorded = RecordedFlight::open(path)?;
    let resolved = recorded.configuration()?;
    let mut replay = FusionReplay::new(&resolved)?;
    while let Some((message, utc_ns)) = recorded.next_message()? {
        replay.on(message, utc_ns, |_, _| {}).with_context(|| path.display().to_string())?;
    }
    let is_whole = recorded.ending() == Some(Ending::Whole);
    let replayed = replay.finish(is_whole).with_context(|| path.display().to_string())?;
    Ok(ReplayReport { lost: recorded.lost(), ..replayed })
}

/// Replays a recording and prints the result. Returns whether all compared messages are equal.
pub(crate) fn report(path: &Path) -> anyhow::Result<bool> {
    let replayed = replay(path)?;
    print!("{replayed}");
    Ok(replayed.difference.is_none())
}

impl std::fmt::Display for ReplayReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { frames, messages, answers, difference, end, lost_plans, left, lost } = self;
        match difference {
            None => writeln!(
                f,
                "{messages} messages of {frames} frames are the same, byte by byte; {answers} background passes"
            )?,
            Some(difference) => {
                writeln!(f, "after {messages} messages of {frames} frames: {difference}")?;
            }
        }
        if *lost_plans > 0 {
            writeln!(
                f,
                "{lost_plans} plans of fusion are not in the recording, and were not compared"
            )?;
        }
        if let Some(end) = end {
            writeln!(f, "the comparison ends there: {end}")?;
        }
        if *left > 0 && difference.is_none() {
            writeln!(
                f,
                "{left} more messages of fusion are in the recording, and were not compared"
            )?;
        }
        if !lost.is_empty() {
            let lost = said(lost);
            writeln!(f, "the recording lacks messages, from which a difference may come: {lost}")?;
        }
        Ok(())
    }
}

/// Lost messages, as text.
fn said(lost: &[(String, u64)]) -> String {
    let of_topic = |(topic, messages): &(String, u64)| format!("{topic} {messages}");
    lost.iter().map(of_topic).collect::<Vec<_>>().join(", ")
}

/// The core of fusion, with the messages that it received.
pub(crate) struct FusionReplay {
    core: Core<RecordedPixels>,
    writer: Writer,
    background: Option<BackgroundRunner>,
    /// Whether the last view still lacks its pixels.
    lacks_pixels: bool,
    script: Script,
    /// Output of the last step, until the journal gives the time of its sending.
    unsaid: Outputs,
    compared: MessageComparison,
    /// The newest frame that has ended.
    ended: Option<FrameOrder>,
    replayed: ReplayReport,
}

impl FusionReplay {
    /// Begins before the first message.
    pub(crate) fn new(resolved: &Resolved) -> anyhow::Result<Self> {
        let (core, writer, aligner) = configured(resolved, 0)?;
        Ok(Self {
            core,
            writer,
            background: aligner.map(BackgroundRunner::inline),
            lacks_pixels: false,
            script: Script::default(),
            unsaid: Outputs::default(),
            compared: MessageComparison::new()?,
            ended: None,
            replayed: ReplayReport::default(),
        })
    }

    /// The core. Callers may let it keep its decisions.
    pub(crate) fn core(&mut self) -> &mut Core<RecordedPixels> {
        &mut self.core
    }

    /// The result so far.
    pub(crate) fn so_far(&self) -> &ReplayReport {
        &self.replayed
    }

    /// Whether the recording has a journal, as far as it was read.
    pub(crate) fn has_journal(&self) -> bool {
        self.script.has_begun()
    }

    /// Whether the comparison continues, without a difference so far.
    pub(crate) fn is_under_way(&self) -> bool {
        self.replayed.difference.is_none() && self.replayed.end.is_none()
    }

    /// Whether the core has ended a frame, and all its messages were compared.
    pub(crate) fn has_ended(&self, order: FrameOrder) -> bool {
        self.ended >= Some(order) && self.compared.is_done()
    }

    /// Takes a message of the recording. `before` is called before each entry of the journal that
    /// is executed.
    pub(crate) fn on(
        &mut self,
        message: FlightMessage,
        utc_ns: u64,
        before: impl FnMut(&Core<RecordedPixels>, &JournalEntry),
    ) -> anyhow::Result<()> {
        if !self.is_under_way() {
            let is_said = matches!(
                message,
                FlightMessage::Tracks(TrackHeader { generation: 0, .. }, ..)
                    | FlightMessage::Plan(PlanHeader { generation: 0, .. }, ..)
            );
            self.replayed.left += u64::from(is_said);
            return Ok(());
        }
        match message {
            FlightMessage::Header(_) => {
                self.needs_no_pixels()?;
                self.lacks_pixels = true;
            }
            FlightMessage::View(header, pixels) => {
                self.lacks_pixels = false;
                self.script.hear(Event::View(header, pixels), utc_ns)?;
            }
            FlightMessage::Searched(record) => self.script.hear(Event::Searched(record), utc_ns)?,
            FlightMessage::Rotation(rotation) => {
                self.script.hear(Event::Rotation(rotation), utc_ns)?
            }
            FlightMessage::FrameEnd(end) => self.script.hear(Event::FrameEnd(end), utc_ns)?,
            FlightMessage::Journal(header, entries) => {
                self.script.note(&header, &entries, utc_ns)?
            }
            // Messages of a successor are not compared.
            FlightMessage::Tracks(header, _, bytes) if header.generation == 0 => {
                self.compared.tracks.record(bytes);
            }
            FlightMessage::Plan(header, _, bytes) if header.generation == 0 => {
                self.compared.plans.record(bytes);
            }
            FlightMessage::Tracks(..)
            | FlightMessage::Plan(..)
            | FlightMessage::Frame(_)
            | FlightMessage::Truth(..) => {
                return Ok(());
            }
        }
        self.work(Some(utc_ns), before)
    }

    /// Ends the replay at the end of the recording. `is_whole`: the recording was not cut off.
    pub(crate) fn finish(mut self, is_whole: bool) -> anyhow::Result<ReplayReport> {
        if self.is_under_way() {
            if is_whole {
                self.needs_no_pixels()?;
            }
            self.work(None, |_, _| {})?;
        }
        ensure!(self.script.has_begun(), NO_JOURNAL);
        if self.replayed.messages == 0 && self.is_under_way() {
            bail!("the recording has no message of fusion. Cure: record for longer");
        }
        let left = self.replayed.left + self.compared.left();
        Ok(ReplayReport { left, lost_plans: self.compared.lost_plans, ..self.replayed })
    }

    /// Refuses a recording in which the last view has no pixels.
    fn needs_no_pixels(&self) -> anyhow::Result<()> {
        if self.lacks_pixels {
            bail!(
                "a view without its pixels. Cure: record with them (recording.frames: views, or --frames views)"
            );
        }
        Ok(())
    }

    /// Executes the journal as far as it is known.
    fn work(
        &mut self,
        utc_ns: Option<u64>,
        mut before: impl FnMut(&Core<RecordedPixels>, &JournalEntry),
    ) -> anyhow::Result<()> {
        while self.is_under_way() {
            match self.script.next(utc_ns) {
                NextCall::Wait => break,
                NextCall::End(reason) => self.replayed.end = Some(reason),
                NextCall::Entry(entry, event) => {
                    before(&self.core, &entry);
                    let difference = self.follow(&entry, event)?;
                    // A difference of earlier messages comes first.
                    self.compare();
                    self.replayed.difference = self.replayed.difference.take().or(difference);
                }
            }
        }
        self.compare();
        Ok(())
    }

    fn compare(&mut self) {
        if self.replayed.difference.is_none() {
            let (messages, difference) = self.compared.compare();
            self.replayed.messages += messages;
            self.replayed.difference = difference;
        }
    }

    /// Executes an entry. Returns a difference from the flight, if there is one.
    fn follow(
        &mut self,
        entry: &JournalEntry,
        event: Option<Event<RecordedPixels>>,
    ) -> anyhow::Result<Option<String>> {
        let now_ns = entry.at_ns;
        if let Some(event) = event {
            self.core.on(event, now_ns);
            return Ok(None);
        }
        match JournalKind::try_from(entry.kind)? {
            JournalKind::Background => {
                let background = self.background.as_mut();
                let Some(answer) = background.map_or(Ok(None), BackgroundRunner::answer)? else {
                    let difference = "a background pass was answered that is not asked for now";
                    return Ok(Some(self.at(difference)));
                };
                self.replayed.answers += 1;
                self.core.on(Event::Background(answer), now_ns);
            }
            JournalKind::Step => {
                if self.unsaid.messages() != (0, 0) {
                    return Ok(Some(self.at("a step led to nothing, and leads to messages now")));
                }
                let mut outputs = self.core.step(now_ns);
                if !outputs.has_worked() {
                    return Ok(Some(
                        self.at("there was something to do, and there is nothing now"),
                    ));
                }
                if let (Some(job), Some(runner)) = (outputs.job.take(), &mut self.background) {
                    runner.run(job)?;
                }
                self.unsaid = outputs;
            }
            JournalKind::Said => {
                let outputs = std::mem::take(&mut self.unsaid);
                let (tracks, plans) = outputs.messages();
                if (tracks, plans) != (entry.tracks as usize, entry.plans as usize) {
                    let JournalEntry { tracks: told, plans: planned, .. } = entry;
                    return Ok(Some(self.at(&format!(
                        "a step led to {told} messages of tracks and {planned} plans, now to {tracks} and {plans}"
                    ))));
                }
                self.say(&outputs, now_ns);
            }
            JournalKind::View
            | JournalKind::Searched
            | JournalKind::FrameEnd
            | JournalKind::Rotation => {}
        }
        Ok(None)
    }

    /// The text of a difference that is not in a message, with its place in the flight.
    fn at(&self, difference: &str) -> String {
        match self.ended {
            None => format!("before the first frame ended: {difference}"),
            Some((_, _, sequence)) => format!("after the end of frame {sequence}: {difference}"),
        }
    }

    /// Writes the output of the core as messages of the time `now_ns`.
    fn say(&mut self, outputs: &Outputs, now_ns: i64) {
        for message in &outputs.tracks {
            if message.is_last {
                self.replayed.frames += 1;
                self.ended = self.ended.max(Some(message.stamp.order()));
            }
            let (header, tracks) = self.writer.tracks(message, self.core.tracker(), now_ns);
            self.compared.tracks.give(&header, &tracks);
        }
        if let Some((next, after)) = &outputs.plan {
            let (header, views) = self.writer.plan(next, *after, now_ns);
            self.compared.plans.give(&header, &views);
        }
    }
}
