//! The pixels of a patch to which a body is fitted.

use std::ops::Range;

use super::model::Scene;
use super::model::blurred::BlurredFacet;
use super::model::geometry::VisibleFacet;
use super::patch::Patch;
use super::print::{BodyPrint, PrintedFacet};
use nalgebra::{Matrix3, Vector2, Vector3};

// Distances from edges are in standard deviations of the point spread.

/// Distance beyond which an edge has no effect on a pixel.
const REACH: f32 = 3.0;
/// Margin along the silhouette, where pixels show too much of an unknown background.
const SILHOUETTE_MARGIN: f32 = 2.5;
/// Distance from an edge beyond which the model has no part of the other side.
const NO_INFLUENCE: f32 = 3.6;
/// Large facets leave out the pixels next to edges, where most model errors are: folds, gaps, arms
/// and shadows. The margin grows from zero, where the middle of the facet is as far from its edges
/// as the first of these, to [`NO_INFLUENCE`] at the second.
const LARGE_FACET: (f32, f32) = (8.0, 16.0);
/// Distance outside the silhouette at which the background is measured, where nothing of the body
/// shows.
const BACKGROUND_DISTANCE: f32 = 3.0;
/// Largest radiance in a pixel from outside its facets, as a share of the mean of its facet.
///
/// Light from a bright window beside a dark body's narrow facets moves their edges, and turns the
/// body by many standard deviations. With 0.01, small bodies behind posts have too few pixels left.
const MAX_SPILLED_SHARE: f32 = 0.03;
/// Distance inside a silhouette up to which the background's radiance matters.
const SPILL_REACH: f32 = 4.0;
/// Distance to two edges below which the facet across their corner shows as well.
const CORNER: f32 = 1.8;

/// Most samples: more cost time and add little information.
const MAX_SAMPLES: usize = 1400;

/// A pixel that shows a facet.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub x: u16,
    pub y: u16,
    pub radiance: f32,
    /// Whether its radiance may exceed the stated value.
    pub is_saturated: bool,
    /// Radiance of the background next to the body, outside the nearest silhouette edge. The
    /// pixel's own radiance where no silhouette is within reach.
    pub background: f32,
    /// The half of a stitched picture that shows it; 0 where there is one picture.
    pub half: u8,
    /// The facet that the pixel lies on.
    pub facet: u8,
    /// Edges of that facet within reach; [`NONE`] for none.
    edges: [u8; 2],
    /// The facets across these edges.
    neighbours: [u8; 2],
}

/// Code for no edge and no neighbour.
const NONE: u8 = u8::MAX;

impl Sample {
    /// Residual of the pixel: its radiance less the model's. `None` for a saturated pixel below its
    /// model, because its radiance may be higher than stated.
    #[inline(always)]
    pub(super) fn counted(&self, residual: f64) -> Option<f64> {
        (!self.is_saturated || residual > 0.0).then_some(residual)
    }

    /// Direction of the pixel, scaled to depth 1.
    #[inline]
    pub(super) fn direction(&self, patch: &Patch) -> Vector3<f64> {
        patch.pinhole.direction(Vector2::new(f64::from(self.x), f64::from(self.y)))
    }

    /// Whether no edge is within reach.
    #[inline]
    pub(super) fn is_inside(&self) -> bool {
        self.edges == [NONE; 2]
    }

    /// Edges of its facet within reach, and the number of the seam along each.
    #[inline]
    pub(super) fn seams(&self, print: &BodyPrint) -> impl Iterator<Item = (usize, usize)> {
        let neighbours = &print.facets[usize::from(self.facet)].neighbours;
        let edges = self.edges.into_iter().filter(|&edge| edge != NONE).map(usize::from);
        edges.filter_map(|edge| Some((edge, neighbours[edge]?.1)))
    }

    /// A key that is equal for samples of the same half and facets.
    #[inline]
    pub(super) fn shows(&self) -> [u8; 4] {
        [self.half, self.facet, self.edges[0], self.edges[1]]
    }

    /// The facets that show in it.
    #[inline]
    pub(super) fn facets(&self) -> impl Iterator<Item = usize> {
        let neighbours = self.neighbours.into_iter().filter(|&facet| facet != NONE);
        std::iter::once(self.facet).chain(neighbours).map(usize::from)
    }
}

/// The pixels inside facets that face the camera, away from the silhouette, without those that the
/// background outshines. Pixels that show the same facets are neighbours in the list.
pub(super) fn choose(patch: &Patch, scene: &Scene<'_>) -> Vec<Sample> {
    let mut found: Vec<(u16, u16, u8, u8, Reach)> = Vec::new();
    let halves = (0..).zip(&scene.halves);
    let in_halves = halves.flat_map(|(half, seen)| {
        scene.print.facets.iter().enumerate().map(move |(index, facet)| (half, seen, index, facet))
    });
    for (half, seen, index, facet) in in_halves {
        // Facets beyond number 254 are left out: no body has that many.
        let (Some((visible_facet, blurred_facet)), Ok(number)) =
            (seen.facet(index), u8::try_from(index))
        else {
            continue;
        };
        let edges = edges(facet, blurred_facet, &seen.visible);
        let plane_from_pixel = visible_facet.plane_from_pixel(&patch.pinhole);
        let sides = sides(blurred_facet, &edges, &plane_from_pixel);
        let bounds = |axis: usize, size: usize| {
            let (low, high) = visible_facet.span_px(axis);
            low.ceil().max(0.0) as usize..((high.floor() + 1.0).max(0.0) as usize).min(size)
        };
        let columns = bounds(0, patch.width);
        for y in bounds(1, patch.height) {
            for x in columns_within(&sides, y, &columns) {
                let at = on_plane(&plane_from_pixel, x, y);
                let Some(reach) = reach(blurred_facet, &edges, at) else { continue };
                if patch.shows_half(half, x, y) {
                    found.push((x as u16, y as u16, half, number, reach));
                }
            }
        }
    }
    // A body nearby has more pixels than its pose needs.
    let step = found.len().div_ceil(MAX_SAMPLES).max(1);
    let sample = |(x, y, half, number, reach): (u16, u16, u8, u8, Reach)| {
        let radiance = patch.at(x.into(), y.into());
        let facet = usize::from(number);
        let background = match (reach.silhouette, scene.facet(half.into(), facet)) {
            (Some(edge), Some((visible, blurred))) => {
                background(patch, visible, blurred, edge, (x.into(), y.into()))
            }
            _ => radiance,
        };
        let Reach { edges, neighbours, .. } = reach;
        let is_saturated = patch.is_saturated(x.into(), y.into());
        Sample { x, y, radiance, is_saturated, background, half, facet: number, edges, neighbours }
    };
    let mut samples: Vec<Sample> = found.into_iter().step_by(step).map(sample).collect();
    // Sum of the radiance and number of the samples of each facet.
    let mut sums = vec![(0.0, 0.0); scene.print.facets.len()];
    for sample in &samples {
        let (radiance, count) = &mut sums[usize::from(sample.facet)];
        (*radiance, *count) = (*radiance + sample.radiance, *count + 1.0);
    }
    samples.retain(|sample| {
        let (radiance, count) = sums[usize::from(sample.facet)];
        spilled(patch, scene, sample) <= MAX_SPILLED_SHARE * (radiance / count).max(0.0)
    });
    // A stable sort keeps the order within a kind, so that sums are the same in every run.
    samples.sort_by_key(Sample::shows);
    samples
}

/// Estimate of the radiance in a pixel that comes from outside its facets: from the background, or
/// from what lies beyond a narrow facet. Saturated backgrounds may be brighter.
fn spilled(patch: &Patch, scene: &Scene<'_>, sample: &Sample) -> f32 {
    let direction = sample.direction(patch);
    let (mut covered, mut brightest, mut is_beside) = (0.0, sample.radiance, !sample.is_inside());
    let seen = &scene.halves[usize::from(sample.half)];
    for facet in sample.facets() {
        let Some((visible, blurred)) = seen.facet(facet) else { continue };
        let at = visible.point(&direction);
        covered += blurred.coverage(at).value;
        for (edge, neighbour) in scene.print.facets[facet].neighbours.iter().enumerate() {
            let is_seen = neighbour.is_some_and(|(facet, _)| seen.visible[facet].is_some());
            if !is_seen && blurred.depth(edge, at) < SPILL_REACH {
                is_beside = true;
                let place = (sample.x.into(), sample.y.into());
                brightest = background(patch, visible, blurred, edge, place).max(brightest);
            }
        }
    }
    if is_beside { (1.0 - covered).max(0.0) * brightest } else { 0.0 }
}

/// Radiance of the background next to a pixel near this silhouette edge of a facet.
fn background(
    patch: &Patch,
    visible: &VisibleFacet,
    blurred: &BlurredFacet<'_>,
    edge: usize,
    (x, y): (usize, usize),
) -> f32 {
    let at = on_plane(&visible.plane_from_pixel(&patch.pinhole), x, y);
    let slope = visible.facet_from_pixel.transpose() * blurred.inwards(edge).cast::<f64>();
    let depth = f64::from(blurred.depth(edge, at) + BACKGROUND_DISTANCE);
    let away = slope * (depth / slope.norm_squared());
    patch.nearest(x as f64 - away.x, y as f64 - away.y)
}

/// The point of a facet's plane under a pixel, in the facet's frame.
#[inline]
fn on_plane(plane_from_pixel: &Matrix3<f64>, x: usize, y: usize) -> Vector2<f64> {
    let plane = plane_from_pixel * Vector3::new(x as f64, y as f64, 1.0);
    plane.xy() / plane.z
}

/// Lines in the patch that enclose a facet's pixels: its edges, moved inwards by their margins.
fn sides(
    blurred: &BlurredFacet<'_>,
    edges: &[(Option<usize>, f32)],
    plane_from_pixel: &Matrix3<f64>,
) -> Vec<Vector3<f64>> {
    // The depth inside an edge is linear in the plane. Multiplied by the homography's denominator
    // it is also linear in the patch. The last line is that denominator itself.
    let side = |(k, &(_, margin)): (usize, &(Option<usize>, f32))| {
        let normal = blurred.inwards(k).cast::<f64>();
        let offset = f64::from(blurred.depth(k, Vector2::zeros()) - margin);
        plane_from_pixel.transpose() * normal.push(offset)
    };
    let before = plane_from_pixel.row(2).transpose();
    edges.iter().enumerate().map(side).chain([before]).collect()
}

/// The columns of a row between the lines, or one more at either end.
fn columns_within(sides: &[Vector3<f64>], y: usize, columns: &Range<usize>) -> Range<usize> {
    let (mut first, mut last) = (columns.start as f64, columns.end as f64 - 1.0);
    for side in sides {
        let at_zero = side.y * y as f64 + side.z;
        let crossing = -at_zero / side.x;
        if side.x > 0.0 {
            first = first.max(crossing.floor());
        } else if side.x < 0.0 {
            last = last.min(crossing.ceil());
        } else if at_zero < 0.0 {
            return 0..0;
        }
    }
    first as usize..(last + 1.0).max(0.0) as usize
}

/// The edges of a facet: the facet across each, if it faces the camera, and the margin inside it.
/// Pixels within a margin are left out.
fn edges(
    facet: &PrintedFacet,
    blurred: &BlurredFacet<'_>,
    visible: &[Option<VisibleFacet>],
) -> Vec<(Option<usize>, f32)> {
    let middle = Vector2::zeros();
    let depths = (0..facet.outline.len()).map(|edge| blurred.depth(edge, middle));
    // Size of the facet, from 0 to 1; see [`LARGE_FACET`].
    let room = (depths.fold(f32::MAX, f32::min) - LARGE_FACET.0) / (LARGE_FACET.1 - LARGE_FACET.0);
    let room = room.clamp(0.0, 1.0);
    let edge = |neighbour: &Option<(usize, usize)>| {
        let across = neighbour.map(|(facet, _)| facet).filter(|&facet| visible[facet].is_some());
        let margin = match across {
            Some(_) => room * NO_INFLUENCE,
            None => SILHOUETTE_MARGIN + room * (NO_INFLUENCE - SILHOUETTE_MARGIN),
        };
        (across, margin)
    };
    facet.neighbours.iter().map(edge).collect()
}

/// The edges near a point of a facet.
#[derive(Debug, Clone, Copy)]
struct Reach {
    /// Edges within reach, and the facets across them.
    edges: [u8; 2],
    neighbours: [u8; 2],
    /// The nearest silhouette edge.
    silhouette: Option<usize>,
}

/// The edges within reach of a point. `None` if the point lies outside the facet, within a margin
/// or too near to a corner.
#[inline]
fn reach(
    blurred: &BlurredFacet<'_>,
    facet_edges: &[(Option<usize>, f32)],
    at: Vector2<f64>,
) -> Option<Reach> {
    let (mut edges, mut neighbours) = ([NONE; 2], [NONE; 2]);
    let mut silhouette: Option<(usize, f32)> = None;
    let mut count = 0;
    let mut near_edges = 0;
    for (k, &(across, margin)) in facet_edges.iter().enumerate() {
        let depth = blurred.depth(k, at);
        // False for a NaN.
        let is_inside = depth >= 0.0;
        if !is_inside {
            return None;
        }
        near_edges += u32::from(depth < CORNER);
        match across {
            _ if depth < margin => return None,
            _ if depth >= REACH => {}
            // The numbers fit into a byte unless the facet has more than 254 edges or the body as
            // many facets; then there is no such sample.
            Some(neighbour) if count < edges.len() => {
                edges[count] = u8::try_from(k).ok()?;
                neighbours[count] = u8::try_from(neighbour).ok()?;
                count += 1;
            }
            Some(_) => return None,
            None => {
                if silhouette.is_none_or(|(_, nearest)| depth < nearest) {
                    silhouette = Some((k, depth));
                }
            }
        }
    }
    let silhouette = silhouette.map(|(edge, _)| edge);
    (near_edges < 2).then_some(Reach { edges, neighbours, silhouette })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use nalgebra::{Isometry3, Matrix2, Translation3, UnitQuaternion};
    use proptest::prelude::*;

    use super::*;
    use crate::align::model::geometry::visible_facets;
    use crate::align::pinhole::Pinhole;
    use crate::align::tests::{body, print_of};

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(40) })]

        /// Near and far, so that facets are large and small, cut by the image and rotated in it.
        #[test]
        fn every_sample_lies_between_the_sides(
            euler in prop::array::uniform3(-3.0..3.0f64),
            range_m in 0.2..2.0f64,
            across in prop::array::uniform2(-0.2..0.2f64),
            blur in 0.2..2.0f64,
        ) {
            const SIZE: usize = 64;
            let print = print_of(&body(0));
            let pose = Isometry3::from_parts(
                Translation3::new(across[0] * range_m, across[1] * range_m, range_m),
                UnitQuaternion::from_euler_angles(euler[0], euler[1], euler[2]),
            );
            let pinhole = Pinhole { focal_px: 250.0, centre_px: Vector2::new(31.5, 31.5) };
            let visible = visible_facets(&print, &pose, &pinhole);
            let (mut samples, mut between) = (0, 0);
            for (facet, visible_facet) in print.facets.iter().zip(&visible) {
                let Some(visible_facet) = visible_facet else { continue };
                let per_pixel = visible_facet.facet_from_pixel;
                let spread = per_pixel * Matrix2::identity() * blur * per_pixel.transpose();
                let blurred = BlurredFacet::new(facet, &spread, &Vector2::zeros(), 1);
                let edges = edges(facet, &blurred, &visible);
                let plane = visible_facet.plane_from_pixel(&pinhole);
                let sides = sides(&blurred, &edges, &plane);
                for y in 0..SIZE {
                    let within = columns_within(&sides, y, &(0..SIZE));
                    prop_assert!(within.end <= SIZE);
                    between += within.len();
                    for x in 0..SIZE {
                        let at = on_plane(&plane, x, y);
                        // Behind the camera the plane has no points.
                        let is_ahead = (plane * Vector3::new(x as f64, y as f64, 1.0)).z > 0.0;
                        if is_ahead && reach(&blurred, &edges, at).is_some() {
                            samples += 1;
                            prop_assert!(within.contains(&x), "{} {}: {:?}", x, y, within);
                        }
                    }
                }
            }
            // Few other pixels do: one or two of each row, and those near a corner.
            prop_assert!(between < 2 * samples + 8 * SIZE * print.facets.len());
        }
    }
}
