//! Drawing of frames ahead of their time, in a separate thread.
//!
//! A camera's picture is available when its exposure ends, at any processor load. Drawing takes
//! most of a frame period. So frames are drawn ahead, and a slow one delays no other.

use std::io;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use flockeye_runtime::clock;

use crate::schedule::{ExposureSchedule, Times};
use crate::{FrameTruth, World};

/// Number of picture buffers: being drawn, or waiting.
const PICTURES: usize = 3;

/// Target for the lead of a drawn picture, frames.
const FRAMES_AHEAD: u64 = 2;

/// Timeout of one wait for a picture.
const PATIENCE: Duration = Duration::from_millis(50);

#[derive(Debug)]
pub(crate) struct DrawnFrame {
    /// Luma plane, rows without gaps.
    pub luma: Vec<u8>,
    /// Truth of the frame.
    pub truth: FrameTruth,
    /// Times of exposure and publication.
    pub times: Times,
    /// Number of frames dropped before this one.
    pub skipped: u64,
    /// Drawing time, nanoseconds.
    pub took_ns: i64,
}

/// Handle of the drawing thread.
#[derive(Debug)]
pub(crate) struct AheadDrawer {
    blank: SyncSender<Vec<u8>>,
    drawn: Receiver<anyhow::Result<DrawnFrame>>,
    /// Thread; its result is the number of frames dropped at the end.
    thread: Option<JoinHandle<u64>>,
    picture_bytes: usize,
    has_begun: bool,
}

/// Outcome of the wait for the next frame.
#[derive(Debug)]
pub(crate) enum DrawOutcome {
    Frame(Box<DrawnFrame>),
    /// Timeout: the frame is not drawn yet.
    NotYet,
    /// End: no further frame follows.
    Over {
        /// Number of frames dropped at the end.
        skipped: u64,
    },
}

impl AheadDrawer {
    /// Draws the frames of `world` up to `last_frame`. Drawing begins with the first
    /// [`Self::take`]. The first frame takes longest; the schedule starts when it is ready.
    pub(crate) fn start(world: World, last_frame: u64) -> io::Result<Self> {
        let camera = world.parameters().camera;
        let picture_bytes = camera.width() as usize * camera.height() as usize;
        let (blank, blanks) = sync_channel(PICTURES);
        let (tell, drawn) = sync_channel(PICTURES);
        let thread = Builder::new()
            .name("drawing".to_owned())
            .spawn(move || draw_all(world, last_frame, &blanks, &tell))?;
        Ok(Self { blank, drawn, thread: Some(thread), picture_bytes, has_begun: false })
    }

    /// Waits for the next frame, up to [`PATIENCE`].
    pub(crate) fn take(&mut self) -> anyhow::Result<DrawOutcome> {
        if !self.has_begun {
            self.has_begun = true;
            (0..PICTURES).for_each(|_| self.reuse(vec![0; self.picture_bytes]));
        }
        match self.drawn.recv_timeout(PATIENCE) {
            Ok(drawn) => Ok(DrawOutcome::Frame(Box::new(drawn?))),
            Err(RecvTimeoutError::Timeout) => Ok(DrawOutcome::NotYet),
            Err(RecvTimeoutError::Disconnected) => {
                let skipped = self.thread.take().map_or(Ok(0), JoinHandle::join);
                let skipped = skipped.map_err(|_| {
                    anyhow!("the thread that draws has ended; its panic is in the log before")
                })?;
                Ok(DrawOutcome::Over { skipped })
            }
        }
    }

    /// Returns a picture's memory for reuse.
    pub(crate) fn reuse(&self, luma: Vec<u8>) {
        // The channel has room for all pictures. An error means that the thread has ended, which is
        // harmless.
        let _ = self.blank.try_send(luma);
    }
}

/// Body of the drawing thread. Returns the number of frames dropped at the end.
fn draw_all(
    mut world: World,
    last_frame: u64,
    blanks: &Receiver<Vec<u8>>,
    tell: &SyncSender<anyhow::Result<DrawnFrame>>,
) -> u64 {
    let width = world.parameters().camera.width() as usize;
    let frames_per_second = world.parameters().frames_per_second;
    let half_exposure_ns = (world.parameters().exposure_s * 0.5e9).round() as i64;
    // In a swarm, the schedule follows the swarm's time. Otherwise it starts when the first frame
    // is ready.
    let mut schedule = world.parameters().swarm.map(|swarm| {
        let start_ns = swarm.start_ns + (world.parameters().time_of(0) * 1e9).round() as i64;
        let now_ns = clock::monotonic_ns();
        ExposureSchedule::joining(start_ns, frames_per_second, half_exposure_ns, now_ns)
    });
    while let Ok(mut luma) = blanks.recv() {
        if let Some(schedule) = &schedule {
            let begin_ns = schedule.begin_ns(FRAMES_AHEAD);
            std::thread::sleep(clock::until(begin_ns, clock::monotonic_ns()));
        }
        let begun_ns = clock::monotonic_ns();
        let (frame, skipped) = schedule.as_mut().map_or((0, 0), |schedule| schedule.draw(begun_ns));
        if frame > last_frame {
            return last_frame + 1 - (frame - skipped);
        }
        let truth = world.render(frame, &mut luma, width);
        let truth = truth.with_context(|| format!("frame {frame}"));
        let drawn_ns = clock::monotonic_ns();
        let schedule = schedule.get_or_insert_with(|| {
            ExposureSchedule::new(drawn_ns - half_exposure_ns, frames_per_second, half_exposure_ns)
        });
        let took_ns = drawn_ns - begun_ns;
        schedule.drew(took_ns);
        let times = schedule.times(frame);
        let drawn = truth.map(|truth| DrawnFrame { luma, truth, times, skipped, took_ns });
        let is_over = drawn.is_err();
        if tell.send(drawn).is_err() || is_over {
            break;
        }
    }
    0
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::WorldParameters;
    use flockeye_geometry::camera::Camera;
    use std::time::Instant;

    fn world(frames_per_second: f64) -> World {
        let camera = Camera::equirectangular(256, 128);
        World::empty(WorldParameters { camera, frames_per_second, ..Default::default() }).unwrap()
    }

    /// The next frame, or how many were left out at the end.
    fn next(ahead: &mut AheadDrawer) -> Result<DrawnFrame, u64> {
        let until = Instant::now() + Duration::from_secs(60);
        loop {
            match ahead.take().expect("frames can be drawn") {
                DrawOutcome::Frame(drawn) => return Ok(*drawn),
                DrawOutcome::Over { skipped } => return Err(skipped),
                DrawOutcome::NotYet => assert!(Instant::now() < until, "it is never drawn"),
            }
        }
    }

    #[test]
    fn frames_are_drawn_in_order_and_as_they_are_without_the_thread() {
        let rate = 20.0;
        let mut ahead = AheadDrawer::start(world(rate), 5).unwrap();
        let mut again = world(rate);
        let (mut drawn_or_left_out, mut luma) = (0, vec![0; 256 * 128]);
        let at_the_end = loop {
            let drawn = match next(&mut ahead) {
                Ok(drawn) => drawn,
                Err(at_the_end) => break at_the_end,
            };
            // On a machine that is very busy some are left out, and counted.
            assert_eq!(drawn.truth.frame, drawn_or_left_out + drawn.skipped);
            let truth = again.render(drawn.truth.frame, &mut luma, 256).unwrap();
            assert!(drawn.luma == luma && drawn.truth == truth, "frame {}", drawn.truth.frame);
            let period_ns = drawn.times.next_ns - drawn.times.handover_ns;
            assert!((period_ns - 50_000_000).abs() <= 1, "{period_ns} ns");
            drawn_or_left_out = drawn.truth.frame + 1;
            ahead.reuse(drawn.luma);
        };
        assert_eq!(drawn_or_left_out + at_the_end, 6);
    }

    #[test]
    fn frames_left_out_at_the_end_are_counted() {
        let mut ahead = AheadDrawer::start(world(100.0), 9).unwrap();
        let held: Vec<DrawnFrame> = (0..PICTURES).filter_map(|_| next(&mut ahead).ok()).collect();
        std::thread::sleep(Duration::from_millis(200));
        let last = held.last().unwrap().truth.frame;
        held.into_iter().for_each(|drawn| ahead.reuse(drawn.luma));
        assert_eq!(next(&mut ahead).map(|drawn| drawn.truth.frame), Err(9 - last));
    }

    #[test]
    fn no_more_are_drawn_than_there_are_pictures() {
        let mut ahead = AheadDrawer::start(world(100.0), u64::MAX).unwrap();
        let held: Vec<DrawnFrame> = (0..PICTURES).filter_map(|_| next(&mut ahead).ok()).collect();
        assert_eq!(held.len(), PICTURES);
        assert!(matches!(ahead.take(), Ok(DrawOutcome::NotYet)), "there is nothing to draw in");
        held.into_iter().for_each(|drawn| ahead.reuse(drawn.luma));
        assert!(next(&mut ahead).unwrap().skipped > 0, "their times have passed");
    }
}
