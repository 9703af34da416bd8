//! SVG drawings of lines, texts and a few other elements.

use std::fmt::{self, Write};

/// A drawing to which elements are added.
pub(crate) struct Svg {
    body: String,
    width: f64,
    height: f64,
}

impl Svg {
    /// An empty drawing.
    pub(crate) fn new(width: f64, height: f64) -> Self {
        Self { body: String::new(), width, height }
    }

    /// Adds an element with its attributes. Text from outside must be [`escaped`].
    pub(crate) fn element(&mut self, element: fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        let _ = writeln!(self.body, "{element}");
    }

    /// Adds a line through two or more points. Fewer are ignored.
    pub(crate) fn line(&mut self, points: &[(f64, f64)], attributes: &str) {
        if points.len() > 1 {
            let points: Vec<_> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            let points = points.join(" ");
            self.element(format_args!(r#"<polyline points="{points}" fill="none" {attributes}/>"#));
        }
    }

    /// Adds a text.
    pub(crate) fn text(&mut self, (x, y): (f64, f64), attributes: &str, text: &str) {
        self.element(format_args!(r#"<text x="{x:.1}" y="{y:.1}" {attributes}>{text}</text>"#));
    }

    /// The drawing as an element of a page, in the page's colours. `label` describes it for screen
    /// readers; `attributes` are added to the element.
    pub(crate) fn finish_in_page(self, label: &str, attributes: &str) -> String {
        let Self { body, width, height } = self;
        format!(
            "<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{}\" {attributes}>\n\
             {body}</svg>\n",
            escaped(label)
        )
    }

    /// The drawing as a whole document with a white background.
    pub(crate) fn finish(self) -> String {
        let Self { body, width, height } = self;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
             font-family=\"sans-serif\" font-size=\"14\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n{body}</svg>\n"
        )
    }
}

/// A text with its special characters escaped, for HTML and SVG.
pub(crate) fn escaped(text: &str) -> String {
    maud::html!((text)).into_string()
}
