//! The way of a body round the observer, in space.

use nalgebra::{Rotation3, Vector3};

use crate::svg::Svg;

const SIDE: f64 = 300.0;

/// How the space is looked at: where its right and its up go on the drawing.
struct Look {
    name: &'static str,
    right: Vector3<f64>,
    up: Vector3<f64>,
}

/// One body's way, in pieces that are not joined.
pub(super) struct Ways {
    /// As it was.
    pub(super) truth: Vec<Vec<Vector3<f64>>>,
    /// As it was measured.
    pub(super) measured: Vec<Vec<Vector3<f64>>>,
}

/// The way as seen from above, from the right, and at a slant; the last can be turned with the
/// mouse where scripts run.
pub(super) fn draw(body: &str, ways: &Ways) -> String {
    let slant = Rotation3::from_euler_angles(0.0, 0.5, 0.6);
    let looks = [
        Look { name: "from above", right: -Vector3::y(), up: Vector3::x() },
        Look { name: "from the right", right: Vector3::x(), up: Vector3::z() },
        Look {
            name: "at a slant (drag to turn)",
            right: slant * -Vector3::y(),
            up: slant * Vector3::z(),
        },
    ];
    let points = || ways.truth.iter().chain(&ways.measured).flatten();
    let reach_m = points().map(Vector3::norm).fold(0.1, f64::max);
    let scale = 0.46 * SIDE / reach_m;
    let arm_m = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
        .into_iter()
        .rfind(|arm_m| *arm_m <= reach_m / 2.0)
        .unwrap_or(reach_m / 2.0);
    let drawings = looks.map(|look| {
        let place = |point: &Vector3<f64>| {
            let (x, y) = (point.dot(&look.right), point.dot(&look.up));
            (SIDE / 2.0 + scale * x, SIDE / 2.0 - scale * y)
        };
        let mut svg = Svg::new(SIDE, SIDE);
        let arms = [("x", Vector3::x()), ("y", Vector3::y()), ("z", Vector3::z())];
        for (name, arm) in arms {
            let end = arm * arm_m;
            svg.line(&[place(&Vector3::zeros()), place(&end)], &data("axis", &[end]));
            let (x, y) = place(&(end * 1.12));
            // An axis that is looked along has no length and needs no name.
            let (x0, y0) = place(&Vector3::zeros());
            if (x - x0).hypot(y - y0) > 8.0 {
                let attributes =
                    format!(r#"text-anchor="middle" {}"#, data("label", &[end * 1.12]));
                svg.text((x, y + 4.5), &attributes, name);
            }
        }
        for (class, pieces) in [("truth", &ways.truth), ("pose", &ways.measured)] {
            for piece in pieces {
                let line: Vec<_> = piece.iter().map(place).collect();
                svg.line(&line, &data(class, piece));
            }
        }
        let words = format!("{}; arms of {arm_m} m", look.name);
        svg.text((8.0, SIDE - 8.0), "", &words);
        let turns = if look.name.contains("drag") {
            let numbers = |v: &Vector3<f64>| format!("{:.4} {:.4} {:.4}", v.x, v.y, v.z);
            format!(
                r#"class="turns" data-scale="{scale:.4}" data-right="{}" data-up="{}""#,
                numbers(&look.right),
                numbers(&look.up)
            )
        } else {
            String::new()
        };
        svg.finish_in_page(&format!("The way of {body} {}", look.name), &turns)
    });
    format!("<div class=\"ways\">{}</div>\n", drawings.concat())
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
