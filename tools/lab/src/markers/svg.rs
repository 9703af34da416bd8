//! A sheet as SVG. A user unit is a millimetre.

use std::fmt::Write;

use super::page::{Ink, PaperDrawing};
use crate::svg::escaped;

pub(super) fn document(page: &PaperDrawing) -> String {
    let [width, height] = page.size_mm;
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" \
         viewBox=\"0 0 {width} {height}\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    for shape in &page.shapes {
        // Writing to a String cannot fail.
        let _ = match shape {
            Ink::Black(loops) => {
                let path: String = loops.iter().map(|points| path(points)).collect();
                writeln!(text, "<path fill=\"black\" fill-rule=\"evenodd\" d=\"{path}\"/>")
            }
            Ink::Outline { corners } => writeln!(
                text,
                "<path fill=\"none\" stroke=\"#888\" stroke-width=\"0.2\" d=\"{}\"/>",
                path(corners)
            ),
            Ink::Text { at: [x, y], height_mm, text: words } => writeln!(
                text,
                "<text x=\"{x:.3}\" y=\"{y:.3}\" font-family=\"Helvetica, Arial, sans-serif\" \
                 font-size=\"{height_mm}\">{}</text>",
                escaped(words)
            ),
        };
    }
    text.push_str("</svg>\n");
    text
}

fn path(points: &[[f64; 2]]) -> String {
    let mut path = String::new();
    for (index, [x, y]) in points.iter().enumerate() {
        let _ = write!(path, "{}{x:.4} {y:.4}", if index == 0 { "M" } else { "L" });
    }
    path + "Z"
}
