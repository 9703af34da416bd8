//! Templates of the body in all attitudes, as seen from far away.

use std::ops::Range;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};

use super::canvas::{BLUR_CELLS, Size};
use crate::align::model::Scene;
use crate::align::patch::smoothed;
use crate::align::pinhole::Pinhole;
use crate::align::print::BodyPrint;
use crate::align::state::{BLACK_SHARE_PRIOR, Prior, State};

/// Number of directions from which the body is modelled: 13 degrees apart.
const DIRECTIONS: usize = 240;
/// Range at which a body is modelled, metres. At other ranges it looks nearly the same.
const RANGE_M: f64 = 3.0;
/// Most cells from the middle of a body to its rim. A larger body is searched with coarser pixels,
/// because time and memory grow with their fourth power.
const MAX_RADIUS_CELLS: f64 = 16.0;
/// Least coverage of a pixel by the body: below, too much of the background shows.
const MIN_COVERED: f32 = 0.85;
/// Approximate number of samples of a template: more cost time and improve little.
const SAMPLES: usize = 130;
/// Least samples of a facet: fewer contain too little information.
const MIN_FACET_SAMPLES: usize = 3;
/// Least standard deviation of a facet's pattern; white is 1.
const MIN_PATTERN: f32 = 0.05;
/// White of an overexposed template, as a multiple of the sensor's saturation. Bodies overexposed
/// by 3 stops were found best with 2.5, of 1.5, 2.5 and 4.
const OVEREXPOSED: f32 = 2.5;
/// Blur before the sensor saturates, cells: that of the lens on a body at 2 to 3 m.
const LENS_BLUR_CELLS: f64 = 0.6;

/// Templates for the comparison with pictures of places.
#[derive(Debug, Clone)]
pub struct Templates {
    pub(super) plain: Vec<Template>,
    pub(super) overexposed: Vec<Template>,
    /// Size of the canonical pictures.
    pub(super) size: Size,
}

/// The body in one attitude, as seen along the line of sight.
#[derive(Debug, Clone)]
pub(super) struct Template {
    /// The attitude, in a frame whose z axis is the line of sight.
    pub sight_from_markers: UnitQuaternion<f64>,
    pub samples: Vec<TemplatePixel>,
    /// Samples of each facet, weighted by the number of pixels that each represents.
    pub facets: Vec<(Range<usize>, f32)>,
}

/// A pixel of a template.
#[derive(Debug, Clone, Copy)]
pub(super) struct TemplatePixel {
    /// Its place in an unshifted canonical picture, and in one whose columns are parted.
    pub at: u32,
    pub at_parted: u32,
    /// Radiance less the mean of its facet's samples, whose squares sum up to 1.
    pub pattern: f32,
}

impl Templates {
    /// Models a body in all attitudes. That takes some tenths of a second.
    pub fn new(print: &BodyPrint) -> Self {
        let cell_m = print.smallest_cell_m().max(print.radius_m() / MAX_RADIUS_CELLS);
        if !cell_m.is_finite() {
            let size = Size::of(0, 1.0);
            return Self { plain: Vec::new(), overexposed: Vec::new(), size };
        }
        let size = Size::of((print.radius_m() / cell_m).ceil() as usize, cell_m);
        let of = |white| {
            let template = |direction| Template::new(print, &direction, &size, white);
            directions(DIRECTIONS).filter_map(template).collect()
        };
        Self { plain: of(1.0), overexposed: of(OVEREXPOSED), size }
    }
}

impl Template {
    /// The body seen from `direction` (in its markers' frame), with its white at `white` times the
    /// saturation. `None` where no pattern is visible.
    fn new(print: &BodyPrint, direction: &Vector3<f64>, size: &Size, white: f32) -> Option<Self> {
        let about_x = || UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        // The camera looks along +z at the facets that face it.
        let sight_from_markers =
            UnitQuaternion::rotation_between(direction, &-Vector3::z()).unwrap_or_else(about_x);
        let (radiance, covering) = pixels(print, &sight_from_markers, size, white);
        let shown = covering.iter().flatten().count();
        let step = shown.div_ceil(SAMPLES).max(1);
        let (mut samples, mut facets) = (Vec::new(), Vec::new());
        for facet in 0..print.facets.len() {
            let own = (0..covering.len()).filter(|&k| covering[k] == Some(facet));
            let own: Vec<usize> = own.step_by(step).collect();
            let count = own.len() as f32;
            let mean = own.iter().map(|&k| radiance[k]).sum::<f32>() / count;
            let squares: f32 = own.iter().map(|&k| (radiance[k] - mean).powi(2)).sum();
            if own.len() < MIN_FACET_SAMPLES || squares < MIN_PATTERN.powi(2) * count {
                continue;
            }
            let first = samples.len();
            samples.extend(own.iter().map(|&k| {
                let [at, at_parted] =
                    size.places(k % size.template_side(), k / size.template_side());
                let pattern = (radiance[k] - mean) / squares.sqrt();
                TemplatePixel { at, at_parted, pattern }
            }));
            facets.push((first..samples.len(), count * step as f32));
        }
        (!facets.is_empty()).then_some(Self { sight_from_markers, samples, facets })
    }
}

/// The radiance of a template's pixels, white being 1, and the facet that covers most of each;
/// `None` where the body covers too little of it.
fn pixels(
    print: &BodyPrint,
    sight_from_markers: &UnitQuaternion<f64>,
    size: &Size,
    white: f32,
) -> (Vec<f32>, Vec<Option<usize>>) {
    let Size { radius, cell_m, .. } = *size;
    let pinhole = Pinhole { focal_px: RANGE_M / cell_m, centre_px: Vector2::repeat(radius as f64) };
    let saturates = white > 1.0;
    let blur = if saturates { LENS_BLUR_CELLS } else { BLUR_CELLS };
    let position = Translation3::new(0.0, 0.0, RANGE_M);
    let pose = Isometry3::from_parts(position, *sight_from_markers);
    let state = State::new(print, pose, &Prior::new(blur, Vector2::zeros(), None, 1.0));
    let scene = Scene::of(print, &state, &pinhole, 0.0, 0.0);
    let side = size.template_side();
    let (mut radiance, mut facets) = (Vec::new(), Vec::new());
    for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
        let direction = pinhole.direction(Vector2::new(x as f64, y as f64));
        let (mut covered, mut black, mut most) = (0.0, 0.0, (0.0, 0));
        for facet in 0..print.facets.len() {
            let Some((visible, blurred)) = scene.facet(0, facet) else { continue };
            let at = visible.point(&direction);
            let coverage = blurred.coverage(at).value;
            if coverage > 0.0 {
                covered += coverage;
                black += blurred.black(at).value;
            }
            if coverage > most.0 {
                most = (coverage, facet);
            }
        }
        radiance.push((white * (1.0 - (1.0 - BLACK_SHARE_PRIOR.0 as f32) * black)).min(1.0));
        facets.push((covered >= MIN_COVERED).then_some(most.1));
    }
    if saturates {
        // The sensor saturates after the lens's blur and before that of the search.
        let missing = (BLUR_CELLS.powi(2) - LENS_BLUR_CELLS.powi(2)).sqrt();
        radiance = smoothed(&radiance, side, side, missing);
    }
    (radiance, facets)
}

/// Evenly distributed directions on the sphere: a Fibonacci lattice.
pub(super) fn directions(count: usize) -> impl Iterator<Item = Vector3<f64>> {
    let golden_rad = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count).map(move |k| {
        let z = 1.0 - (2 * k + 1) as f64 / count as f64;
        let (sin, cos) = (k as f64 * golden_rad).sin_cos();
        let across = (1.0 - z * z).sqrt();
        Vector3::new(across * cos, across * sin, z)
    })
}
