//! Which pixels of a patch say something of a body's pose.

use std::ops::Range;

use super::blurred::BlurredFacet;
use super::geometry::SeenFacet;
use super::patch::{Patch, direction};
use super::print::{BodyPrint, PrintedFacet};
use nalgebra::{Matrix3, Vector2, Vector3};

/// Beyond so many deviations of the point spread, what lies across an edge does not count.
const REACH: f32 = 3.0;
/// Pixels nearer to the silhouette, in deviations, show more of what is behind the body than is known.
const SILHOUETTE: f32 = 2.5;
/// Beyond so many deviations nothing of what lies across an edge is left in the model.
const OUT_OF_REACH: f32 = 3.6;
/// Facets whose middle is farther than the first of these from all its edges, deviations, can do
/// without pixels next to edges, where most of what is not modelled shows: folds, gaps, arms and
/// shadows that begin there. From the second on they do without all within reach.
const ROOMY: (f32, f32) = (8.0, 16.0);
/// So far beyond the silhouette a pixel shows nothing of the body, deviations.
pub(super) const BEHIND: f32 = 3.0;
/// Nearer than this to two edges, the facet across their corner shows as well.
const CORNER: f32 = 1.8;

/// More samples than this cost time and tell little.
const MOST: usize = 1400;

/// A pixel that shows a facet.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub x: u16,
    pub y: u16,
    pub light: f32,
    /// Light of what is next to the body, beyond the silhouette nearby; its own where there is none.
    pub behind: f32,
    pub facet: u8,
    /// Edges of that facet that are within reach; [`NONE`] for none.
    edges: [u8; 2],
    /// The facets across them.
    neighbours: [u8; 2],
}

/// No edge, no neighbour.
const NONE: u8 = u8::MAX;

impl Sample {
    #[inline]
    pub fn direction(&self, patch: &Patch) -> Vector3<f64> {
        direction(&patch.pinhole, usize::from(self.x), usize::from(self.y))
    }

    /// Whether no edge is within reach.
    #[inline]
    pub fn is_inside(&self) -> bool {
        self.edges == [NONE; 2]
    }

    /// Edges of its facet within reach, and the seams along them.
    #[inline]
    pub fn seams(&self, print: &BodyPrint) -> impl Iterator<Item = (usize, usize)> {
        let neighbours = &print.facets[usize::from(self.facet)].neighbours;
        let edges = self.edges.into_iter().filter(|&edge| edge != NONE).map(usize::from);
        edges.filter_map(|edge| Some((edge, neighbours[edge]?.1)))
    }

    /// The numbers of the facets that show in it, as a key.
    #[inline]
    pub fn shows(&self) -> [u8; 3] {
        [self.facet, self.edges[0], self.edges[1]]
    }

    /// The facets that show in it.
    #[inline]
    pub fn facets(&self) -> impl Iterator<Item = usize> {
        let neighbours = self.neighbours.into_iter().filter(|&facet| facet != NONE);
        std::iter::once(self.facet).chain(neighbours).map(usize::from)
    }
}

/// The pixels inside facets that face the camera, away from the silhouette; those that show the same
/// facets stand together.
pub(super) fn choose(
    patch: &Patch,
    facets: &[PrintedFacet],
    seen: &[Option<SeenFacet>],
    blurred: &[Option<BlurredFacet<'_>>],
) -> Vec<Sample> {
    let mut found: Vec<(u16, u16, u8, Reach)> = Vec::new();
    for (index, facet) in facets.iter().enumerate() {
        // Facets beyond 254 do not get a number: no body has so many.
        let (Some(seen_facet), Some(blurred_facet), Ok(number)) =
            (&seen[index], &blurred[index], u8::try_from(index))
        else {
            continue;
        };
        let margins = Margins::of(facet, blurred_facet);
        let plane_from_pixel = seen_facet.plane_from_pixel(&patch.pinhole);
        let sides = Sides::of(facet, blurred_facet, seen, margins, &plane_from_pixel);
        let bounds = |axis: usize, size: usize| {
            let values = seen_facet.outline_px.iter().map(|corner| corner[axis]);
            let (low, high) = values
                .fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
            low.ceil().max(0.0) as usize..((high.floor() + 1.0).max(0.0) as usize).min(size)
        };
        let columns = bounds(0, patch.width);
        for y in bounds(1, patch.height) {
            for x in sides.within(y, &columns) {
                if patch.at(x, y).is_nan() {
                    continue;
                }
                let at = on_plane(&plane_from_pixel, x, y);
                if let Some(reach) = reach(facet, blurred_facet, seen, margins, at) {
                    found.push((x as u16, y as u16, number, reach));
                }
            }
        }
    }
    // A body that is near has more than its pose needs.
    let step = found.len().div_ceil(MOST).max(1);
    let sample = |(x, y, number, reach): (u16, u16, u8, Reach)| {
        let light = patch.at(x.into(), y.into());
        let facet = usize::from(number);
        let behind = match (reach.silhouette, &seen[facet], &blurred[facet]) {
            (Some(edge), Some(seen), Some(blurred)) => {
                beyond(patch, seen, blurred, edge, (x.into(), y.into()))
            }
            _ => light,
        };
        let Reach { edges, neighbours, .. } = reach;
        Sample { x, y, light, behind, facet: number, edges, neighbours }
    };
    let mut samples: Vec<Sample> = found.into_iter().step_by(step).map(sample).collect();
    // By places in the image within each kind, so that sums are the same on every run.
    samples.sort_by_key(Sample::shows);
    samples
}

/// The light beyond the silhouette, next to a pixel near this edge of a facet.
fn beyond(
    patch: &Patch,
    seen: &SeenFacet,
    blurred: &BlurredFacet<'_>,
    edge: usize,
    (x, y): (usize, usize),
) -> f32 {
    let at = on_plane(&seen.plane_from_pixel(&patch.pinhole), x, y);
    let slope = seen.facet_from_pixel.transpose() * blurred.inwards(edge).cast::<f64>();
    let depth = f64::from(blurred.depth(edge, at) + BEHIND);
    let away = slope * (depth / slope.norm_squared());
    patch.near(x as f64 - away.x, y as f64 - away.y)
}

/// Where a pixel sees a facet's plane.
#[inline]
fn on_plane(plane_from_pixel: &Matrix3<f64>, x: usize, y: usize) -> Vector2<f64> {
    let plane = plane_from_pixel * Vector3::new(x as f64, y as f64, 1.0);
    plane.xy() / plane.z
}

/// Lines in the patch between which a facet's pixels lie: the edges, as far inside as they count.
struct Sides(Vec<Vector3<f64>>);

impl Sides {
    fn of(
        facet: &PrintedFacet,
        blurred: &BlurredFacet<'_>,
        seen: &[Option<SeenFacet>],
        margins: Margins,
        plane_from_pixel: &Matrix3<f64>,
    ) -> Self {
        // An edge's depth is linear in the plane, and so in the patch, once multiplied by what the
        // plane's coordinates are divided by: that is the last line.
        let edge = |k: usize| {
            let normal = blurred.inwards(k).cast::<f64>();
            let least = margins.at(facet, k, seen);
            let offset = f64::from(blurred.depth(k, Vector2::zeros()) - least);
            plane_from_pixel.transpose() * normal.push(offset)
        };
        let edges = (0..facet.outline.len()).map(edge);
        let before = plane_from_pixel.row(2).transpose();
        Self(edges.chain([before]).collect())
    }

    /// The columns of a row between them, or one more at either end.
    fn within(&self, y: usize, columns: &Range<usize>) -> Range<usize> {
        let (mut first, mut last) = (columns.start as f64, columns.end as f64 - 1.0);
        for side in &self.0 {
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
}

/// Pixels nearer than this to an edge of a facet do not count, deviations.
#[derive(Debug, Clone, Copy)]
struct Margins {
    /// Where another facet that is seen begins.
    seam: f32,
    /// Where the body ends.
    silhouette: f32,
}

impl Margins {
    fn of(facet: &PrintedFacet, blurred: &BlurredFacet<'_>) -> Self {
        let middle = Vector2::zeros();
        let depths = (0..facet.outline.len()).map(|edge| blurred.depth(edge, middle));
        let room = (depths.fold(f32::MAX, f32::min) - ROOMY.0) / (ROOMY.1 - ROOMY.0);
        let room = room.clamp(0.0, 1.0);
        Self {
            seam: room * OUT_OF_REACH,
            silhouette: SILHOUETTE + room * (OUT_OF_REACH - SILHOUETTE),
        }
    }

    /// That of one edge.
    fn at(self, facet: &PrintedFacet, edge: usize, seen: &[Option<SeenFacet>]) -> f32 {
        match seen_across(facet, edge, seen) {
            Some(_) => self.seam,
            None => self.silhouette,
        }
    }
}

/// The facet across an edge, if it is seen.
#[inline]
fn seen_across(facet: &PrintedFacet, edge: usize, seen: &[Option<SeenFacet>]) -> Option<usize> {
    let (neighbour, _) = facet.neighbours[edge]?;
    seen[neighbour].is_some().then_some(neighbour)
}

/// What a point of a facet is near to.
#[derive(Debug, Clone, Copy)]
struct Reach {
    /// Edges within reach, and the facets across them.
    edges: [u8; 2],
    neighbours: [u8; 2],
    /// The nearest edge across which there is nothing of the body.
    silhouette: Option<usize>,
}

/// What is within reach of a point; `None` if it lies outside, or too near to the silhouette or a
/// corner.
#[inline]
fn reach(
    facet: &PrintedFacet,
    blurred: &BlurredFacet<'_>,
    seen: &[Option<SeenFacet>],
    margins: Margins,
    at: Vector2<f64>,
) -> Option<Reach> {
    let (mut edges, mut neighbours) = ([NONE; 2], [NONE; 2]);
    let mut silhouette: Option<(usize, f32)> = None;
    let mut count = 0;
    let mut near_edges = 0;
    for k in 0..facet.outline.len() {
        let depth = blurred.depth(k, at);
        // A NaN is outside too.
        let is_inside = depth >= 0.0;
        if !is_inside {
            return None;
        }
        near_edges += u32::from(depth < CORNER);
        match seen_across(facet, k, seen) {
            Some(_) if depth < margins.seam => return None,
            None if depth < margins.silhouette => return None,
            _ if depth >= REACH => {}
            // Both fit: a facet with more than 254 edges, or a body with as many facets, has no such
            // sample.
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
    use crate::align::geometry::{Pinhole, seen_facets};
    use crate::align::tests::{body, print_of};

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(40) })]

        /// Near and far, so that facets are roomy and not, cut by the image and askew in it.
        #[test]
        fn every_pixel_that_counts_lies_between_the_sides(
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
            let seen = seen_facets(&print, &pose, &pinhole);
            let (mut counting, mut looked_at) = (0, 0);
            for (facet, seen_facet) in print.facets.iter().zip(&seen) {
                let Some(seen_facet) = seen_facet else { continue };
                let per_pixel = seen_facet.facet_from_pixel;
                let spread = per_pixel * Matrix2::identity() * blur * per_pixel.transpose();
                let blurred = BlurredFacet::new(facet, &spread);
                let margins = Margins::of(facet, &blurred);
                let plane = seen_facet.plane_from_pixel(&pinhole);
                let sides = Sides::of(facet, &blurred, &seen, margins, &plane);
                for y in 0..SIZE {
                    let within = sides.within(y, &(0..SIZE));
                    prop_assert!(within.end <= SIZE);
                    looked_at += within.len();
                    for x in 0..SIZE {
                        let at = on_plane(&plane, x, y);
                        // Behind the camera there is nothing of the plane.
                        let is_ahead = (plane * Vector3::new(x as f64, y as f64, 1.0)).z > 0.0;
                        if is_ahead && reach(facet, &blurred, &seen, margins, at).is_some() {
                            counting += 1;
                            prop_assert!(within.contains(&x), "{} {}: {:?}", x, y, within);
                        }
                    }
                }
            }
            // Not much else does: a pixel or two of each row, and what is near a corner.
            prop_assert!(looked_at < 2 * counting + 8 * SIZE * print.facets.len());
        }
    }
}
