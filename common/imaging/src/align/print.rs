//! The printed surface of a body: flat white facets, some of them with the black cells of a marker.

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::mirror_image;
use nalgebra::{
    Isometry3, Point2, Point3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};

use crate::edges::MarkerPrint;

/// Most cells along a side of a marker, its border included, that alignment can model.
pub const MAX_CELLS: usize = 16;

/// Distance below which corners of two facets are the same, metres: bodies are measured no better.
const SAME_CORNER_M: f64 = 5e-4;

/// The printed surface of a body, in the markers' frame.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyPrint {
    pub(super) facets: Vec<PrintedFacet>,
    /// Number of edges that two facets share.
    pub(super) seams: usize,
    radius_m: f64,
}

/// One flat side of a body.
///
/// Its frame has x to the printed right, y to the printed bottom and z into the body. The origin is
/// the middle of the marker, or of the facet where there is no marker.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PrintedFacet {
    pub markers_from_facet: Isometry3<f64>,
    /// Corners in the facet's plane, in order, metres.
    pub outline: Vec<Point2<f64>>,
    /// The facet across the edge from corner k to k + 1, and the number of the seam.
    pub neighbours: Vec<Option<(usize, usize)>>,
    /// The marker's cells; `None` on a blank facet.
    pub cells: Option<Cells>,
}

/// The black cells of a marker.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cells {
    /// Side of one cell, metres.
    pub side_m: f64,
    /// Cells along a side, border included.
    pub count: usize,
    /// Row by row: 1 for black, 0 for white.
    pub black: Vec<f32>,
}

/// Reason why a body cannot be modelled.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PrintError {
    #[error("marker {id} of body '{body}' is not in the dictionary")]
    UnknownMarker { body: String, id: u32 },
    #[error(
        "marker {id} of body '{body}' has {cells} cells along a side; alignment draws {MAX_CELLS} at most"
    )]
    TooManyCells { body: String, id: u32, cells: usize },
}

impl BodyPrint {
    /// The print of `body`; `print_of` gives the print of a marker by its id.
    pub fn new<'p>(
        body: &Body,
        print_of: impl Fn(u32) -> Option<&'p MarkerPrint>,
    ) -> Result<Self, PrintError> {
        let mut facets = Vec::with_capacity(body.facets().len());
        for facet in body.facets() {
            let marker = facet.marker.map(|index| &body.markers[index]);
            let cells = match marker {
                None => None,
                Some(marker) => {
                    let (name, id) = (body.name.clone(), marker.id);
                    let print = print_of(id)
                        .ok_or_else(|| PrintError::UnknownMarker { body: name.clone(), id })?;
                    if print.cells() > MAX_CELLS {
                        let cells = print.cells();
                        return Err(PrintError::TooManyCells { body: name, id, cells });
                    }
                    Some(Cells::of(print, marker.side()))
                }
            };
            let markers_from_facet = match marker {
                // The marker's own frame has y up and z out.
                Some(marker) => {
                    let half_turn = UnitQuaternion::from_axis_angle(
                        &nalgebra::Vector3::x_axis(),
                        std::f64::consts::PI,
                    );
                    marker.markers_from_marker() * half_turn
                }
                None => frame_of_blank(&facet.outline),
            };
            let facet_from_markers = markers_from_facet.inverse();
            let outline: Vec<_> =
                facet.outline.iter().map(|corner| (facet_from_markers * corner).xy()).collect();
            let neighbours = vec![None; outline.len()];
            facets.push(PrintedFacet { markers_from_facet, outline, neighbours, cells });
        }
        let seams = find_neighbours(&mut facets);
        let radius_m = facets
            .iter()
            .flat_map(PrintedFacet::corners_in_markers)
            .map(|corner| corner.coords.norm())
            .fold(0.0, f64::max);
        Ok(Self { facets, seams, radius_m })
    }

    /// Radius of the sphere about the markers' origin that contains all facets, metres.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// The other pose in which this facet looks almost the same ([`mirror_image`]; planar pose
    /// ambiguity). `None` if there is no such facet.
    pub fn mirrored(
        &self,
        facet: u32,
        camera_from_markers: &Isometry3<f64>,
    ) -> Option<Isometry3<f64>> {
        let markers_from_facet = self.facets.get(facet as usize)?.markers_from_facet;
        let middle = Point3::from(markers_from_facet.translation.vector);
        mirror_image(camera_from_markers, &middle, &(markers_from_facet * Vector3::z()))
    }

    /// Side of the smallest marker's cells, metres; infinite without markers.
    pub(super) fn smallest_cell_m(&self) -> f64 {
        let cells = self.facets.iter().filter_map(|facet| facet.cells.as_ref());
        cells.map(|cells| cells.side_m).fold(f64::INFINITY, f64::min)
    }
}

impl PrintedFacet {
    pub(super) fn corners_in_markers(&self) -> impl Iterator<Item = Point3<f64>> {
        self.outline
            .iter()
            .map(|corner| self.markers_from_facet * Point3::from(corner.coords.push(0.0)))
    }

    /// Mean of the corners, in the facet's plane.
    pub(super) fn middle(&self) -> Point2<f64> {
        let sum: Vector2<f64> = self.outline.iter().map(|corner| corner.coords).sum();
        Point2::from(sum / self.outline.len().max(1) as f64)
    }
}

impl Cells {
    fn of(print: &MarkerPrint, marker_side_m: f64) -> Self {
        let count = print.cells();
        let black = (0..count * count)
            .map(|k| {
                let is_white = print.is_white((k / count) as isize, (k % count) as isize);
                if is_white { 0.0 } else { 1.0 }
            })
            .collect();
        Self { side_m: marker_side_m / count as f64, count, black }
    }
}

/// A frame in the plane of a facet without a marker. Its rotation in the plane is arbitrary.
fn frame_of_blank(outline: &[Point3<f64>]) -> Isometry3<f64> {
    let sum: nalgebra::Vector3<f64> = outline.iter().map(|corner| corner.coords).sum();
    let middle = sum / outline.len().max(1) as f64;
    let x = (outline[1] - outline[0]).normalize();
    // Newell's sum works for every outline, even with three corners on a line.
    let outward: nalgebra::Vector3<f64> = (0..outline.len())
        .map(|k| {
            let (a, b) =
                (outline[k].coords - middle, outline[(k + 1) % outline.len()].coords - middle);
            a.cross(&b)
        })
        .sum();
    let z = -outward.normalize();
    let axes = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
    Isometry3::from_parts(Translation3::from(middle), UnitQuaternion::from_rotation_matrix(&axes))
}

/// Finds the facets that share both ends of an edge. Returns the number of seams.
fn find_neighbours(facets: &mut [PrintedFacet]) -> usize {
    let corners: Vec<Vec<Point3<f64>>> =
        facets.iter().map(|facet| facet.corners_in_markers().collect()).collect();
    let mut seams = 0;
    for a in 0..facets.len() {
        let edges = corners[a].len();
        for k in 0..edges {
            if facets[a].neighbours[k].is_some() {
                continue;
            }
            let (from, to) = (corners[a][k], corners[a][(k + 1) % edges]);
            let place = |b: usize, point: &Point3<f64>| {
                corners[b].iter().position(|corner| (corner - point).norm() < SAME_CORNER_M)
            };
            let across = (0..corners.len()).filter(|&b| b != a).find_map(|b| {
                let (i, j) = (place(b, &from)?, place(b, &to)?);
                let count = corners[b].len();
                // Two polygons share this edge, in either direction.
                match () {
                    () if (i + 1) % count == j => Some((b, i)),
                    () if (j + 1) % count == i => Some((b, j)),
                    () => None,
                }
            });
            if let Some((b, edge)) = across {
                facets[a].neighbours[k] = Some((b, seams));
                facets[b].neighbours[edge] = Some((a, seams));
                seams += 1;
            }
        }
    }
    seams
}
