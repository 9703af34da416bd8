//! Test of a source: its frames one by one, and frames on credit in a lossless run.

use std::time::{Duration, Instant};

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{FrameHeader, FrameStamp, Frames, PlanHeader, Plans, StopRule};
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Publisher, Subscriber};

use super::bench::Bench;
use super::report::MUST_PASS;

const PAGE: &str = "A source (frame)";

/// Frames of one test.
const FRAMES: usize = 60;
/// Frames of a lossless test.
const CREDITS: u64 = 10;
/// Timeout for each further frame.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time in which no frame is received.
const PAUSE: Duration = Duration::from_secs(1);
/// Largest age of a frame, nanoseconds. An older one was held back.
const STALE_NS: i64 = 1_000_000_000;
/// Time in which no frame must come without credit.
const QUIET: Duration = Duration::from_millis(500);

struct Script<'r> {
    resolved: &'r Resolved,
    frames: Subscriber<Frames>,
    last: Option<FrameStamp>,
    /// Timeout for the first frame.
    first: Duration,
}

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let first = Duration::from_secs_f64(resolved.pipeline.supervision.start_s);
    let mut script = Script { resolved, frames: bench.ports.subscriber()?, last: None, first };
    match resolved.pipeline.flow() {
        Flow::Latest => script.at_its_own_rate(bench),
        Flow::Lossless => script.on_credit(bench),
    }
}

impl Script<'_> {
    /// The next frame, checked, without its pixels.
    fn next(
        &mut self,
        bench: &mut Bench,
        patience: Duration,
    ) -> anyhow::Result<Option<FrameHeader>> {
        let what = "frames pass the contract's check";
        let frame = bench.next(&mut self.frames, what, patience)?;
        let Some((frame, _pixels)) = frame else { return Ok(None) };
        let camera = &self.resolved.pipeline.camera;
        let size = "frames have the configured size";
        bench.report.field(size, PAGE, "width", frame.width, camera.width);
        bench.report.field(size, PAGE, "height", frame.height, camera.height);
        let stamp = frame.stamp;
        let generation = stamp.source_generation;
        bench.report.field("frames say whose they are", PAGE, "source_generation", generation, 0);
        if let Some(last) = self.last.replace(stamp) {
            let rises = stamp.order() > last.order();
            bench.report.holds("frames are in order", PAGE, rises, || {
                format!(
                    "sequence {} of epoch {} came after {} of {}",
                    stamp.sequence, stamp.epoch, last.sequence, last.epoch
                )
            });
            let is_later = stamp.exposure_ns > last.exposure_ns || stamp.epoch > last.epoch;
            bench.report.holds("exposures rise", PAGE, is_later, || {
                format!("exposure_ns {} came after {}", stamp.exposure_ns, last.exposure_ns)
            });
        }
        Ok(Some(frame))
    }

    fn at_its_own_rate(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let first = self.next(bench, self.first)?;
        bench.report.holds("frames come", PAGE, first.is_some(), || {
            format!("none came in {} s after it was ready", self.first.as_secs())
        });
        let Some(first) = first else { return Ok(()) };
        let (begun, mut delays_ms, mut count) = (Instant::now(), Vec::new(), 0);
        while count < FRAMES {
            let Some(frame) = self.next(bench, PATIENCE)? else { break };
            let (now_ns, stamp) = (clock::monotonic_ns(), frame.stamp);
            let is_of_now = (now_ns - STALE_NS..=now_ns).contains(&stamp.published_ns);
            bench.report.holds("times are of CLOCK_MONOTONIC", PAGE, is_of_now, || {
                format!("published_ns is {} where the clock says {now_ns}", stamp.published_ns)
            });
            bench.report.holds(
                "a frame is exposed before it is published",
                PAGE,
                stamp.exposure_ns <= stamp.published_ns,
                || {
                    format!(
                        "exposure_ns {} is after published_ns {}",
                        stamp.exposure_ns, stamp.published_ns
                    )
                },
            );
            delays_ms.push((stamp.published_ns - stamp.exposure_ns) as f64 * 1e-6);
            count += 1;
        }
        let seconds = begun.elapsed().as_secs_f64();
        let is_over = bench.is_finished();
        bench.report.holds("frames keep coming", PAGE, count == FRAMES || is_over, || {
            format!(
                "{count} came, then none in {} s, and its state is not finished",
                PATIENCE.as_secs()
            )
        });
        let sent = self.last.map_or(0, |last| last.sequence.saturating_sub(first.stamp.sequence));
        bench.report.figure("frames", count as f64 / seconds, "per second");
        bench.report.figure("frames left out", sent.saturating_sub(count as u64) as f64, "");
        bench.report.median("from exposure to publication, median", delays_ms, "ms");
        if is_over {
            return Ok(());
        }
        // No frame is received meanwhile. The source must continue, and later frames must be new.
        bench.pass(PAUSE)?;
        let mut newest = None;
        while let Some(frame) = self.next(bench, Duration::from_millis(1))? {
            newest = Some(frame);
        }
        let newest = match newest {
            Some(frame) => Some(frame),
            None => self.next(bench, PATIENCE)?,
        };
        let age_ns = newest.map(|frame| clock::monotonic_ns() - frame.stamp.published_ns);
        let is_new = age_ns.is_some_and(|age_ns| age_ns < STALE_NS) || bench.is_finished();
        bench.report.holds(
            "a reader that pauses holds nothing up",
            PAGE,
            is_new,
            || match age_ns {
                Some(age_ns) => {
                    format!("the newest frame was published {} ms ago", age_ns / 1_000_000)
                }
                None => "no frame came afterwards".to_owned(),
            },
        );
        Ok(())
    }

    fn on_credit(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let plans = bench.ports.publisher()?;
        let early = self.next(bench, QUIET)?;
        let what = "each frame waits for its plan";
        bench
            .report
            .holds(what, PAGE, early.is_none(), || "a frame came before the first plan".to_owned());
        let mut plan_id = 0;
        let mut after = None;
        let begun = Instant::now();
        for number in 0..CREDITS {
            plan_id += 1;
            give_credit(&plans, plan_id, after)?;
            let patience = if number == 0 { self.first } else { PATIENCE };
            let Some(frame) = self.next(bench, patience)? else {
                bench.report.holds(
                    "a plan is answered by a frame",
                    PAGE,
                    bench.is_finished(),
                    || format!("plan {plan_id} was answered by none in {} s", patience.as_secs()),
                );
                return Ok(());
            };
            bench.report.holds("a plan is answered by a frame", PAGE, true, String::new);
            let skips =
                after.is_some_and(|last: FrameStamp| frame.stamp.sequence != last.sequence + 1);
            bench.report.holds("no frame is left out", PAGE, !skips, || {
                format!(
                    "sequence {} came after {:?}",
                    frame.stamp.sequence,
                    after.map(|last| last.sequence)
                )
            });
            let (exposure_ns, stream_ns) = (frame.stamp.exposure_ns, frame.stamp.stream_ns);
            bench.report.field(
                "exposures are stream time",
                PAGE,
                "exposure_ns",
                exposure_ns,
                stream_ns,
            );
            after = Some(frame.stamp);
        }
        bench.report.figure("frames", CREDITS as f64 / begun.elapsed().as_secs_f64(), "per second");
        let surplus = self.next(bench, QUIET)?;
        bench
            .report
            .holds(what, PAGE, surplus.is_none(), || "two frames came for one plan".to_owned());
        // A new fusion starts the flow again.
        give_credit(&plans, 1, None)?;
        let again = self.next(bench, PATIENCE)?;
        bench.report.holds(
            "a plan without `after` opens the flow anew",
            PAGE,
            again.is_some(),
            || format!("no frame came in {} s", PATIENCE.as_secs()),
        );
        bench.report.check("malformed plans cost nothing else", MUST_PASS, None);
        let bad = PlanHeader { stop_rule: 77, plan_id: 2, ..PlanHeader::default() };
        plans.send(bad, &[])?;
        give_credit(&plans, 3, self.last)?;
        let next = self.next(bench, PATIENCE)?;
        bench.report.holds(
            "malformed plans cost nothing else",
            MUST_PASS,
            next.is_some() || bench.is_finished(),
            || "no frame came for the good plan after one with stop_rule 77".to_owned(),
        );
        Ok(())
    }
}

fn give_credit(
    plans: &Publisher<Plans>,
    plan_id: u64,
    after: Option<FrameStamp>,
) -> anyhow::Result<()> {
    let header = PlanHeader {
        after: after.unwrap_or_default(),
        plan_id,
        made_ns: clock::monotonic_ns(),
        has_after: u32::from(after.is_some()),
        stop_rule: StopRule::All.code(),
        ..PlanHeader::default()
    };
    Ok(plans.send(header, &[])?)
}
