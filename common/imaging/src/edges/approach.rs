//! Moves the sides of a guessed marker to the steepest fall of radiance.

use flockeye_geometry::view::ViewPixel;

use super::line::{EdgeLine, cross};
use super::side::SideFrame;
use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::square::mean_side_px;

/// Moves each side of a black square to where the radiance falls most steeply within 2 px of it, in
/// steps of a quarter of a pixel.
///
/// The result is precise enough to read a marker whose contour was found. Only the number of cells
/// along a side is needed, border included. It also brings a guess within reach of
/// [`super::refine_corners`]. The border's *inner* edge, where the radiance rises, cannot be taken
/// for the outer one.
///
/// `None` where the sides lie outside the image or no longer cross.
pub fn approach_corners(
    image: &LumaImage<'_>,
    light: &LinearLight,
    guess_in_view: &[ViewPixel; 4],
    cells: usize,
) -> Option<[ViewPixel; 4]> {
    const SEARCH_PX: f64 = 2.0;
    const STEP_PX: f64 = 0.25;
    let cell = mean_side_px(guess_in_view) / cells as f64;
    let window = (0.5 * cell).clamp(1.0, 3.0);
    let width = (window / STEP_PX).round() as usize;
    let search = (SEARCH_PX / STEP_PX) as usize;
    // Radiance at each step of depth, from `search + width` steps outside the guess to as many
    // inside.
    let mut values = vec![0.0f32; 2 * (search + width) + 1];
    let mut moved = Vec::with_capacity(4);
    for k in 0..4 {
        let frame = SideFrame::of(guess_in_view, k);
        let SideFrame { along, inward, middle, half } = frame;
        values.fill(0.0);
        for place in -2..=2 {
            let base = middle + along * (half * 0.25 * f64::from(place));
            let outermost = base - inward * ((search + width) as f64 * STEP_PX);
            for (step, value) in values.iter_mut().enumerate() {
                let at = ViewPixel(outermost + inward * (step as f64 * STEP_PX));
                // Positions outside the image are NaN, and sums with a NaN are ignored below.
                *value += light.at(image, at).unwrap_or(f32::NAN);
            }
        }
        let falls = |at: usize| {
            let outside: f32 = values[at..at + width].iter().sum();
            let inside: f32 = values[at + width + 1..at + 2 * width + 1].iter().sum();
            outside - inside
        };
        let steepest = (0..=2 * search)
            .map(|at| (at, falls(at)))
            .filter(|(_, fall)| fall.is_finite())
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        let line = EdgeLine::parallel((steepest.0 as f64 - search as f64) * STEP_PX);
        moved.push((frame, line));
    }
    let corner = |k: usize| {
        let ((before, before_line), (side, line)) = (&moved[(k + 3) % 4], &moved[k]);
        cross((before, before_line), (side, line)).map(|corner| corner.0)
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}
