//! Drawing of a partition on the sphere, seen from ahead and from behind, and on the sphere image.

use std::f64::consts::{PI, TAU};

use flockeye_geometry::Ray;
use flockeye_geometry::partition::{Partition, PartitionError};
use flockeye_geometry::view::{View, ViewPixel};
use nalgebra::{Unit, Vector3};

use crate::svg::Svg;

const GLOBE: f64 = 230.0;
const IMAGE_WIDTH: f64 = 960.0;
const IMAGE_TOP: f64 = 540.0;

/// A hue for each index. Steps of the golden angle give neighbours different hues.
fn hue(index: usize) -> f64 {
    (137.508 * index as f64) % 360.0
}

/// Draws circles (thin) and views (thick), each with its number in the middle.
pub(super) fn draw(partition: &Partition, margin_rad: f64) -> Result<String, PartitionError> {
    let views = partition.views(margin_rad, 1000.0)?;
    let radius_rad = partition.covering_diameter_rad() / 2.0;
    let mut svg = Svg::new(IMAGE_WIDTH + 40.0, IMAGE_TOP + IMAGE_WIDTH / 2.0 + 50.0);
    let title = r#"text-anchor="middle" font-size="16""#;
    let globes = [(260.0, 1.0, "from ahead"), (740.0, -1.0, "from behind")];
    for (x, _, name) in globes {
        svg.text((x, 24.0), title, name);
        svg.element(format_args!(
            r##"<circle cx="{x}" cy="270" r="{GLOBE}" fill="#f6f6f6" stroke="#888888"/>"##
        ));
    }
    svg.text(
        (IMAGE_WIDTH / 2.0 + 20.0, IMAGE_TOP - 8.0),
        title,
        "on the sphere image, ahead in its middle",
    );
    svg.element(format_args!(
        r##"<rect x="20" y="{IMAGE_TOP}" width="{IMAGE_WIDTH}" height="{}" fill="#f6f6f6" stroke="#888888"/>"##,
        IMAGE_WIDTH / 2.0
    ));
    for (index, (direction, view)) in partition.directions().iter().zip(&views).enumerate() {
        let colour = format!("hsl({:.0},75%,40%)", hue(index));
        let circle =
            (circle(direction, radius_rad), format!(r#"stroke="{colour}" stroke-width="0.8""#));
        let square = (square(view), format!(r#"stroke="{colour}" stroke-width="2""#));
        let label = format!(r#"text-anchor="middle" fill="{colour}""#);
        for (x, facing, _) in globes {
            let place = |ray: &Ray| {
                // Seen from ahead, the camera's left (+y) is on the right.
                (ray.x * facing > 0.0).then(|| (x + GLOBE * ray.y * facing, 270.0 - GLOBE * ray.z))
            };
            for (outline, style) in [&circle, &square] {
                paths(&mut svg, outline, place, style);
            }
            if let Some((x, y)) = place(direction) {
                svg.text((x, y + 5.0), &label, &index.to_string());
            }
        }
        for (outline, style) in [&circle, &square] {
            paths(&mut svg, outline, |ray| Some(on_image(ray)), style);
        }
        let (x, y) = on_image(direction);
        svg.text((x, y + 5.0), &label, &index.to_string());
    }
    svg.text(
        (20.0, IMAGE_TOP + IMAGE_WIDTH / 2.0 + 30.0),
        "",
        &format!(
            "N = {}, θ = {:.4}° (thin), views of {:.3}° for a margin of {:.2}° (thick)",
            partition.len(),
            partition.covering_diameter_rad().to_degrees(),
            partition.field_rad(margin_rad)?.to_degrees(),
            margin_rad.to_degrees()
        ),
    );
    Ok(svg.finish())
}

/// The position of a ray on the sphere image.
fn on_image(ray: &Ray) -> (f64, f64) {
    let across = 0.5 - ray.y.atan2(ray.x) / TAU;
    let down = 0.5 - ray.z.clamp(-1.0, 1.0).asin() / PI;
    (20.0 + IMAGE_WIDTH * across, IMAGE_TOP + IMAGE_WIDTH / 2.0 * down)
}

fn circle(direction: &Ray, radius_rad: f64) -> Vec<Ray> {
    let helper = if direction.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
    let u = direction.cross(&helper).normalize();
    let v = direction.cross(&u);
    let (sin, cos) = radius_rad.sin_cos();
    let point = |step: u32| {
        let (s, c) = (TAU * f64::from(step) / 120.0).sin_cos();
        Unit::new_normalize(direction.into_inner() * cos + (u * c + v * s) * sin)
    };
    (0..=120).map(point).collect()
}

fn square(view: &View) -> Vec<Ray> {
    let last = f64::from(view.size_px) - 1.0;
    let corners = [(0.0, 0.0), (last, 0.0), (last, last), (0.0, last), (0.0, 0.0)];
    let side = |pair: &[(f64, f64)]| {
        let ((u0, v0), (u1, v1)) = (pair[0], pair[1]);
        (0..=40).map(move |step| {
            let t = f64::from(step) / 40.0;
            view.ray(ViewPixel::new(u0 + (u1 - u0) * t, v0 + (v1 - v0) * t))
        })
    };
    corners.windows(2).flat_map(side).collect()
}

/// Draws an outline. It is split where it is hidden or crosses the edge of the image.
fn paths(svg: &mut Svg, outline: &[Ray], place: impl Fn(&Ray) -> Option<(f64, f64)>, style: &str) {
    let mut piece: Vec<(f64, f64)> = Vec::new();
    for ray in outline {
        let point = place(ray);
        let breaks = match (point, piece.last()) {
            (None, _) => true,
            (Some(point), Some(last)) => (point.0 - last.0).abs() > IMAGE_WIDTH / 2.0,
            (Some(_), None) => false,
        };
        if breaks {
            svg.line(&piece, style);
            piece.clear();
        }
        piece.extend(point);
    }
    svg.line(&piece, style);
}
