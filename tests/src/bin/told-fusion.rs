//! A fusion without input: it sends poses of the named neighbours. `told-fusion PERIOD_MS NAME...`
//!
//! With it a gateway runs without a camera, so that many gateways fit on one machine.

use std::time::Instant;

use anyhow::Context;
use flockeye_contract::{
    FrameStamp, MeasuredBy, Pose, StageState, Track, TrackHeader, TrackState, Tracks,
};
use flockeye_runtime::ports::Publisher;
use flockeye_runtime::stage::StageRuntime;
use flockeye_runtime::{Step, clock};

/// Age of a pose when it is sent, nanoseconds.
const LATENCY_NS: i64 = 20_000_000;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let period_ms: i64 = arguments.next().context("how often?")?.parse()?;
    let names: Vec<String> = arguments.collect();
    let mut process = StageRuntime::join("fusion")?;
    let tracks: Publisher<Tracks> = process.ports.publisher()?;
    let (begun, mut sequence, mut due_ns) = (Instant::now(), 0, clock::monotonic_ns());
    process.report(StageState::Ready)?;
    process.serve(move || {
        let now_ns = clock::monotonic_ns();
        if now_ns >= due_ns {
            due_ns = (due_ns + 1_000_000 * period_ms).max(now_ns);
            sequence += 1;
            let stamp = FrameStamp {
                sequence,
                exposure_ns: now_ns - LATENCY_NS,
                stream_ns: begun.elapsed().as_nanos() as i64,
                ..FrameStamp::default()
            };
            let told: Vec<Track> =
                names.iter().enumerate().map(|(k, name)| track(k, name)).collect();
            let header = TrackHeader { stamp, is_last: 1, ..TrackHeader::default() };
            tracks.send(header, &told)?;
        }
        Ok(Step::WaitUntil(due_ns))
    })
}

/// A neighbour that stands still, a metre or more ahead.
fn track(target: usize, name: &str) -> Track {
    let mut covariance = [0.0; 36];
    (0..6).for_each(|k| covariance[7 * k] = 1e-6);
    let pose = Pose { position: [1.0 + target as f64, 0.0, 0.0], ..Pose::default() };
    Track {
        observer_from_target: pose,
        covariance,
        measured_observer_from_target: pose,
        measured_covariance: covariance,
        predicted_observer_from_target: pose,
        predicted_covariance: covariance,
        predicted_ns: clock::monotonic_ns(),
        name: name.into(),
        target: target as u32,
        track_id: 1,
        state: TrackState::Confirmed.code(),
        measured_by: MeasuredBy::Decoded.code(),
        markers: 2,
        ..bytemuck::Zeroable::zeroed()
    }
}
