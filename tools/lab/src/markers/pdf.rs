//! Sheets as a minimal PDF (ISO 32000-1): no compression, the built-in Helvetica.

use std::fmt::Write;

use super::page::{Ink, PaperDrawing};

/// Points (1/72 inch) in a millimetre.
const POINTS_PER_MM: f64 = 72.0 / 25.4;

pub(super) fn document(pages: &[PaperDrawing]) -> Vec<u8> {
    // Object 1 is the catalogue, 2 the list of pages, 3 the font; then each page and its content.
    let kids: String = (0..pages.len()).map(|k| format!("{} 0 R ", 4 + 2 * k)).collect();
    let mut objects = vec![
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>".to_owned(),
        format!("<< /Type /Pages /Kids [ {kids}] /Count {} >>", pages.len()),
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>"
            .to_owned(),
    ];
    for (index, page) in pages.iter().enumerate() {
        let [width, height] = page.size_mm.map(|side| side * POINTS_PER_MM);
        let content = content(page);
        objects.push(format!(
            "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4} {height:.4}] \
             /Resources << /Font << /F1 3 0 R >> >> /Contents {} 0 R >>",
            5 + 2 * index
        ));
        objects.push(format!("<< /Length {} >>\nstream\n{content}endstream", content.len()));
    }
    let mut text = "%PDF-1.4\n".to_owned();
    let mut places = Vec::new();
    // Writing to a String cannot fail.
    for (index, object) in objects.iter().enumerate() {
        places.push(text.len());
        let _ = write!(text, "{} 0 obj\n{object}\nendobj\n", index + 1);
    }
    let (start, count) = (text.len(), objects.len() + 1);
    let _ = write!(text, "xref\n0 {count}\n0000000000 65535 f \n");
    for place in places {
        let _ = writeln!(text, "{place:010} 00000 n ");
    }
    let _ = write!(text, "trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n");
    text.into_bytes()
}

/// The operators that draw a page, in millimetres from its top left.
fn content(page: &PaperDrawing) -> String {
    let height = page.size_mm[1] * POINTS_PER_MM;
    let mut text = format!("{POINTS_PER_MM:.8} 0 0 {:.8} 0 {height:.4} cm\n", -POINTS_PER_MM);
    for shape in &page.shapes {
        let _ = match shape {
            Ink::Black(loops) => {
                let path: String = loops.iter().map(|points| path(points)).collect();
                writeln!(text, "0 g {path}f*")
            }
            Ink::Outline { corners } => writeln!(text, "0.2 w 0.53 G {}S", path(corners)),
            // Text is mirrored back, because the page's y axis points down.
            Ink::Text { at: [x, y], height_mm, text: words } => writeln!(
                text,
                "0 g BT /F1 {height_mm} Tf 1 0 0 -1 {x:.4} {y:.4} Tm ({}) Tj ET",
                escaped(words)
            ),
        };
    }
    text
}

fn path(points: &[[f64; 2]]) -> String {
    let mut path = String::new();
    for (index, [x, y]) in points.iter().enumerate() {
        let _ = write!(path, "{x:.4} {y:.4} {} ", if index == 0 { "m" } else { "l" });
    }
    path + "h "
}

/// Escapes a PDF text. Parentheses would end it, and only ASCII letters are encoded correctly.
fn escaped(text: &str) -> String {
    text.chars()
        .map(|letter| match letter {
            '(' | ')' | '\\' => format!("\\{letter}"),
            ' '..='~' => letter.to_string(),
            _ => "?".to_owned(),
        })
        .collect()
}
