//! The ports around the line.

use anyhow::Context as _;
use flockeye_autopilot::{AutopilotLine, AutopilotStatus};
use flockeye_config::Flow;
use flockeye_contract::{Odometries, Tracks};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::newest::Newest;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::{neighbours_of, sample_of};

/// Period of the check for odometry, nanoseconds. A frame's report, which is sent some 20 ms after
/// the exposure, carries it to the peers.
const LOOK_NS: i64 = 5_000_000;
/// Period of the report on the line's state, nanoseconds.
const DETAIL_NS: i64 = 500_000_000;

/// Sends tracks to the autopilot as its neighbours, and publishes the drone's odometry.
pub(crate) struct AutopilotStage {
    tracks: Subscriber<Tracks>,
    odometries: Publisher<Odometries>,
    line: AutopilotLine,
    link: String,
    newest: Newest,
    flow: Flow,
    generation: u32,
    counters: SharedCounters,
    failures: Throttle,
    detail_ns: i64,
}

impl Stage for AutopilotStage {
    const NAME: &'static str = "autopilot";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let pipeline = &context.resolved.pipeline;
        let settings =
            pipeline.autopilot.as_ref().context("autopilot is not in the configuration")?;
        Ok(Self {
            tracks: ports.subscriber()?,
            odometries: ports.publisher()?,
            line: AutopilotLine::open(settings)?,
            link: settings.link.clone(),
            newest: Newest::default(),
            flow: pipeline.flow(),
            generation: context.identity.generation,
            counters: context.counters.clone(),
            failures: Throttle::default(),
            detail_ns: 0,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        while let Some(message) = self.tracks.receive()? {
            let stamp = &message.header.stamp;
            let exposure_ns = clock::exposure_ns(stamp, self.flow);
            for neighbour in neighbours_of(message.items(), stamp, exposure_ns, &mut self.newest) {
                let sent = self.line.neighbour(&neighbour);
                let what = "a neighbour is not sent to the autopilot";
                self.counters.note_sent(sent, &mut self.failures, what);
            }
        }
        if let Some(state) = self.line.take_odometry() {
            self.odometries.send(sample_of(&state, self.generation), &[])?;
        }
        let now_ns = clock::monotonic_ns();
        if now_ns >= self.detail_ns {
            self.detail_ns = now_ns + DETAIL_NS;
            self.look(now_ns);
        }
        Ok(Step::WaitUntil(now_ns + LOOK_NS))
    }
}

impl AutopilotStage {
    /// Reports whether the autopilot sends messages.
    fn look(&mut self, now_ns: i64) {
        let AutopilotStatus { is_open, is_heard, .. } = self.line.status();
        let what = match (is_open, is_heard) {
            (_, true) => "the autopilot answers",
            (true, false) => "open, the autopilot is silent",
            (false, false) => "not open",
        };
        self.counters.set_detail(format!("{}: {what}", self.link));
        self.counters.note_link(is_heard, now_ns);
    }
}
