//! Charts with points and lines over two axes.

use crate::svg::{Svg, escaped};

/// Width of a chart, units of the drawing.
const WIDTH: f64 = 860.0;
const LEFT: f64 = 74.0;
const RIGHT: f64 = 850.0;
const TOP: f64 = 34.0;
/// Height below the frame, for numbers and the name of the axis.
const FOOT: f64 = 46.0;

/// The mark of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mark {
    /// A line for each piece.
    Line,
    /// A dot for each sample.
    Dots,
}

/// A series of samples.
pub(super) struct ChartSeries {
    /// Name in the legend.
    pub(super) name: &'static str,
    /// Class in the page's style, which sets the colour.
    pub(super) class: &'static str,
    /// Mark of the samples.
    pub(super) mark: Mark,
    /// The samples in pieces, which are not connected.
    pub(super) pieces: Vec<Vec<(f64, f64)>>,
}

/// The scale of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    low: f64,
    high: f64,
    is_log: bool,
}

impl Axis {
    /// A linear scale that contains all values and is at least `least` wide.
    pub(super) fn even(values: impl Iterator<Item = f64>, least: f64) -> Self {
        let (low, high) = span(values);
        let widen = ((least - (high - low)) / 2.0).max(0.03 * (high - low));
        Self { low: low - widen, high: high + widen, is_log: false }
    }

    /// A logarithmic scale of whole decades. Values without a logarithm are not shown.
    pub(super) fn decades(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = span(values.filter(|value| *value > 0.0).map(f64::log10));
        let (low, high) = (low.floor(), high.ceil());
        Self { low, high: high.max(low + 1.0), is_log: true }
    }

    /// Position of a value on the axis, 0 to 1; `None` outside.
    fn place(&self, value: f64) -> Option<f64> {
        let value = if self.is_log { value.log10() } else { value };
        let share = (value - self.low) / (self.high - self.low);
        (-1e-9..=1.0 + 1e-9).contains(&share).then_some(share)
    }

    /// The labelled values of the axis, with their texts.
    fn ticks(&self) -> Vec<(f64, String)> {
        if self.is_log {
            let decades = self.low as i32..=self.high as i32;
            let tick = |decade: i32| {
                let digits = decade.min(0).unsigned_abs() as usize;
                (10f64.powi(decade), format!("{:.digits$}", 10f64.powi(decade)))
            };
            return decades.map(tick).collect();
        }
        let step = round_step((self.high - self.low) / 6.0);
        let digits = (-step.log10().floor()).max(0.0) as usize;
        let (first, last) = ((self.low / step).ceil() as i64, (self.high / step).floor() as i64);
        (first..=last)
            .map(|k| k as f64 * step)
            .map(|value| (value, format!("{:.digits$}", if value == 0.0 { 0.0 } else { value })))
            .collect()
    }
}

/// The smallest and the largest value; 0 and 1 without values.
fn span(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let ends = values.filter(|value| value.is_finite()).fold(None, |ends, value| {
        let (low, high): (f64, f64) = ends.unwrap_or((value, value));
        Some((low.min(value), high.max(value)))
    });
    ends.unwrap_or((0.0, 1.0))
}

/// The next number of 1, 2, 5, 10, 20, .. that is not smaller than a step.
fn round_step(step: f64) -> f64 {
    let decade = 10f64.powf(step.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * decade >= step * 0.999);
    factor.unwrap_or(10.0) * decade
}

/// Draws series over two axes as an element of the page, the first series at the back. The name of
/// each axis contains its unit.
pub(super) fn draw(
    title: &str,
    (x_axis, x_name): (Axis, &str),
    (y_axis, y_name): (Axis, &str),
    height: f64,
    series: &[ChartSeries],
) -> String {
    let mut svg = Svg::new(WIDTH, height);
    let bottom = height - FOOT;
    let across = |share: f64| LEFT + share * (RIGHT - LEFT);
    let up = |share: f64| bottom - share * (bottom - TOP);
    for (value, text) in x_axis.ticks() {
        if let Some(x) = x_axis.place(value).map(across) {
            svg.line(&[(x, TOP), (x, bottom)], r#"class="grid""#);
            svg.text((x, bottom + 18.0), r#"text-anchor="middle""#, &text);
        }
    }
    for (value, text) in y_axis.ticks() {
        if let Some(y) = y_axis.place(value).map(up) {
            svg.line(&[(LEFT, y), (RIGHT, y)], r#"class="grid""#);
            svg.text((LEFT - 8.0, y + 4.5), r#"text-anchor="end""#, &text);
        }
    }
    let frame = [(LEFT, TOP), (LEFT, bottom), (RIGHT, bottom)];
    svg.line(&frame, r#"class="axis""#);
    let middle = (TOP + bottom) / 2.0;
    let upright = format!(r#"text-anchor="middle" transform="rotate(-90 18 {middle:.1})""#);
    svg.text((18.0, middle), &upright, &escaped(y_name));
    svg.text(((LEFT + RIGHT) / 2.0, height - 8.0), r#"text-anchor="middle""#, x_name);
    let mut legend = LEFT;
    for series in series.iter().filter(|series| !series.pieces.is_empty()) {
        let place = |&(x, y): &(f64, f64)| Some((across(x_axis.place(x)?), up(y_axis.place(y)?)));
        for piece in &series.pieces {
            let points: Vec<_> = piece.iter().filter_map(place).collect();
            match series.mark {
                Mark::Line => svg.line(&points, &format!(r#"class="{}""#, series.class)),
                Mark::Dots => points.iter().for_each(|&point| dot(&mut svg, point, series.class)),
            }
        }
        draw_key(&mut svg, (legend, TOP - 15.0), series);
        legend += 40.0 + 8.0 * series.name.chars().count() as f64;
    }
    svg.finish_in_page(title, "")
}

fn draw_key(svg: &mut Svg, (x, y): (f64, f64), series: &ChartSeries) {
    match series.mark {
        Mark::Line => svg.line(&[(x, y), (x + 22.0, y)], &format!(r#"class="{}""#, series.class)),
        Mark::Dots => dot(svg, (x + 11.0, y), series.class),
    }
    svg.text((x + 28.0, y + 4.5), "", series.name);
}

/// Draws a dot in the colour of a class.
fn dot(svg: &mut Svg, (x, y): (f64, f64), class: &str) {
    svg.element(format_args!(r#"<circle cx="{x:.1}" cy="{y:.1}" r="1.9" class="{class}"/>"#));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_few() {
        let texts = |axis: Axis| axis.ticks().into_iter().map(|(_, text)| text).collect::<Vec<_>>();
        assert_eq!(
            texts(Axis { low: -0.07, high: 1.1, is_log: false }),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
        assert_eq!(
            texts(Axis { low: -3.0, high: 40.0, is_log: false }),
            ["0", "10", "20", "30", "40"]
        );
        assert_eq!(texts(Axis::decades([0.4, 35.0].into_iter())), ["0.1", "1", "10", "100"]);
        for width in [1e-6, 0.3, 1.0, 7.0, 999.0, 1e5] {
            let ticks = Axis::even([2.0, 2.0 + width].into_iter(), 0.0).ticks();
            assert!((3..=8).contains(&ticks.len()), "{width}: {ticks:?}");
        }
    }

    #[test]
    fn values_lie_between_the_ends() {
        let axis = Axis::even([1.0, 3.0].into_iter(), 4.0);
        assert_eq!(
            (axis.place(0.0), axis.place(2.0), axis.place(4.5)),
            (Some(0.0), Some(0.5), None)
        );
        let decades = Axis::decades([1.0, 10.0].into_iter());
        assert_eq!((decades.place(1.0), decades.place(10.0)), (Some(0.0), Some(1.0)));
        assert_eq!((decades.place(0.0), decades.place(-1.0)), (None, None));
        // Nothing at all still has axes.
        assert!(!Axis::even(std::iter::empty(), 0.0).ticks().is_empty());
        assert!(!Axis::decades([0.0].into_iter()).ticks().is_empty());
    }
}
