//! A camera with irregular frames and a clock that jumps, for `stages.simulator.command`. It shows
//! the simulated world, with times of frames from [`exposure`].

use std::process::ExitCode;

use flockeye_contract::{FrameHeader, FrameStamp, Frames, PixelFormat, Range, Transfer};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::Bodies;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};
use flockeye_simulator::{World, WorldParameters};

/// Number of frames.
const FRAMES: u64 = 150;

struct Erratic {
    frames: Publisher<Frames>,
    world: World,
    next: u64,
    due_ns: i64,
    generation: u32,
}

/// Milliseconds to the next frame, and error of the camera's clock, seconds.
fn exposure(frame: u64) -> (i64, i64) {
    match frame {
        0..40 => (33, 0),
        // Pairs of frames with long pauses.
        40..60 => ([2, 150][frame as usize % 2], 0),
        // The clock jumps back, later ahead, and stays there.
        60..100 => (33, -3),
        _ => (33, 40),
    }
}

impl Stage for Erratic {
    const NAME: &'static str = "simulator";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = &context.resolved;
        let all = resolved.simulated_bodies()?;
        let one = all.iter().take(1).cloned().collect();
        let bodies = Bodies::new(all.dictionary.clone(), one)?;
        let parameters = WorldParameters {
            camera: resolved.camera,
            distance_m: resolved.pipeline.simulator.distance_m,
            ..WorldParameters::default()
        };
        Ok(Self {
            frames: ports.publisher()?,
            world: World::new(parameters, &bodies, &Dictionary::of(&bodies)?)?,
            next: 0,
            due_ns: clock::monotonic_ns(),
            generation: context.identity.generation,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if self.next == FRAMES {
            return Ok(Step::Finished);
        }
        let now_ns = clock::monotonic_ns();
        if now_ns < self.due_ns {
            return Ok(Step::WaitUntil(self.due_ns));
        }
        let (pause_ms, off_s) = exposure(self.next);
        let camera = self.world.parameters().camera;
        let (width, height) = (camera.width(), camera.height());
        let mut loan = self.frames.loan(width as usize * height as usize)?;
        self.world.render(self.next, loan.items_mut(), width as usize)?;
        let header = FrameHeader {
            stamp: FrameStamp {
                sequence: self.next,
                exposure_ns: now_ns + off_s * 1_000_000_000,
                stream_ns: now_ns,
                published_ns: clock::monotonic_ns(),
                epoch: 0,
                source_generation: self.generation,
            },
            width,
            height,
            stride: width,
            pixel_format: PixelFormat::Gray8.code(),
            transfer: Transfer::Srgb.code(),
            range: Range::Full.code(),
            ..FrameHeader::default()
        };
        self.frames.send_loan(loan, header)?;
        self.next += 1;
        self.due_ns = now_ns + pause_ms * 1_000_000;
        Ok(Step::WaitUntil(self.due_ns))
    }
}

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<Erratic>()
}
