//! The shapes on a sheet, in millimetres from its top left corner.

use clap::ValueEnum;

/// Paper sizes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Paper {
    /// 210 x 297 mm.
    A4,
    /// 215.9 x 279.4 mm.
    Letter,
    /// 297 x 420 mm.
    A3,
}

impl Paper {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::A4 => "a4",
            Self::Letter => "letter",
            Self::A3 => "a3",
        }
    }

    /// Width and height, millimetres.
    pub(crate) fn size_mm(self) -> [f64; 2] {
        match self {
            Self::A4 => [210.0, 297.0],
            Self::Letter => [215.9, 279.4],
            Self::A3 => [297.0, 420.0],
        }
    }
}

/// A sheet, or a facet that is laid on it.
pub(super) struct PaperDrawing {
    /// Width and height, millimetres.
    pub size_mm: [f64; 2],
    /// The shapes, the lowest first. The background is white.
    pub shapes: Vec<Ink>,
}

/// A black area, a line or a text.
pub(super) enum Ink {
    /// A black area with holes: the loops are filled by the even-odd rule.
    Black(Vec<Vec<[f64; 2]>>),
    /// A closed grey line for cutting, 0.2 mm wide.
    Outline { corners: Vec<[f64; 2]> },
    /// A text, from the left end of its baseline.
    Text {
        /// Left end of the baseline, millimetres.
        at: [f64; 2],
        height_mm: f64,
        /// The text, ASCII only.
        text: String,
    },
}

impl Ink {
    /// The shape, moved by `x` and `y` millimetres.
    pub(super) fn moved(&self, [x, y]: [f64; 2]) -> Self {
        let place = |points: &[[f64; 2]]| points.iter().map(|p| [p[0] + x, p[1] + y]).collect();
        match self {
            Self::Black(loops) => Self::Black(loops.iter().map(|points| place(points)).collect()),
            Self::Outline { corners } => Self::Outline { corners: place(corners) },
            Self::Text { at, height_mm, text } => {
                Self::Text { at: [at[0] + x, at[1] + y], height_mm: *height_mm, text: text.clone() }
            }
        }
    }
}
