//! Parameters of the detector, with the defaults that the stage uses.

use flockeye_contract::{Search, ViewKind};
use flockeye_dictionary::DictionaryError;
use flockeye_imaging::edges::CornerFit;

use crate::windows::{DarkerBy, Threshold, thresholds};

/// Parameters of the search for squares and of the acceptance of markers.
///
/// The defaults are those of a view at the sphere's own resolution. They were chosen on renderings
/// and on real panoramas without markers. There some squares pass for a marker by their cells
/// alone; their edges then distinguish them from print.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectorParameters {
    /// Markers with shorter sides are not searched for, pixels. At 11 px a cell of a marker with 5
    /// x 5 bits is hardly wider than the lens's blur.
    pub min_side_px: f64,
    /// The local thresholds. Each one finds squares that the others lose, for example where the
    /// shaded side of a marker joins something dark; each costs another pass over the view.
    pub thresholds: Vec<Threshold>,
    /// Largest deviation of an outline from a polygon with three of a square's corners, pixels.
    pub corner_accuracy_px: f64,
    /// Parts of the marker that are fitted to find its corners.
    pub corner_fit: CornerFit,
}

impl Default for DetectorParameters {
    fn default() -> Self {
        Self {
            min_side_px: 11.0,
            thresholds: thresholds(ViewKind::Partition, Search::AllWindows, 1.0).collect(),
            corner_accuracy_px: 2.0,
            corner_fit: CornerFit::default(),
        }
    }
}

/// Reason why a detector could not be made, or thresholds not set.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum DetectError {
    /// The dictionary could not be loaded.
    #[error(transparent)]
    Dictionary(#[from] DictionaryError),
    /// A parameter outside its range.
    #[error("{name} is {value}; it must be {allowed}")]
    Parameter { name: &'static str, value: f64, allowed: &'static str },
}

impl DetectorParameters {
    pub(crate) fn check(&self) -> Result<(), DetectError> {
        check_thresholds(self.thresholds.iter().copied())?;
        let rules = [
            ("min_side_px", self.min_side_px, self.min_side_px >= 8.0, "8 or more"),
            (
                "corner_accuracy_px",
                self.corner_accuracy_px,
                self.corner_accuracy_px > 0.0,
                "above 0",
            ),
        ];
        for (name, value, holds, allowed) in rules {
            if !holds || !value.is_finite() {
                return Err(DetectError::Parameter { name, value, allowed });
            }
        }
        Ok(())
    }
}

/// Refuses an empty list of thresholds, and thresholds that are invalid for every image.
pub(crate) fn check_thresholds(
    thresholds: impl Iterator<Item = Threshold>,
) -> Result<(), DetectError> {
    let refused = |name, value, allowed| Err(DetectError::Parameter { name, value, allowed });
    let mut is_empty = true;
    for threshold in thresholds {
        is_empty = false;
        if threshold.window_px < 3 || threshold.window_px.is_multiple_of(2) {
            return refused("window_px", threshold.window_px as f64, "odd, and 3 or more");
        }
        match threshold.darker_by {
            DarkerBy::Codes(0) => return refused("darker_by", 0.0, "1 code value or more"),
            DarkerBy::Percent(percent) if !(1..=99).contains(&percent) => {
                return refused("darker_by", percent.into(), "1 to 99 percent");
            }
            _ => {}
        }
    }
    if is_empty { refused("thresholds", 0.0, "one or more") } else { Ok(()) }
}
