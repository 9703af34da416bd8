//! Windows of the local threshold for the search of a view.

use flockeye_contract::{Search, ViewKind};

/// A pixel is dark if it is darker than its surroundings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Threshold {
    /// Side of the square of surroundings whose mean counts, pixels; odd. From 15 px on the square
    /// consists of blocks. Then it is up to a tenth smaller, and up to a fourteenth of its side off
    /// centre.
    pub window_px: usize,
    /// Least difference between the pixel and the mean.
    pub darker_by: DarkerBy,
}

/// Least difference between a dark pixel and a mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DarkerBy {
    /// This many code values; 1 or more.
    Codes(u8),
    /// This share of the mean, percent; 1 to 99. White in the shade is darker than white in the
    /// sun, but the difference is smaller than to black print.
    Percent(u8),
}

impl DarkerBy {
    /// The code value below which a pixel is dark where the mean is `mean`.
    #[inline(always)]
    pub(crate) fn limit(self, mean: u16) -> u16 {
        match self {
            Self::Codes(codes) => (mean + 1).saturating_sub(codes.into()),
            Self::Percent(percent) => {
                let by_share = mean * (100 - u16::from(percent)) / 100;
                by_share.min((mean + 1).saturating_sub(MIN_DARKER_CODES))
            }
        }
    }

    /// Least difference in code values between a square's inside and outside.
    pub(crate) fn codes(self) -> u8 {
        match self {
            Self::Codes(codes) => codes,
            Self::Percent(_) => LEAST_STEP_CODES,
        }
    }
}

/// Least difference of a dark pixel for any share, code values: in the dark, noise is a large
/// share.
const MIN_DARKER_CODES: u16 = 4;

/// Least step across the side of a square found by a share of the mean, code values.
const LEAST_STEP_CODES: u8 = 10;

/// A window, in pixels of the sphere's own resolution, and the least difference of a marker's pixel
/// from its mean.
type Window = (f64, DarkerBy);

/// Finds markers in the shade and beside dark things.
const FINE: Window = (7.0, DarkerBy::Codes(4));
/// Finds bright markers.
const COARSE: Window = (31.0, DarkerBy::Codes(10));

/// Finds markers whose corners touch something dark. Where both meet, blur makes a bridge that is
/// hardly darker than the mean.
const TOUCHING: Window = (7.0, DarkerBy::Percent(30));

/// Windows for proposals, finest first. On drawn markers of 14 to 30 px, in a hall and in a panorama, these two
/// have the most detections for their time: see docs/results/constants.md#threshold-windows.
const PROPOSAL_WINDOWS: &[Window] = &[FINE, COARSE];

/// Windows for tiles, finest first. Those between the first and the last are taken where time does
/// not matter. The one of 15 px finds markers in pictures that are far too dark, where white is only
/// some code values brighter than black; the next one finds markers that shadows cross.
const TILE_WINDOWS: &[Window] =
    &[FINE, TOUCHING, (15.0, DarkerBy::Codes(4)), (31.0, DarkerBy::Percent(30)), COARSE];

/// Windows for regions of interest, finest first. These views are few and small, and a neighbour is
/// expected in them, so more passes are worth their time.
const REGION_WINDOWS: &[Window] = &[
    (5.5, DarkerBy::Codes(4)),
    (7.5, DarkerBy::Codes(4)),
    TOUCHING,
    (15.0, DarkerBy::Codes(6)),
    (31.0, DarkerBy::Percent(30)),
    COARSE,
];

/// The widest window to each side of its middle, pixels of the view.
const MAX_REACH_PX: f64 = 500.0;

/// The thresholds for a view of this kind, cut with `magnification` pixels for each of the
/// sphere's.
///
/// Lens blur has a fixed size on the sphere, and so has the gap between a marker and its
/// surroundings. So windows grow with the magnification.
pub fn thresholds(
    kind: ViewKind,
    search: Search,
    magnification: f64,
) -> impl Iterator<Item = Threshold> + Clone {
    let windows = match kind {
        ViewKind::Partition | ViewKind::HighResolution => TILE_WINDOWS,
        ViewKind::Proposal => PROPOSAL_WINDOWS,
        ViewKind::Roi => REGION_WINDOWS,
    };
    let chosen = match search {
        Search::AllWindows => windows,
        Search::FineWindow => &windows[..1],
        Search::CoarseWindow => &windows[windows.len() - 1..],
        Search::Nothing => &[],
    };
    chosen.iter().map(move |&(window, darker_by)| {
        let reach_px = (window * magnification / 2.0).floor().clamp(1.0, MAX_REACH_PX);
        Threshold { window_px: 2 * reach_px as usize + 1, darker_by }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn windows_px(kind: ViewKind, search: Search, magnification: f64) -> Vec<usize> {
        thresholds(kind, search, magnification).map(|threshold| threshold.window_px).collect()
    }

    #[test]
    fn each_way_to_search_has_its_windows() {
        for kind in [ViewKind::Partition, ViewKind::HighResolution] {
            assert_eq!(windows_px(kind, Search::AllWindows, 1.0), [7, 7, 15, 31, 31]);
            assert_eq!(windows_px(kind, Search::FineWindow, 1.0), [7]);
            assert_eq!(windows_px(kind, Search::CoarseWindow, 1.0), [31]);
            assert!(windows_px(kind, Search::Nothing, 1.0).is_empty());
        }
        assert_eq!(windows_px(ViewKind::Proposal, Search::AllWindows, 1.0), [7, 31]);
        assert_eq!(windows_px(ViewKind::Roi, Search::AllWindows, 1.0), [5, 7, 7, 15, 31, 31]);
        assert_eq!(windows_px(ViewKind::Roi, Search::FineWindow, 1.0), [5]);
    }

    #[test]
    fn windows_grow_with_the_magnification_and_stay_odd() {
        assert_eq!(windows_px(ViewKind::Partition, Search::AllWindows, 2.0), [15, 15, 31, 63, 63]);
        for magnification in [0.0, 1e-9, 0.7, 3.3, 1e12, f64::INFINITY, f64::NAN] {
            let windows = windows_px(ViewKind::Roi, Search::AllWindows, magnification);
            let is_allowed = |window: &usize| window % 2 == 1 && (1..=1001).contains(window);
            assert!(windows.iter().all(is_allowed), "{magnification}: {windows:?}");
        }
    }
}
