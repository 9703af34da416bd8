//! Test of an egomotion stage: a textured world around a camera that the test rotates.

use std::time::Duration;

use flockeye_config::Resolved;
use flockeye_contract::{
    FrameHeader, FrameStamp, Frames, Rotation, RotationSource, Rotations, Transfer,
};
use flockeye_convert::camera_turn;
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Publisher, Subscriber};
use nalgebra::{UnitQuaternion, Vector3};

use super::bench::Bench;
use super::pictures;
use super::report::MUST_PASS;

const PAGE: &str = "Egomotion (frame and imu to rotation)";

/// Frames of the textured world.
const FRAMES: u32 = 16;
/// Number of consecutive blank frames.
const BLANK: u32 = 4;
/// Time between two exposures.
const PERIOD_NS: i64 = 33_000_000;
/// Timeout for an answer.
const PATIENCE: Duration = Duration::from_secs(3);
/// Largest error of a rotation that still belongs to the frame, degrees.
const FAR_OFF_DEG: f64 = 1.0;
/// Least share of known rotations in the textured world.
const LEAST_KNOWN: f64 = 0.8;
/// Largest median of the normalised squared error for a valid covariance; 2.4 is expected.
const MOST_NORMALIZED: f64 = 40.0;

struct Script {
    /// A frame without its stamp.
    shape: FrameHeader,
    frames: Publisher<Frames>,
    rotations: Subscriber<Rotations>,
    sequence: u64,
    exposure_ns: i64,
}

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let mut script = Script {
        shape: pictures::frame_shape(resolved, Transfer::Srgb)?,
        frames: bench.ports.publisher()?,
        rotations: bench.ports.subscriber()?,
        sequence: 0,
        // Exposures are in the past, so that no frame is sent before its exposure.
        exposure_ns: clock::monotonic_ns() - 2_000_000_000,
    };
    script.turns(bench)?;
    script.blank(bench)?;
    script.malformed(bench)?;
    bench.pass(Duration::from_millis(800))?;
    Ok(())
}

impl Script {
    /// The header of the next frame, which is sent immediately.
    fn frame(&mut self) -> FrameHeader {
        self.sequence += 1;
        self.exposure_ns += PERIOD_NS;
        FrameHeader {
            stamp: FrameStamp {
                sequence: self.sequence,
                exposure_ns: self.exposure_ns,
                stream_ns: self.exposure_ns,
                published_ns: clock::monotonic_ns(),
                ..FrameStamp::default()
            },
            ..self.shape
        }
    }

    /// Sends a frame, and returns the answer to it.
    fn asked(
        &mut self,
        bench: &mut Bench,
        frame: &FrameHeader,
        pixels: &[u8],
    ) -> anyhow::Result<Option<Rotation>> {
        self.frames.send(*frame, pixels)?;
        let what = "rotations pass the contract's check";
        let answer = bench.next(&mut self.rotations, what, PATIENCE)?;
        let number = frame.stamp.sequence;
        bench.report.holds("one rotation for each frame", PAGE, answer.is_some(), || {
            format!("frame {number} got none in {} s", PATIENCE.as_secs())
        });
        let Some((rotation, _)) = answer else { return Ok(None) };
        bench.report.field("the stamp is the frame's", PAGE, "stamp", rotation.stamp, frame.stamp);
        bench.report.field(
            "rotations say whose they are",
            PAGE,
            "generation",
            rotation.generation,
            0,
        );
        Ok(Some(rotation))
    }

    /// Test with the textured world.
    fn turns(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let attitudes = attitudes();
        // All pictures are drawn first, because frames are sent at a camera's rate.
        let mut pictures = Vec::new();
        for attitude in &attitudes {
            pictures.push(pictures::textured_world(&self.shape, attitude));
            // Health is received meanwhile.
            bench.pass(Duration::ZERO)?;
        }
        let mut before: Option<(FrameStamp, UnitQuaternion<f64>)> = None;
        let (mut errors_deg, mut normalized, mut times_ms) = (Vec::new(), Vec::new(), Vec::new());
        for (pixels, world_from_camera) in pictures.iter().zip(attitudes) {
            let frame = self.frame();
            let Some(rotation) = self.asked(bench, &frame, pixels)? else { return Ok(()) };
            times_ms.push((clock::monotonic_ns() - frame.stamp.published_ns) as f64 * 1e-6);
            let turn = camera_turn(&rotation);
            let Some((before, was)) = before.replace((frame.stamp, world_from_camera)) else {
                bench.report.holds(
                    "nothing is known of the first frame",
                    PAGE,
                    turn.is_none(),
                    || format!("source is {}, and there is no frame before it", rotation.source),
                );
                continue;
            };
            let Some(turn) = turn else { continue };
            bench.report.field(
                "rotations are since the frame before",
                PAGE,
                "earlier_exposure_ns",
                rotation.earlier_exposure_ns,
                before.exposure_ns,
            );
            let later_from_earlier = world_from_camera.inverse() * was;
            let off = (turn.later_from_earlier * later_from_earlier.inverse()).scaled_axis();
            let off_deg = off.norm().to_degrees();
            bench.report.holds("rotations are right", PAGE, off_deg < FAR_OFF_DEG, || {
                format!(
                    "later_from_earlier of frame {} is {off_deg:.2} degrees off",
                    frame.stamp.sequence
                )
            });
            errors_deg.push(off_deg);
            // A covariance of zero makes any error infinite.
            let inverse =
                turn.covariance.try_inverse().filter(|inverse| inverse[(0, 0)].is_finite());
            normalized.push(inverse.map_or(f64::INFINITY, |inverse| off.dot(&(inverse * off))));
        }
        let known = errors_deg.len() as f64 / f64::from(FRAMES - 1);
        bench.report.holds(
            "rotations of a textured world are known",
            PAGE,
            known >= LEAST_KNOWN,
            || {
                format!(
                    "source is 0 for {} of {} frames",
                    FRAMES - 1 - errors_deg.len() as u32,
                    FRAMES - 1
                )
            },
        );
        bench.report.figure("rotations known", 100.0 * known, "%");
        bench.report.median("error, median", errors_deg, "degrees");
        let what = "squared error against the covariance, median";
        let typical = bench.report.median(what, normalized, "(2.4 is right)");
        // The check of known rotations above reports missing ones.
        bench.report.holds("the covariance is honest", PAGE, typical.is_nan() || typical < MOST_NORMALIZED, || {
            format!(
                "squared errors are {typical:.0} times the covariance in the median; 2.4 is right"
            )
        });
        bench.report.median("time for a frame, median", times_ms, "ms");
        Ok(())
    }

    /// Test with blank pictures.
    fn blank(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        for number in 0..BLANK {
            let frame = self.frame();
            let pixels = vec![16; (frame.stride * frame.height) as usize];
            let Some(rotation) = self.asked(bench, &frame, &pixels)? else { return Ok(()) };
            // The first blank frame has a textured predecessor, so it is skipped.
            if number > 0 {
                let source = rotation.source;
                let is_known = source != RotationSource::Nothing.code();
                bench.report.holds("nothing is known of a blank picture", PAGE, !is_known, || {
                    format!("source is {source} where every pixel is the same")
                });
            }
        }
        Ok(())
    }

    /// Malformed frames must not affect later ones.
    fn malformed(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let good = self.frame();
        for bad in [
            FrameHeader { width: 0, ..self.frame() },
            FrameHeader { stride: good.width / 2, ..self.frame() },
            FrameHeader { height: good.height * 2, ..self.frame() },
            FrameHeader { projection: 77, ..self.frame() },
        ] {
            let pixels = vec![16; (good.stride * good.height) as usize];
            self.frames.send(bad, &pixels)?;
            bench.pass(Duration::from_millis(50))?;
        }
        let pixels = pictures::textured_world(&self.shape, &UnitQuaternion::identity());
        let frame = self.frame();
        self.frames.send(frame, &pixels)?;
        let what = "rotations pass the contract's check";
        let mut answered = false;
        while let Some((rotation, _)) = bench.next(&mut self.rotations, what, PATIENCE)? {
            answered = rotation.stamp == frame.stamp;
            if answered {
                break;
            }
        }
        bench.report.holds("malformed frames cost nothing else", MUST_PASS, answered, || {
            format!("the good frame {} after them got no rotation", frame.stamp.sequence)
        });
        Ok(())
    }
}

/// The camera's attitudes in the world, frame by frame. It turns by up to 2 degrees per frame about
/// each axis, and smoothly as a drone does.
fn attitudes() -> Vec<UnitQuaternion<f64>> {
    let mut attitude = UnitQuaternion::identity();
    (0..FRAMES)
        .map(|number| {
            let swing = |step: f64| (std::f64::consts::TAU * f64::from(number) * step).sin();
            let axis = Vector3::new(swing(0.061_803), swing(0.041_421), swing(0.030_278));
            attitude *= UnitQuaternion::from_scaled_axis(axis * 0.035);
            attitude
        })
        .collect()
}
