//! Which pixels of a patch say something of a body's pose.

use super::blurred::BlurredFacet;
use super::geometry::SeenFacet;
use super::patch::{Patch, direction};
use super::print::{BodyPrint, PrintedFacet};
use nalgebra::Vector3;

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
    let mut samples = Vec::new();
    for (index, facet) in facets.iter().enumerate() {
        // Facets beyond 254 do not get a number: no body has so many.
        let (Some(seen_facet), Some(blurred_facet), Ok(number)) =
            (&seen[index], &blurred[index], u8::try_from(index))
        else {
            continue;
        };
        let margins = Margins::of(facet, blurred_facet);
        let plane_from_pixel = seen_facet.plane_from_pixel(&patch.pinhole);
        let bounds = |axis: usize, size: usize| {
            let values = seen_facet.outline_px.iter().map(|corner| corner[axis]);
            let (low, high) = values
                .fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
            (low.ceil().max(0.0) as usize, ((high.floor() + 1.0).max(0.0) as usize).min(size))
        };
        let ((left, right), (top, bottom)) = (bounds(0, patch.width), bounds(1, patch.height));
        for y in top..bottom {
            for x in left..right {
                let light = patch.at(x, y);
                if light.is_nan() {
                    continue;
                }
                let plane = plane_from_pixel * Vector3::new(x as f64, y as f64, 1.0);
                let at = plane.xy() / plane.z;
                let Some(Reach { edges, neighbours, silhouette }) =
                    reach(facet, blurred_facet, seen, margins, at)
                else {
                    continue;
                };
                let behind = silhouette.map_or(light, |edge| {
                    let slope = seen_facet.facet_from_pixel.transpose()
                        * blurred_facet.inwards(edge).cast::<f64>();
                    let depth = f64::from(blurred_facet.depth(edge, at) + BEHIND);
                    let away = slope * (depth / slope.norm_squared());
                    patch.near(x as f64 - away.x, y as f64 - away.y)
                });
                let (x, y) = (x as u16, y as u16);
                samples.push(Sample { x, y, light, behind, facet: number, edges, neighbours });
            }
        }
    }
    // A body that is near has more than its pose needs.
    let step = samples.len().div_ceil(MOST).max(1);
    let mut samples: Vec<Sample> = samples.into_iter().step_by(step).collect();
    // By places in the image within each kind, so that sums are the same on every run.
    samples.sort_by_key(Sample::shows);
    samples
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
        let middle = nalgebra::Vector2::zeros();
        let depths = (0..facet.outline.len()).map(|edge| blurred.depth(edge, middle));
        let room = (depths.fold(f32::MAX, f32::min) - ROOMY.0) / (ROOMY.1 - ROOMY.0);
        let room = room.clamp(0.0, 1.0);
        Self {
            seam: room * OUT_OF_REACH,
            silhouette: SILHOUETTE + room * (OUT_OF_REACH - SILHOUETTE),
        }
    }
}

/// What a point of a facet is near to.
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
    at: nalgebra::Vector2<f64>,
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
        match facet.neighbours[k].filter(|&(neighbour, _)| seen[neighbour].is_some()) {
            Some(_) if depth < margins.seam => return None,
            None if depth < margins.silhouette => return None,
            _ if depth >= REACH => {}
            // Both fit: a facet with more than 254 edges, or a body with as many facets, has no such
            // sample.
            Some((neighbour, _)) if count < edges.len() => {
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
