//! Layout of facets on sheets.

use super::page::{Ink, Paper, PaperDrawing};

/// The margin of the sheet, which printers leave white, and the space between facets.
const MARGIN_MM: f64 = 10.0;
const GAP_MM: f64 = 4.0;
/// Room for the title above and for the ruler below.
const TITLE_MM: f64 = 12.0;
const RULER_MM: f64 = 14.0;

/// Lays the pieces in rows, in their order, on as many sheets as it takes.
pub(super) fn pages(
    pieces: &[(String, PaperDrawing)],
    title: &str,
    paper: Paper,
) -> anyhow::Result<Vec<PaperDrawing>> {
    let size = paper.size_mm();
    let room = [size[0] - 2.0 * MARGIN_MM, size[1] - 2.0 * MARGIN_MM - TITLE_MM - RULER_MM];
    let top_left = [MARGIN_MM, MARGIN_MM + TITLE_MM];
    let mut sheets: Vec<Vec<Ink>> = Vec::new();
    // The next piece's place, and the height of the row so far.
    let (mut at, mut row_height) = ([0.0, f64::INFINITY], 0.0f64);
    for (name, piece) in pieces {
        let [width, height] = piece.size_mm;
        if width > room[0] || height > room[1] {
            let larger = if paper == Paper::A3 { "" } else { ": try --paper a3" };
            anyhow::bail!(
                "the facet '{name}' takes {width:.0} x {height:.0} mm, a sheet of {} has room for \
                 {:.0} x {:.0} mm{larger}",
                paper.name(),
                room[0],
                room[1]
            );
        }
        if at[0] + width > room[0] {
            at = [0.0, at[1] + row_height + GAP_MM];
            row_height = 0.0;
        }
        if at[1] + height > room[1] {
            sheets.push(Vec::new());
            (at, row_height) = ([0.0, 0.0], 0.0);
        }
        if let Some(sheet) = sheets.last_mut() {
            let place = [top_left[0] + at[0], top_left[1] + at[1]];
            sheet.extend(piece.shapes.iter().map(|shape| shape.moved(place)));
        }
        at[0] += width + GAP_MM;
        row_height = row_height.max(height);
    }
    let count = sheets.len();
    let finished = sheets.into_iter().enumerate().map(|(index, mut shapes)| {
        let number = format!("sheet {} of {count}", index + 1);
        shapes.extend(frame(size, title, &number));
        PaperDrawing { size_mm: size, shapes }
    });
    Ok(finished.collect())
}

/// The title, and a ruler that shows whether the printer kept the scale.
fn frame([_, height]: [f64; 2], title: &str, number: &str) -> Vec<Ink> {
    let text = |at, height_mm, text: String| Ink::Text { at, height_mm, text };
    let mut shapes = vec![
        text([MARGIN_MM, MARGIN_MM + 3.5], 3.5, title.to_owned()),
        text(
            [MARGIN_MM, MARGIN_MM + 8.0],
            2.5,
            format!("{number}. Print at 100 %. Cut along the lines, glue with the arrows up."),
        ),
    ];
    // A line of 100 mm with every other centimetre black.
    let ground = height - MARGIN_MM - 4.0;
    let block = |from: f64, to: f64| {
        let [left, right] = [from, to].map(|x| MARGIN_MM + x);
        vec![[left, ground - 2.0], [right, ground - 2.0], [right, ground], [left, ground]]
    };
    let blacks = (0..5).map(|k| block(20.0 * f64::from(k), 20.0 * f64::from(k) + 10.0));
    shapes.push(Ink::Black(blacks.collect()));
    shapes.push(Ink::Outline { corners: block(0.0, 100.0) });
    shapes.push(text(
        [MARGIN_MM, ground + 3.5],
        2.5,
        "this ruler is 100.0 mm long; if it is not, the printer scaled the sheet".to_owned(),
    ));
    shapes
}
