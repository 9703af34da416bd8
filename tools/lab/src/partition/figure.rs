//! The paper's figure "Pixel count and theta for different partitioning schemes".

use flockeye_geometry::partition::{Method, Partition, PartitionError, Terms};

use super::arguments::PartitionArguments;
use crate::svg::Svg;

const WIDTH: f64 = 960.0;
const HEIGHT: f64 = 560.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 930.0;
const TOP: f64 = 60.0;
const BOTTOM: f64 = 490.0;

/// The three configurations in the paper's table: N and theta, degrees.
const PAPERS_OWN: [(usize, f64); 3] = [(6, 110.0), (12, 74.0), (24, 62.0)];

/// Draws the pixels of all circles over the number of views, for both methods and the paper's three
/// partitions. The size of a point shows theta.
pub(super) fn draw(arguments: &PartitionArguments) -> Result<String, PartitionError> {
    let series = |method| -> Result<Vec<(usize, f64)>, PartitionError> {
        let found = arguments.counts.iter().map(|&count| {
            let partition = Partition::of(method, count, arguments.seed)?;
            Ok((count, partition.covering_diameter_rad().to_degrees()))
        });
        found.collect()
    };
    let (covering, paper) = (series(Method::Covering)?, series(Method::Paper)?);
    let axes = Axes::around(&[&covering, &paper, &PAPERS_OWN]);
    let mut svg = Svg::new(WIDTH, HEIGHT);
    axes.draw(&mut svg);
    let legend = [
        ("covering: the smallest circles", "#1f6fb4", &covering[..], 0.75),
        ("paper: spread points, then grow circles", "#e08a1e", &paper, 0.55),
        ("the paper's own table", "none", &PAPERS_OWN, 1.0),
    ];
    for (index, (name, colour, points, opacity)) in legend.into_iter().enumerate() {
        let stroke = if colour == "none" { "black" } else { colour };
        let style = format!(
            r#"fill="{colour}" fill-opacity="{opacity}" stroke="{stroke}" stroke-width="1.2""#
        );
        for &(count, theta_deg) in points {
            let (x, y) = axes.place(count, images(count, theta_deg));
            let radius = theta_deg / 10.0;
            svg.element(format_args!(
                r#"<circle cx="{x:.1}" cy="{y:.1}" r="{radius:.1}" {style}><title>N = {count}, theta = {theta_deg:.4} degrees</title></circle>"#
            ));
        }
        let y = TOP - 40.0 + 18.0 * index as f64;
        svg.element(format_args!(r#"<circle cx="560" cy="{}" r="6" {style}/>"#, y - 5.0));
        svg.text((575.0, y), "", name);
    }
    for (count, theta_deg) in PAPERS_OWN {
        let (x, y) = axes.place(count, images(count, theta_deg));
        svg.text((x, y + 30.0), r#"text-anchor="middle" font-size="12""#, &format!("{theta_deg}°"));
    }
    Ok(svg.finish())
}

/// The paper's p of N circles, in sphere images.
fn images(count: usize, theta_deg: f64) -> f64 {
    Terms::new(count, theta_deg.to_radians()).pixels
}

/// The ranges of N and p on the axes.
struct Axes {
    counts: (f64, f64),
    images: (f64, f64),
}

impl Axes {
    fn around(series: &[&[(usize, f64)]]) -> Self {
        let mut counts = (f64::INFINITY, f64::NEG_INFINITY);
        let mut span = (f64::INFINITY, f64::NEG_INFINITY);
        for &(count, theta_deg) in series.iter().copied().flatten() {
            let (n, p) = (count as f64, images(count, theta_deg));
            counts = (counts.0.min(n), counts.1.max(n));
            span = (span.0.min(p), span.1.max(p));
        }
        let step = 0.05;
        Self {
            counts: (counts.0 - 1.0, counts.1 + 1.0),
            images: ((span.0 / step).floor() * step - step, (span.1 / step).ceil() * step),
        }
    }

    fn place(&self, count: usize, images: f64) -> (f64, f64) {
        let along = (count as f64 - self.counts.0) / (self.counts.1 - self.counts.0);
        let up = (images - self.images.0) / (self.images.1 - self.images.0);
        (LEFT + along * (RIGHT - LEFT), BOTTOM - up * (BOTTOM - TOP))
    }

    fn draw(&self, svg: &mut Svg) {
        let grey = r##"stroke="#cccccc" stroke-width="0.8""##;
        let every = if self.counts.1 - self.counts.0 > 50.0 { 8 } else { 2 };
        let (first, last) = (self.counts.0.ceil() as usize, self.counts.1.floor() as usize);
        for count in (first..=last).filter(|count| count % every == 0) {
            let (x, _) = self.place(count, 0.0);
            svg.line(&[(x, TOP), (x, BOTTOM)], grey);
            svg.text((x, BOTTOM + 20.0), r#"text-anchor="middle""#, &count.to_string());
        }
        let steps = ((self.images.1 - self.images.0) / 0.05).round() as usize;
        for step in 0..=steps {
            let images = self.images.0 + 0.05 * step as f64;
            let (_, y) = self.place(0, images);
            svg.line(&[(LEFT, y), (RIGHT, y)], grey);
            svg.text((LEFT - 8.0, y + 5.0), r#"text-anchor="end""#, &format!("{images:.2}"));
        }
        svg.text(
            ((LEFT + RIGHT) / 2.0, BOTTOM + 45.0),
            r#"text-anchor="middle""#,
            "number of views N",
        );
        svg.text(
            (LEFT - 60.0, TOP - 22.0),
            "",
            "pixels of all circles, N θ²/360°², in sphere images (point size: θ)",
        );
    }
}
