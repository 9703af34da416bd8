//! Stages that each misbehave in one way: `misbehaving-stage STAGE MISDEED`.
//!
//! | stage | misdeed | what it does |
//! | --- | --- | --- |
//! | any | `mute` | reports that it is ready, sends health, and does nothing |
//! | egomotion | `lie` | sends a rotation of ten degrees with a small covariance for each frame |
//! | rectification | `boast` | ends each frame with a count of three views, but sends none |
//! | fusion | `unplanned` | sends last tracks for each frame, but no plan except the first |
//! | simulator | `backwards` | counts its frames down, with times of another clock |
//! | inertial | `repeat` | sends each sample twice |
//!
//! Misbehaving detectors are in `silent-detector`, which is written without the runtime.

use flockeye_contract::{
    FrameEnd, FrameEnds, FrameHeader, FrameStamp, Frames, ImuHeader, ImuSample, Imus, PlanHeader,
    Plans, Rotation, RotationSource, Rotations, StageState, StopReason, TrackHeader, Tracks,
};
use flockeye_runtime::stage::StageRuntime;
use flockeye_runtime::{Step, clock};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [stage, misdeed] = arguments.as_slice() else { anyhow::bail!("which stage, and how?") };
    let mut process = StageRuntime::join(stage)?;
    let step = misdeed_of(&mut process, misdeed)?;
    process.report(StageState::Ready)?;
    process.serve(step)
}

type StepFunction = Box<dyn FnMut() -> anyhow::Result<Step>>;

fn misdeed_of(process: &mut StageRuntime, misdeed: &str) -> anyhow::Result<StepFunction> {
    let (size, ports) = (process.context.resolved.pipeline.camera.clone(), &mut process.ports);
    Ok(match misdeed {
        "mute" => Box::new(|| Ok(Step::Wait)),
        "lie" => {
            let (mut frames, rotations) = (ports.subscriber::<Frames>()?, ports.publisher()?);
            let (sin, cos) = 5_f64.to_radians().sin_cos();
            Box::new(move || {
                while let Some(frame) = frames.receive()? {
                    let stamp = frame.header.stamp;
                    let sure = [0.0; 9];
                    let lie = Rotation {
                        stamp,
                        earlier_exposure_ns: stamp.exposure_ns - 33_000_000,
                        later_from_earlier: [0.0, 0.0, sin, cos],
                        covariance: sure,
                        rate_covariance: sure,
                        source: RotationSource::Picture.code(),
                        ..Rotation::default()
                    };
                    publish::<Rotations>(&rotations, lie, &[])?;
                }
                Ok(Step::Wait)
            })
        }
        "boast" => {
            let (mut frames, ends) = (ports.subscriber::<Frames>()?, ports.publisher()?);
            Box::new(move || {
                while let Some(frame) = frames.receive()? {
                    let end = FrameEnd {
                        stamp: frame.header.stamp,
                        taken_ns: clock::monotonic_ns(),
                        ended_ns: clock::monotonic_ns(),
                        views_issued: 3,
                        reason: StopReason::Complete.code(),
                        ..FrameEnd::default()
                    };
                    publish::<FrameEnds>(&ends, end, &[])?;
                }
                Ok(Step::Wait)
            })
        }
        "unplanned" => {
            let (mut ends, tracks) = (ports.subscriber::<FrameEnds>()?, ports.publisher()?);
            let plans = ports.publisher()?;
            let first =
                PlanHeader { plan_id: 1, made_ns: clock::monotonic_ns(), ..Default::default() };
            publish::<Plans>(&plans, first, &[])?;
            Box::new(move || {
                plans.update_connections()?;
                while let Some(end) = ends.receive()? {
                    let stamp = end.header.stamp;
                    let last = TrackHeader { stamp, is_last: 1, ..TrackHeader::default() };
                    publish::<Tracks>(&tracks, last, &[])?;
                }
                Ok(Step::Wait)
            })
        }
        "backwards" => {
            let frames = ports.publisher()?;
            let pixels = vec![16; (size.width * size.height) as usize];
            let mut sequence = 1_000_000;
            Box::new(move || {
                sequence -= 1;
                let times = i64::from(sequence) * 1_000_000;
                let header = FrameHeader {
                    stamp: FrameStamp {
                        sequence: u64::from(sequence as u32),
                        exposure_ns: times,
                        stream_ns: times,
                        published_ns: times,
                        ..FrameStamp::default()
                    },
                    width: size.width,
                    height: size.height,
                    stride: size.width,
                    ..FrameHeader::default()
                };
                publish::<Frames>(&frames, header, &pixels)?;
                Ok(Step::WaitUntil(clock::monotonic_ns() + 33_000_000))
            })
        }
        "repeat" => {
            let imus = ports.publisher()?;
            Box::new(move || {
                let at_ns = clock::monotonic_ns();
                let sample =
                    ImuSample { at_ns, specific_force: [0.0, 0.0, 9.8], ..ImuSample::default() };
                for _ in 0..2 {
                    publish::<Imus>(
                        &imus,
                        ImuHeader { sent_ns: at_ns, ..ImuHeader::default() },
                        &[sample],
                    )?;
                }
                Ok(Step::WaitUntil(at_ns + 5_000_000))
            })
        }
        other => anyhow::bail!("there is no misdeed '{other}'"),
    })
}

fn publish<T: flockeye_contract::Topic>(
    publisher: &flockeye_runtime::ports::Publisher<T>,
    header: T::Header,
    items: &[T::Item],
) -> anyhow::Result<()> {
    Ok(publisher.send(header, items)?)
}
