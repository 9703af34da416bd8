//! The views of a frame whose pixels alignment reads: for each target the best one.
//!
//! Views stay in shared memory and are read in place. [`HeldViews`] only records which of them are
//! still held, because rectification cannot write to a held view.

use std::collections::BTreeMap;
use std::rc::Rc;

use flockeye_contract::ViewHeader;
use flockeye_geometry::body::Body;
use flockeye_geometry::search::StopRule;

use crate::record::Record;

/// The views of one frame that are held, with `P` the hold on their pixels.
#[derive(Debug)]
pub(crate) struct HeldViews<P> {
    /// Views without a record yet, by their place in the plan.
    pub(crate) unanswered: BTreeMap<u32, (ViewHeader, Rc<P>)>,
    /// The best view of each target.
    pub(crate) best: BTreeMap<usize, (ViewQuality, ViewHeader, Rc<P>)>,
}

/// Score of a view for a target. No two views of a frame are equal, so the best one does not depend
/// on their order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ViewQuality {
    /// Whether the view is this target's region of interest.
    pub(crate) is_own: bool,
    /// Whether the target has a track that is not stale. Then its region of interest comes first.
    pub(crate) is_followed: bool,
    /// Decoded markers of the target.
    pub(crate) decoded: u32,
    /// Its focal length, pixels.
    pub(crate) focal_px: f64,
    /// Distance of the target from its middle, as a tangent.
    pub(crate) off_centre: f64,
    /// Its place in the plan.
    pub(crate) view_index: u32,
}

impl ViewQuality {
    /// Score of a view for a body, from its detections. `is_own`: it is the body's region of
    /// interest. `is_followed`: the body has a track that is not stale. `None` if it is not the
    /// body's own region and shows no marker of it.
    pub(crate) fn of(
        record: &Record,
        view: &ViewHeader,
        body: &Body,
        is_own: bool,
        is_followed: bool,
        stop_rule: StopRule,
    ) -> Option<Self> {
        let middle = (f64::from(view.size_px) - 1.0) / 2.0;
        let of_body = record.markers.iter().filter(|marker| body.marker(marker.id).is_some());
        let decoded = of_body.clone().count() as u32;
        let corners = of_body.flat_map(|marker| marker.corners_in_view);
        let sum =
            corners.fold([0.0; 2], |sum, [u, v]| [sum[0] + f64::from(u), sum[1] + f64::from(v)]);
        let count = 4.0 * f64::from(decoded);
        if !is_own && decoded == 0 {
            return None;
        }
        let view_index = view.view_index;
        Some(match stop_rule {
            StopRule::All | StopRule::Deadline => {
                let off_px = match decoded {
                    0 => 0.0,
                    _ => (sum[0] / count - middle).hypot(sum[1] / count - middle),
                };
                let (focal_px, off_centre) = (view.focal_px, off_px / view.focal_px);
                Self { is_own, is_followed, decoded, focal_px, off_centre, view_index }
            }
            // Views beyond the first hit are ignored, so the earliest view must win.
            StopRule::FirstHit => {
                let (decoded, focal_px, off_centre) = (0, 0.0, 0.0);
                let is_own = false;
                Self { is_own, is_followed, decoded, focal_px, off_centre, view_index }
            }
        })
    }

    fn is_above(&self, other: &Self) -> bool {
        (self.is_own && self.is_followed)
            .cmp(&(other.is_own && other.is_followed))
            .then(self.decoded.cmp(&other.decoded))
            .then(self.is_own.cmp(&other.is_own))
            .then(self.focal_px.total_cmp(&other.focal_px))
            .then(other.off_centre.total_cmp(&self.off_centre))
            .then(other.view_index.cmp(&self.view_index))
            .is_gt()
    }
}

impl<P> Default for HeldViews<P> {
    fn default() -> Self {
        Self { unanswered: BTreeMap::new(), best: BTreeMap::new() }
    }
}

impl<P> HeldViews<P> {
    /// Holds a view that was cut.
    pub(crate) fn add(&mut self, header: ViewHeader, pixels: P) {
        self.unanswered.insert(header.view_index, (header, Rc::new(pixels)));
    }

    /// Records the arrival of a view's record. `shows` are its scores for targets. It stays held
    /// for those that it shows best.
    pub(crate) fn answered(&mut self, view_index: u32, shows: &[(usize, ViewQuality)]) {
        let Some((header, pixels)) = self.unanswered.remove(&view_index) else { return };
        for &(target, quality) in shows {
            let known = self.best.get(&target);
            if known.is_none_or(|(known, ..)| quality.is_above(known)) {
                self.best.insert(target, (quality, header, pixels.clone()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(view_index: u32) -> ViewHeader {
        ViewHeader { view_index, ..ViewHeader::default() }
    }

    fn quality(is_own: bool, focal_px: f64, off_centre: f64, view_index: u32) -> ViewQuality {
        let is_followed = true;
        ViewQuality { is_own, is_followed, decoded: 0, focal_px, off_centre, view_index }
    }

    #[test]
    fn the_best_view_does_not_depend_on_the_order_of_records() {
        let qualities = [
            quality(false, 611.0, 0.3, 0),
            quality(false, 611.0, 0.1, 1),
            quality(true, 900.0, 0.2, 2),
            quality(false, 1200.0, 0.0, 3),
        ];
        for turn in 0..4 {
            let mut held = HeldViews::default();
            (0..4).for_each(|index| held.add(header(index), index));
            for k in 0..4 {
                let index = (k + turn) % 4;
                held.answered(index as u32, &[(7, qualities[index])]);
            }
            let best = held.best.iter().map(|(target, (_, _, pixels))| (*target, **pixels));
            let best: Vec<_> = best.collect();
            assert_eq!(best, [(7, 2)]);
        }
    }

    #[test]
    fn markers_elsewhere_rank_above_the_region_of_a_stale_target() {
        let own = quality(true, 900.0, 0.0, 0);
        let markers = ViewQuality { decoded: 1, ..quality(false, 1200.0, 0.0, 1) };
        assert!(own.is_above(&markers), "a followed target is in its region");
        let [own, markers] =
            [own, markers].map(|quality| ViewQuality { is_followed: false, ..quality });
        assert!(markers.is_above(&own));
    }
}
