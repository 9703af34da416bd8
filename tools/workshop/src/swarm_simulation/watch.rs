//! Receives reports and truth from the pipelines of a swarm, with a thread for each pipeline.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread::JoinHandle;
use std::time::Duration;

use flockeye_cli::running::{PipelineChoice, attach};
use flockeye_contract::{Peers, Rotations, SwarmPose, SwarmWay, Swarms, Tracks, Truths};
use flockeye_convert::{camera_turn, isometry, matrix6};
use flockeye_peer::{PeerReport, SwarmView, UncertainPose};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::ports::{Ports, Subscriber};
use nalgebra::{Isometry3, UnitQuaternion};

use super::score::Claim;

/// Interval of the checks whether a pipeline runs and whether messages have arrived.
const POLL: Duration = Duration::from_millis(50);

/// An event in a drone's pipeline.
#[derive(Debug)]
pub(crate) enum SwarmEvent {
    /// The true poses of the other drones.
    Truth {
        /// The drone.
        from: String,
        /// The frame's number, which is unique while no simulator is replaced.
        frame: u64,
        /// The exposure, CLOCK_MONOTONIC, nanoseconds.
        at_ns: i64,
        /// The other drones' poses in its frame.
        others: Vec<(String, Isometry3<f64>)>,
    },
    /// Its fusion has sent poses.
    PoseSent {
        /// The drone.
        from: String,
        /// The frame's number.
        frame: u64,
        /// CLOCK_MONOTONIC, nanoseconds.
        sent_ns: i64,
    },
    /// A report on another drone's frame has arrived, with the time at which the frame was exposed.
    ReportArrived {
        /// The other drone.
        observer: String,
        /// The frame's number.
        frame: u64,
        /// Arrival of the report, CLOCK_MONOTONIC, nanoseconds.
        arrived_ns: i64,
        /// The exposure, CLOCK_MONOTONIC, nanoseconds.
        exposure_ns: i64,
        /// Stated standard deviation of the exposure, nanoseconds.
        deviation_ns: i64,
    },
    /// Its claims about the other drones.
    Places {
        /// The drone.
        from: String,
        /// A claim for each known drone.
        claims: Vec<Claim>,
    },
}

/// Starts a thread that reads the pipeline of the drone `name` once it runs. It ends when
/// `stopping` is set or the receiver is dropped.
pub(crate) fn watch(
    instance: Instance,
    name: String,
    events: Sender<SwarmEvent>,
    stopping: Arc<AtomicBool>,
) -> std::io::Result<JoinHandle<anyhow::Result<()>>> {
    let thread = std::thread::Builder::new().name(name.clone());
    thread.spawn(move || {
        let choice = PipelineChoice { instance: Some(instance.name().to_owned()) };
        let reader = loop {
            if stopping.load(Ordering::Relaxed) {
                return Ok(());
            }
            // The topics are created later than the instance, so opening is tried again.
            match instance.is_running().then(|| PipelineReader::open(&choice)) {
                Some(Ok(reader)) => break reader,
                Some(Err(_)) | None => std::thread::sleep(POLL),
            }
        };
        reader.read(&name, &events, &stopping)
    })
}

/// The subscribers of a pipeline.
struct PipelineReader {
    observer_from_camera: UnitQuaternion<f64>,
    truths: Subscriber<Truths>,
    rotations: Subscriber<Rotations>,
    tracks: Subscriber<Tracks>,
    peers: Subscriber<Peers>,
    swarms: Subscriber<Swarms>,
    // Ports are dropped after the subscribers.
    ports: Ports,
}

impl PipelineReader {
    fn open(choice: &PipelineChoice) -> anyhow::Result<Self> {
        let (_, resolved, mut ports) = attach(choice)?;
        Ok(Self {
            observer_from_camera: resolved.observer_from_camera.rotation,
            truths: ports.subscriber()?,
            rotations: ports.subscriber()?,
            tracks: ports.subscriber()?,
            peers: ports.subscriber()?,
            swarms: ports.subscriber()?,
            ports,
        })
    }

    fn read(
        self,
        name: &str,
        events: &Sender<SwarmEvent>,
        stopping: &AtomicBool,
    ) -> anyhow::Result<()> {
        let Self {
            observer_from_camera,
            mut truths,
            mut rotations,
            mut tracks,
            mut peers,
            mut swarms,
            ports,
        } = self;
        let mut alone = SwarmView::from(name);
        ports.attend(|| {
            let mut found = Vec::new();
            while let Some(message) = truths.receive()? {
                let others = message.items().iter();
                found.push(SwarmEvent::Truth {
                    from: name.to_owned(),
                    frame: message.header.stamp.sequence,
                    at_ns: message.header.stamp.exposure_ns,
                    others: others
                        .map(|body| (body.name.to_string(), isometry(&body.observer_from_target)))
                        .collect(),
                });
            }
            while let Some(message) = rotations.receive()? {
                if let Some(turn) = camera_turn(&message.header) {
                    alone.turned(&turn.in_frame(&observer_from_camera));
                }
            }
            while let Some(message) = tracks.receive()? {
                let stamp = message.header.stamp;
                found.extend(message.items().first().map(|track| SwarmEvent::PoseSent {
                    from: name.to_owned(),
                    frame: stamp.sequence,
                    sent_ns: stamp.exposure_ns + track.latency.total_ns,
                }));
                for track in message.items() {
                    if let Some(report) =
                        PeerReport::of_track(name, &stamp, stamp.exposure_ns, track)
                    {
                        alone.hear(&report);
                    }
                }
            }
            while let Some(message) = peers.receive()? {
                found.extend(message.items().first().map(|sighting| SwarmEvent::ReportArrived {
                    observer: sighting.observer.to_string(),
                    frame: sighting.frame,
                    arrived_ns: message.header.arrived_ns,
                    exposure_ns: sighting.exposure_ns,
                    deviation_ns: sighting.exposure_deviation_ns,
                }));
            }
            while let Some(message) = swarms.receive()? {
                let at_ns = message.header.at_ns;
                let claims = claims(name, at_ns, message.items(), &mut alone);
                found.push(SwarmEvent::Places { from: name.to_owned(), claims });
            }
            let is_over = stopping.load(Ordering::Relaxed)
                || found.into_iter().any(|event| events.send(event).is_err());
            Ok((!is_over).then_some(POLL))
        })
    }
}

/// A drone's claims about all others at an instant, with and without their reports.
fn claims(from: &str, at_ns: i64, poses: &[SwarmPose], alone: &mut SwarmView) -> Vec<Claim> {
    let own = alone.places(at_ns);
    let claim = |place: &SwarmPose| {
        let to = place.name.to_string();
        let a_from_b = isometry(&place.own_from_drone);
        let alone = own.iter().find(|own| own.name == to).map(|own| own.own_from_drone);
        Some(Claim {
            from: from.to_owned(),
            at_ns,
            way: SwarmWay::try_from(place.way).ok()?,
            pose: UncertainPose { a_from_b, covariance: matrix6(&place.covariance) },
            alone,
            to,
        })
    };
    poses.iter().filter_map(claim).collect()
}
