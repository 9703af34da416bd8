//! A simulated flight outside of a pipeline: every frame in order, as fast as it can be drawn.

use std::path::Path;

use anyhow::Context as _;
use flockeye_config::{Flow, Resolved};

use crate::core::{Action, Core, PictureMessages};
use crate::settings::world;

/// Draws the frames of `simulator.frames` one after the other. `take` is called with each frame's
/// luma plane, rows without gaps, and its messages, until it returns `false`. The painted panorama
/// is kept in `paint_folder` for the next flight.
///
/// # Errors
/// An invalid world, a flight without end or in real time, a frame that cannot be drawn, or an
/// error of `take`.
pub fn draw_flight(
    resolved: &Resolved,
    paint_folder: &Path,
    mut take: impl FnMut(&[u8], &PictureMessages) -> anyhow::Result<bool>,
) -> anyhow::Result<()> {
    let pipeline = &resolved.pipeline;
    anyhow::ensure!(
        pipeline.simulator.frames > 0,
        "simulator.frames is 0: the flight has no end. Cure: --set simulator.frames=300"
    );
    anyhow::ensure!(
        pipeline.flow() == Flow::Lossless,
        "in the profile flight frames are drawn in real time. Cure: --profile repeat"
    );
    let (mut world, flying) = world(resolved, paint_folder)?;
    let mut core = Core::new(resolved, &world, flying.as_ref(), 0);
    let (width, height) = core.size_px();
    let mut luma = vec![0; width as usize * height as usize];
    while let Action::Draw(frame) = core.step(0) {
        let truth = world
            .render(frame, &mut luma, width as usize)
            .with_context(|| format!("frame {frame}"))?;
        if !take(&luma, &core.messages(&truth, None, 0))? {
            break;
        }
    }
    Ok(())
}
