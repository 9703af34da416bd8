//! The ports around the line.

use anyhow::Context as _;
use flockeye_autopilot::{
    Autopilot as Line, AutopilotError, AutopilotParameters, AutopilotStatus, Rates,
};
use flockeye_config::{Autopilot, Flow};
use flockeye_contract::{Odometries, Tracks};
use flockeye_runtime::health::{Absence, SharedCounters};
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::{Core, sample_of};

/// How often it is looked whether odometry has come, nanoseconds. Peers get it with a frame's report, which
/// leaves some 20 ms after the exposure.
const LOOK_NS: i64 = 5_000_000;
/// How often the line's state is reported, nanoseconds.
const DETAIL_NS: i64 = 500_000_000;

/// Takes tracks; gives the autopilot its neighbours, and the pipeline the drone's odometry.
pub(crate) struct AutopilotStage {
    tracks: Subscriber<Tracks>,
    odometries: Publisher<Odometries>,
    line: Line,
    link: String,
    core: Core,
    flow: Flow,
    generation: u32,
    counters: SharedCounters,
    failures: Throttle,
    detail_ns: i64,
    /// Since when the autopilot is not heard.
    absence: Absence,
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
            line: open(settings)?,
            link: settings.link.clone(),
            core: Core::default(),
            flow: pipeline.flow(),
            generation: context.identity.generation,
            counters: context.counters.clone(),
            failures: Throttle::default(),
            detail_ns: 0,
            absence: Absence::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        while let Some(message) = self.tracks.receive()? {
            let stamp = &message.header.stamp;
            let exposure_ns = clock::exposure_ns(stamp, self.flow);
            for neighbour in self.core.on_tracks(stamp, exposure_ns, message.items()) {
                self.note(self.line.neighbour(&neighbour));
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
    /// Counts a neighbour's state that the autopilot gets, or does not.
    fn note(&mut self, sent: Result<(), AutopilotError>) {
        let what = "a neighbour is not sent to the autopilot";
        self.counters.note_sent(sent, &mut self.failures, what);
    }

    /// Reports whether the autopilot is there.
    fn look(&mut self, now_ns: i64) {
        let AutopilotStatus { is_open, is_heard, .. } = self.line.status();
        let what = match (is_open, is_heard) {
            (_, true) => "the autopilot answers",
            (true, false) => "open, the autopilot is silent",
            (false, false) => "not open",
        };
        self.counters.set_detail(format!("{}: {what}", self.link));
        self.counters.set_state(self.absence.state(is_heard, now_ns));
    }
}

fn open(settings: &Autopilot) -> Result<Line, AutopilotError> {
    Line::open(&AutopilotParameters {
        link: settings.link.clone(),
        system_id: settings.system_id,
        component_id: settings.component_id,
        target: settings.target.clone(),
        rates: Rates {
            target_hz: settings.target_hz,
            obstacles_hz: settings.obstacles_hz,
            odometry_hz: settings.odometry_hz,
        },
        max_age_ms: settings.max_age_ms,
        obstacle_range_m: settings.obstacle_range_m,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_that_cannot_work_is_refused_with_its_cure() {
        let settings = Autopilot { link: "udpin:14540".into(), ..Autopilot::default() };
        let error = open(&settings).map(drop).map_err(|error| error.to_string());
        assert!(error.is_err_and(|error| error.starts_with("link: 'udpin:14540'")));
    }
}
