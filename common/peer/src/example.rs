//! A drone for the example in the crate's documentation.

use std::collections::BTreeMap;
use std::net::TcpListener;

use flockeye_contract::wire::{FRAME_SCHEMA, FrameReport, Measurement, TargetReport};
use flockeye_contract::{MeasuredBy, TrackState};
use flockeye_network::{Network, NetworkError, NetworkParameters, Reporter, utc_from_monotonic};

/// A drone that sees another one.
#[derive(Debug)]
pub struct Drone {
    /// Where it listens.
    pub endpoint: String,
    reporter: Reporter,
}

/// The drone wren, on a port of the loopback interface that nobody has.
///
/// # Errors
/// No port or no session can be had.
pub fn drone() -> Result<Drone, Box<dyn std::error::Error>> {
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let network = Network::open(&NetworkParameters {
        observer: "wren".into(),
        listen: vec![endpoint.clone()],
        ..NetworkParameters::default()
    })?;
    Ok(Drone { endpoint, reporter: network.reporter()? })
}

impl Drone {
    /// Reports where it sees kite now; whoever joins later is told so too.
    ///
    /// # Errors
    /// The report cannot be sent.
    pub fn report(&self) -> Result<(), NetworkError> {
        let (stamp_utc_ns, clock_synchronised) =
            utc_from_monotonic(flockeye_network::monotonic_now_ns());
        let (position, orientation) = ([1.5, 0.2, 0.1], [0.0, 0.0, 0.0, 1.0]);
        let mut covariance = [0.0; 21];
        [0, 6, 11, 15, 18, 20].into_iter().for_each(|k| covariance[k] = 1e-5);
        self.reporter.report_frame(FrameReport {
            schema: FRAME_SCHEMA.into(),
            observer: "wren".into(),
            frame: 1,
            epoch: 0,
            stamp_utc_ns,
            clock_synchronised,
            stream_s: 0.0,
            latency_ms: 0.0,
            odometry: None,
            clocks: BTreeMap::new(),
            targets: vec![TargetReport {
                name: "kite".into(),
                state: TrackState::Confirmed,
                measured_by: MeasuredBy::Aligned,
                markers: 3,
                unseen_s: 0.0,
                position,
                orientation,
                covariance,
                linear_velocity: [0.0; 3],
                angular_velocity: [0.0; 3],
                measured: Some(Measurement { position, orientation, covariance }),
                predicted: None,
                degenerate: None,
            }],
        })
    }
}
