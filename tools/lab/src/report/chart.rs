//! Points and lines over two axes.

use crate::svg::{Svg, escaped};

/// Width of a chart, units of the drawing.
const WIDTH: f64 = 860.0;
const LEFT: f64 = 74.0;
const RIGHT: f64 = 850.0;
const TOP: f64 = 34.0;
/// Below the frame: numbers and the axis' name.
const FOOT: f64 = 46.0;

/// How samples are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mark {
    /// Joined; each piece by itself.
    Line,
    /// A dot each.
    Dots,
}

/// Some samples.
pub(super) struct ChartSeries {
    /// What the legend calls them.
    pub(super) name: &'static str,
    /// Their class in the page's style: their colour.
    pub(super) class: &'static str,
    /// How they are shown.
    pub(super) mark: Mark,
    /// In pieces that are not joined.
    pub(super) pieces: Vec<Vec<(f64, f64)>>,
}

/// How numbers lie along an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    low: f64,
    high: f64,
    is_log: bool,
}

impl Axis {
    /// Evenly, round all values and at least `least` wide.
    pub(super) fn even(values: impl Iterator<Item = f64>, least: f64) -> Self {
        let (low, high) = span(values);
        let widen = ((least - (high - low)) / 2.0).max(0.03 * (high - low));
        Self { low: low - widen, high: high + widen, is_log: false }
    }

    /// By whole decades; values that have no logarithm are not shown.
    pub(super) fn decades(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = span(values.filter(|value| *value > 0.0).map(f64::log10));
        let (low, high) = (low.floor(), high.ceil());
        Self { low, high: high.max(low + 1.0), is_log: true }
    }

    /// Where a value lies, 0 to 1; `None` outside.
    fn place(&self, value: f64) -> Option<f64> {
        let value = if self.is_log { value.log10() } else { value };
        let share = (value - self.low) / (self.high - self.low);
        (-1e-9..=1.0 + 1e-9).contains(&share).then_some(share)
    }

    /// Numbers to write at it, with their text.
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

/// The smallest and the largest; 0 and 1 of nothing.
fn span(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let ends = values.filter(|value| value.is_finite()).fold(None, |ends, value| {
        let (low, high): (f64, f64) = ends.unwrap_or((value, value));
        Some((low.min(value), high.max(value)))
    });
    ends.unwrap_or((0.0, 1.0))
}

/// The next of 1, 2, 5, 10, 20, .. from a step on.
fn round_step(step: f64) -> f64 {
    let decade = 10f64.powf(step.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * decade >= step * 0.999);
    factor.unwrap_or(10.0) * decade
}

/// A chart.
pub(super) struct Chart {
    /// What it shows.
    pub(super) title: String,
    /// The horizontal axis and its name, with its unit.
    pub(super) x: (Axis, &'static str),
    /// The vertical axis and its name, with its unit.
    pub(super) y: (Axis, String),
    /// Height of the drawing.
    pub(super) height: f64,
    /// What is drawn, the first at the back.
    pub(super) series: Vec<ChartSeries>,
}

impl Chart {
    /// As an element of the page.
    pub(super) fn draw(&self) -> String {
        let mut svg = Svg::new(WIDTH, self.height);
        let bottom = self.height - FOOT;
        let across = |share: f64| LEFT + share * (RIGHT - LEFT);
        let up = |share: f64| bottom - share * (bottom - TOP);
        for (value, text) in self.x.0.ticks() {
            if let Some(x) = self.x.0.place(value).map(across) {
                svg.line(&[(x, TOP), (x, bottom)], r#"class="grid""#);
                svg.text((x, bottom + 18.0), r#"text-anchor="middle""#, &text);
            }
        }
        for (value, text) in self.y.0.ticks() {
            if let Some(y) = self.y.0.place(value).map(up) {
                svg.line(&[(LEFT, y), (RIGHT, y)], r#"class="grid""#);
                svg.text((LEFT - 8.0, y + 4.5), r#"text-anchor="end""#, &text);
            }
        }
        let frame = [(LEFT, TOP), (LEFT, bottom), (RIGHT, bottom)];
        svg.line(&frame, r#"class="axis""#);
        let middle = (TOP + bottom) / 2.0;
        let upright = format!(r#"text-anchor="middle" transform="rotate(-90 18 {middle:.1})""#);
        svg.text((18.0, middle), &upright, &escaped(&self.y.1));
        svg.text(((LEFT + RIGHT) / 2.0, self.height - 8.0), r#"text-anchor="middle""#, self.x.1);
        let mut legend = LEFT;
        for series in self.series.iter().filter(|series| !series.pieces.is_empty()) {
            self.draw_series(&mut svg, series, |(x, y)| {
                Some((across(self.x.0.place(x)?), up(self.y.0.place(y)?)))
            });
            draw_key(&mut svg, (legend, TOP - 15.0), series);
            legend += 40.0 + 8.0 * series.name.chars().count() as f64;
        }
        svg.finish_in_page(&self.title, "")
    }

    fn draw_series(
        &self,
        svg: &mut Svg,
        series: &ChartSeries,
        place: impl Fn((f64, f64)) -> Option<(f64, f64)>,
    ) {
        for piece in &series.pieces {
            let points: Vec<_> = piece.iter().copied().filter_map(&place).collect();
            match series.mark {
                Mark::Line => svg.line(&points, &format!(r#"class="{}""#, series.class)),
                Mark::Dots => points.iter().for_each(|&point| dot(svg, point, series.class)),
            }
        }
    }
}

fn draw_key(svg: &mut Svg, (x, y): (f64, f64), series: &ChartSeries) {
    match series.mark {
        Mark::Line => svg.line(&[(x, y), (x + 22.0, y)], &format!(r#"class="{}""#, series.class)),
        Mark::Dots => dot(svg, (x + 11.0, y), series.class),
    }
    svg.text((x + 28.0, y + 4.5), "", series.name);
}

/// A dot of a colour of the page.
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
