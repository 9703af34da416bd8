//! The path of a body around the observer, in space.

use nalgebra::{Rotation3, Vector3};

use crate::svg::Svg;

const SIDE: f64 = 300.0;

/// Draws the true and the measured positions of a body from above, from the right, and at a slant.
/// Pieces are not connected. A script of the page turns the last drawing with the mouse.
pub(super) fn draw(
    body: &str,
    truth: &[Vec<Vector3<f64>>],
    measured: &[Vec<Vector3<f64>>],
) -> String {
    let slant = Rotation3::from_euler_angles(0.0, 0.5, 0.6);
    // Each has the directions that are right and up on the drawing.
    let viewpoints = [
        ("from above", -Vector3::y(), Vector3::x()),
        ("from the right", Vector3::x(), Vector3::z()),
        ("at a slant (drag to turn)", slant * -Vector3::y(), slant * Vector3::z()),
    ];
    let points = || truth.iter().chain(measured).flatten();
    let reach_m = points().map(Vector3::norm).fold(0.1, f64::max);
    let scale = 0.46 * SIDE / reach_m;
    let arm_m = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
        .into_iter()
        .rfind(|arm_m| *arm_m <= reach_m / 2.0)
        .unwrap_or(reach_m / 2.0);
    let drawings = viewpoints.map(|(name, right, up)| {
        let place = |point: &Vector3<f64>| {
            let (x, y) = (point.dot(&right), point.dot(&up));
            (SIDE / 2.0 + scale * x, SIDE / 2.0 - scale * y)
        };
        let mut svg = Svg::new(SIDE, SIDE);
        let arms = [("x", Vector3::x()), ("y", Vector3::y()), ("z", Vector3::z())];
        for (axis, arm) in arms {
            let end = arm * arm_m;
            svg.line(&[place(&Vector3::zeros()), place(&end)], &data("axis", &[end]));
            let (x, y) = place(&(end * 1.12));
            // An axis along the line of sight has no length and needs no name.
            let (x0, y0) = place(&Vector3::zeros());
            if (x - x0).hypot(y - y0) > 8.0 {
                let attributes =
                    format!(r#"text-anchor="middle" {}"#, data("label", &[end * 1.12]));
                svg.text((x, y + 4.5), &attributes, axis);
            }
        }
        for (class, pieces) in [("truth", truth), ("pose", measured)] {
            for piece in pieces {
                let line: Vec<_> = piece.iter().map(place).collect();
                svg.line(&line, &data(class, piece));
            }
        }
        let words = format!("{name}; arms of {arm_m} m");
        svg.text((8.0, SIDE - 8.0), "", &words);
        let turns = if name.contains("drag") {
            let numbers = |v: &Vector3<f64>| format!("{:.4} {:.4} {:.4}", v.x, v.y, v.z);
            format!(
                r#"class="turns" data-scale="{scale:.4}" data-right="{}" data-up="{}""#,
                numbers(&right),
                numbers(&up)
            )
        } else {
            String::new()
        };
        svg.finish_in_page(&format!("The path of {body} {name}"), &turns)
    });
    format!("<div class=\"paths\">{}</div>\n", drawings.concat())
}

/// A line's class, and its points in space for the script.
fn data(class: &str, points: &[Vector3<f64>]) -> String {
    let points: Vec<_> =
        points.iter().map(|p| format!("{:.3} {:.3} {:.3}", p.x, p.y, p.z)).collect();
    format!(r#"class="{class}" data-points="{}""#, points.join(","))
}

/// Turns the drawings of class `turns` with the mouse.
pub(super) const SCRIPT: &str = r#"
for (const svg of document.querySelectorAll("svg.turns")) {
  const vector = text => text.split(" ").map(Number);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const side = svg.viewBox.baseVal.width, scale = Number(svg.dataset.scale);
  let right = vector(svg.dataset.right), up = vector(svg.dataset.up);
  const shapes = [...svg.querySelectorAll("[data-points]")].map(
    shape => [shape, shape.dataset.points.split(",").map(vector)]);
  const place = p => [side / 2 + scale * dot(p, right), side / 2 - scale * dot(p, up)];
  const draw = () => {
    for (const [shape, points] of shapes) {
      const placed = points.map(place);
      if (shape.tagName === "text") {
        shape.setAttribute("x", placed[0][0]);
        shape.setAttribute("y", placed[0][1] + 4.5);
      } else {
        if (points.length === 1) placed.unshift([side / 2, side / 2]);
        shape.setAttribute("points", placed.map(p => p.join(",")).join(" "));
      }
    }
  };
  const turned = (v, axis, angle) => {
    const c = Math.cos(angle), s = Math.sin(angle), along = dot(v, axis) * (1 - c);
    const cross = [axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2],
                   axis[0] * v[1] - axis[1] * v[0]];
    return v.map((x, i) => x * c + cross[i] * s + axis[i] * along);
  };
  svg.addEventListener("pointerdown", event => svg.setPointerCapture(event.pointerId));
  svg.addEventListener("pointermove", event => {
    if (!event.buttons) return;
    const turn = -event.movementX * 0.01, tilt = -event.movementY * 0.01;
    [right, up] = [right, up].map(v => turned(v, [0, 0, 1], turn));
    up = turned(up, right, tilt);
    draw();
  });
}
"#;
