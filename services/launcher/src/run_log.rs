//! Messages that a run receives from its stages: shown, recorded and summed up.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use flockeye_cli::duration;
use flockeye_config::Resolved;
use flockeye_contract::{
    Detections, FrameStamp, Healths, ImuSample, Imus, Rotations, StageState, Topic, Tracks, Truths,
};
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Ports, Subscriber};
use flockeye_tables::sweep::SweepReport;
use flockeye_tables::{
    FrameTimes, ImuRow, MarkerRays, PoseRow, RotationRow, TableWriter, TruthRow, WrittenRow,
};

use crate::control::WorkerName;
use crate::dashboard::Dashboard;
use crate::metrics::MetricsExporter;
use crate::sweep_watch::SweepWatch;

/// What ends a run, and what is recorded of it.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct RunOptions {
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Stop after so many frames.
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// Record each neighbour's pose in each frame.
    #[arg(long, value_name = "FILE.csv")]
    pub poses: Option<PathBuf>,
    /// Record the truth of a simulated flight.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: Option<PathBuf>,
    /// Record how the camera has turned to each frame.
    #[arg(long, value_name = "FILE.csv")]
    pub rotations: Option<PathBuf>,
    /// Record the samples of the inertial sensor, as `inertial.source` takes them.
    #[arg(long, value_name = "FILE.csv")]
    pub imu: Option<PathBuf>,
    /// Record when each frame was published and when it ended.
    #[arg(long, value_name = "FILE.csv")]
    pub frame_times: Option<PathBuf>,
    /// Record the corner rays of all detected markers.
    #[arg(long, value_name = "FILE.csv")]
    pub rays: Option<PathBuf>,
    /// Let the stages fly on if the launcher dies; the next `up --keep` takes them over.
    #[arg(long)]
    pub keep: bool,
    /// Note how often each part of the sphere is searched.
    #[arg(skip)]
    pub watches_sweep: bool,
}

/// Start of a frame's stream on the clock of the frames, nanoseconds.
fn stream_zero_ns(stamp: &FrameStamp) -> i64 {
    stamp.exposure_ns.saturating_sub(stamp.stream_ns)
}

/// Maximum number of samples kept before the first frame.
const MOST_EARLY_SAMPLES: usize = 20_000;

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RunSummary {
    pub frames: u64,
    /// Poses that were measured, in all frames.
    pub measured: u64,
    /// Time from the first frame's end to the last one's, seconds.
    pub ends_s: f64,
    /// Search rate of each part of the sphere, if requested.
    pub sweep: Option<SweepReport>,
}

pub(crate) struct RunLog {
    tracks: Subscriber<Tracks>,
    healths: Subscriber<Healths>,
    truths: Subscriber<Truths>,
    rotations: Option<(Subscriber<Rotations>, TableWriter<RotationRow>)>,
    imus: Option<(Subscriber<Imus>, TableWriter<ImuRow>)>,
    rays: Option<(Subscriber<Detections>, TableWriter<MarkerRays>)>,
    poses: Option<TableWriter<PoseRow>>,
    truth: Option<TableWriter<TruthRow>>,
    frame_times: Option<TableWriter<FrameTimes>>,
    /// Samples before the first frame, when the start of the stream is not known.
    early_samples: Vec<ImuSample>,
    /// Start of the stream on the clock of the frames, nanoseconds.
    zero_ns: Option<i64>,
    /// Frame of the previous rotation.
    last_rotation: Option<FrameStamp>,
    sweep: Option<SweepWatch>,
    pub dashboard: Dashboard,
    /// Exporter for Prometheus.
    metrics: Option<MetricsExporter>,
    /// A process beside the one that counts: its health is kept apart.
    pub beside: Option<(WorkerName, u32)>,
    /// The newest frame with a track.
    pub newest: Option<FrameStamp>,
    /// Requested number of frames. Times of further frames are not recorded.
    most_frames: u64,
    measured: u64,
    first_end_ns: Option<i64>,
    last_end_ns: i64,
    /// Arrival of the last track, or start of the source if that was later.
    pub last_track: Instant,
}

/// Subscriber of a topic and the file of its records, if one is requested.
fn recorded<T: Topic, R: WrittenRow>(
    file: Option<&PathBuf>,
    ports: &mut Ports,
) -> anyhow::Result<Option<(Subscriber<T>, TableWriter<R>)>> {
    file.map(|file| Ok((ports.subscriber()?, TableWriter::create(file)?))).transpose()
}

impl RunLog {
    /// Subscribes to the topics and creates the files.
    pub(crate) fn open(
        resolved: &Resolved,
        options: &RunOptions,
        ports: &mut Ports,
    ) -> anyhow::Result<Self> {
        let sweep = options.watches_sweep.then(|| SweepWatch::open(resolved, ports)).transpose()?;
        let has_sensor = resolved.pipeline.has_inertial_sensor();
        anyhow::ensure!(
            has_sensor || options.imu.is_none(),
            "--imu: there is no inertial sensor. Cure: inertial.source"
        );
        Ok(Self {
            tracks: ports.subscriber()?,
            healths: ports.subscriber()?,
            truths: ports.subscriber()?,
            poses: options.poses.as_deref().map(TableWriter::create).transpose()?,
            truth: options.truth.as_deref().map(TableWriter::create).transpose()?,
            rotations: recorded(options.rotations.as_ref(), ports)?,
            imus: recorded(options.imu.as_ref(), ports)?,
            frame_times: options.frame_times.as_deref().map(TableWriter::create).transpose()?,
            rays: recorded(options.rays.as_ref(), ports)?,
            early_samples: Vec::new(),
            zero_ns: None,
            last_rotation: None,
            sweep: sweep.flatten(),
            dashboard: Dashboard::default(),
            metrics: match resolved.pipeline.metrics.listen {
                Some(listen) => {
                    Some(MetricsExporter::serve(listen, &resolved.pipeline.instance.0)?)
                }
                None => None,
            },
            beside: None,
            newest: None,
            most_frames: options.frames.unwrap_or(u64::MAX),
            measured: 0,
            first_end_ns: None,
            last_end_ns: 0,
            last_track: Instant::now(),
        })
    }

    /// Receives all waiting messages.
    pub(crate) fn receive(&mut self) -> anyhow::Result<()> {
        while let Some(message) = self.healths.receive()? {
            let health = &message.header;
            let is_beside = self.beside.is_some_and(|(worker, generation)| {
                health.stage.to_string_lossy() == worker.stage.name()
                    && (health.replica, health.generation) == (worker.replica, generation)
            });
            if !is_beside {
                self.dashboard.health(health);
            }
        }
        while let Some(message) = self.truths.receive()? {
            self.dashboard.truth(&message.header, message.items());
            if let Some(recorder) = &mut self.truth {
                for body in message.items() {
                    recorder.add(&TruthRow::of(&message.header, body))?;
                }
            }
        }
        if let Some((detections, recorder)) = &mut self.rays {
            while let Some(message) = detections.receive()? {
                for marker in message.items() {
                    recorder.add(&MarkerRays::new(&message.header, marker))?;
                }
            }
        }
        if let Some((rotations, recorder)) = &mut self.rotations {
            while let Some(message) = rotations.receive()? {
                let before = self.last_rotation.replace(message.header.stamp);
                let stamp = &message.header.stamp;
                let zero_ns = *self.zero_ns.get_or_insert_with(|| stream_zero_ns(stamp));
                recorder.add(&RotationRow::of(&message.header, before.as_ref(), zero_ns))?;
            }
        }
        self.record_samples()?;
        if let Some(sweep) = &mut self.sweep {
            sweep.receive()?;
        }
        while let Some(message) = self.tracks.receive()? {
            let stamp = message.header.stamp;
            let is_last = message.header.is_last != 0;
            self.last_track = Instant::now();
            self.newest = Some(stamp);
            self.zero_ns.get_or_insert_with(|| stream_zero_ns(&stamp));
            let now_ns = clock::monotonic_ns();
            self.dashboard.tracks(&stamp, message.items(), is_last, now_ns);
            if let Some(metrics) = &self.metrics {
                metrics.tracks(message.items());
            }
            for row in message.items().iter().filter_map(|track| PoseRow::of(&stamp, track)) {
                self.measured += u64::from(row.is_measured());
                if let Some(recorder) = &mut self.poses {
                    recorder.add(&row)?;
                }
            }
            if is_last {
                self.end(&stamp, now_ns)?;
            }
        }
        if let Some(metrics) = &mut self.metrics {
            metrics.update(&self.dashboard, clock::monotonic_ns());
        }
        Ok(())
    }

    /// Records the waiting samples, once a frame has shown when the stream began.
    fn record_samples(&mut self) -> anyhow::Result<()> {
        let Some((imus, recorder)) = &mut self.imus else { return Ok(()) };
        while let Some(message) = imus.receive()? {
            self.early_samples.extend_from_slice(message.items());
            // If no frame arrives for hours, the newest samples are kept.
            let surplus = self.early_samples.len().saturating_sub(MOST_EARLY_SAMPLES);
            self.early_samples.drain(..surplus);
        }
        if let Some(zero_ns) = self.zero_ns {
            for sample in self.early_samples.drain(..) {
                recorder.add(&ImuRow::of(&sample, zero_ns))?;
            }
        }
        Ok(())
    }

    fn end(&mut self, stamp: &FrameStamp, now_ns: i64) -> anyhow::Result<()> {
        self.first_end_ns.get_or_insert(now_ns);
        self.last_end_ns = now_ns;
        match &mut self.frame_times {
            Some(recorder) if self.dashboard.frames_ended <= self.most_frames => {
                recorder.add(&FrameTimes::new(stamp, now_ns))
            }
            _ => Ok(()),
        }
    }

    /// Whether the requested number of frames have ended.
    pub(crate) fn is_complete(&self) -> bool {
        self.dashboard.frames_ended >= self.most_frames
    }

    /// Whether a worker has reported last that it is ready or degraded.
    pub(crate) fn is_ready(&self, worker: WorkerName) -> bool {
        let state = self.dashboard.state_of(worker.stage.name(), worker.replica);
        matches!(state, Some(StageState::Ready | StageState::Degraded))
    }

    /// Whether this process of a worker has reported anything.
    pub(crate) fn has_reported(&self, worker: WorkerName, pid: Option<u32>) -> bool {
        let (stage, replica) = (worker.stage.name(), worker.replica);
        pid.is_some_and(|pid| self.dashboard.last_report(stage, replica, pid).is_some())
    }

    /// Receives the last messages and completes the files.
    pub(crate) fn finish(&mut self) -> anyhow::Result<RunSummary> {
        self.receive()?;
        self.record_samples()?;
        self.poses.take().map(TableWriter::finish).transpose()?;
        self.truth.take().map(TableWriter::finish).transpose()?;
        self.rotations.take().map(|(_, writer)| writer.finish()).transpose()?;
        self.imus.take().map(|(_, writer)| writer.finish()).transpose()?;
        self.frame_times.take().map(TableWriter::finish).transpose()?;
        self.rays.take().map(|(_, writer)| writer.finish()).transpose()?;
        let first_end_ns = self.first_end_ns.unwrap_or(self.last_end_ns);
        Ok(RunSummary {
            frames: self.dashboard.frames_ended,
            measured: self.measured,
            ends_s: (self.last_end_ns - first_end_ns) as f64 * 1e-9,
            sweep: self.sweep.as_ref().and_then(SweepWatch::report),
        })
    }
}
