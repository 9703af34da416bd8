//! One facet, drawn flat.

use anyhow::Context;
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::{Body, Facet, Marker};
use nalgebra::{Point3, Vector3};

use super::page::{Ink, PaperDrawing};

/// Room for the label below a facet, and for the up mark above it.
const LABEL_MM: f64 = 5.0;
const UP_MARK_MM: f64 = 3.5;

/// The name of a facet, and its drawing with a label, seen from outside with the marker upright.
pub(super) fn piece(
    facet: &Facet,
    body: &Body,
    dictionary: &Dictionary,
) -> anyhow::Result<(String, PaperDrawing)> {
    let marker = facet.marker.map(|k| &body.markers[k]);
    let up = up_of(facet, marker);
    let right = up.cross(&facet.normal);
    let flat = |p: &Point3<f64>| [right.dot(&p.coords) * 1e3, -up.dot(&p.coords) * 1e3];
    let outline: Vec<[f64; 2]> = facet.outline.iter().map(flat).collect();
    let least = |axis: usize| outline.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
    let most = |axis: usize| outline.iter().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max);
    let (width, height) = (most(0) - least(0), most(1) - least(1));
    let offset = [-least(0), UP_MARK_MM - least(1)];
    let mut shapes = vec![Ink::Outline { corners: outline.clone() }];
    let name = match marker {
        Some(marker) => {
            let print = dictionary
                .print(marker.id)
                .with_context(|| format!("{dictionary:?} has no marker {}", marker.id))?;
            let corners = marker.corners.each_ref().map(flat);
            shapes.push(Ink::Black(cells(&corners, print.cells(), |row, column| {
                print.is_white(row as isize, column as isize)
            })));
            format!("id {}", marker.id)
        }
        None => "blank".to_owned(),
    };
    let mut shapes: Vec<Ink> = shapes.iter().map(|shape| shape.moved(offset)).collect();
    // The up mark is outside of the facet, so that the print is not changed.
    let middle = width / 2.0;
    shapes.push(Ink::Black(vec![vec![
        [middle, 0.0],
        [middle + 1.5, UP_MARK_MM - 1.0],
        [middle - 1.5, UP_MARK_MM - 1.0],
    ]]));
    let at = [0.0, UP_MARK_MM + height + 3.5];
    let text = format!("{} {name}", body.name);
    shapes.push(Ink::Text { at, height_mm: 2.5, text });
    Ok((name, PaperDrawing { size_mm: [width, UP_MARK_MM + height + LABEL_MM], shapes }))
}

/// The up direction of a facet: towards the top of its marker, else +z, or +x on a horizontal
/// facet.
fn up_of(facet: &Facet, marker: Option<&Marker>) -> Vector3<f64> {
    let towards = match marker {
        Some(marker) => marker.corners[0] - marker.corners[3],
        None if facet.normal.z.abs() > 0.999 => Vector3::x(),
        None => Vector3::z(),
    };
    (towards - facet.normal * facet.normal.dot(&towards)).normalize()
}

/// The black square without its white cells. White cells side by side in a row are one loop.
fn cells(
    corners: &[[f64; 2]; 4],
    count: usize,
    is_white: impl Fn(usize, usize) -> bool,
) -> Vec<Vec<[f64; 2]>> {
    let [origin, right_end, _, down_end] = corners;
    let at = |row: usize, column: usize| {
        let share = |end: &[f64; 2], k: usize, axis: usize| {
            (end[axis] - origin[axis]) * k as f64 / count as f64
        };
        [0, 1]
            .map(|axis| origin[axis] + share(right_end, column, axis) + share(down_end, row, axis))
    };
    let mut loops = vec![corners.to_vec()];
    for row in 0..count {
        let mut start = 0;
        while start < count {
            let end = (start..count).find(|&column| !is_white(row, column)).unwrap_or(count);
            if end > start {
                loops.push(vec![
                    at(row, start),
                    at(row, end),
                    at(row + 1, end),
                    at(row + 1, start),
                ]);
            }
            start = end + 1;
        }
    }
    loops
}
