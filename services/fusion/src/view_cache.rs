//! The views whose pixels alignment reads: for each target in a frame, the best one.
//!
//! Views stay in shared memory and are read in place. The cache only says which of them are still
//! held, because each held view is one that rectification cannot write to.

use std::collections::BTreeMap;
use std::rc::Rc;

use flockeye_contract::{FrameOrder, ViewHeader};
use flockeye_geometry::body::Body;
use flockeye_geometry::search::StopRule;

use crate::frame_assembly::Record;
use crate::measurement::{agreeing_candidates, candidate_rays};

/// Held views, with `P` the hold on their pixels.
#[derive(Debug)]
pub struct ViewCache<P> {
    /// Views without a record yet, by frame and place in the plan.
    unanswered: BTreeMap<(FrameOrder, u32), (ViewHeader, Rc<P>)>,
    /// The best view of each target in a frame.
    best: BTreeMap<(FrameOrder, usize), CachedView<P>>,
    max_unanswered: usize,
    max_best: usize,
}

#[derive(Debug)]
struct CachedView<P> {
    quality: ViewQuality,
    header: ViewHeader,
    pixels: Rc<P>,
}

/// How much a view shows of a target. No two views of a frame are equal, so the best one does not
/// depend on the order in which they come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewQuality {
    /// Whether it is this target's region of interest.
    pub is_own: bool,
    /// Decoded markers of the target. Squares that only look like markers are found in many views, so
    /// they do not count.
    pub decoded: u32,
    /// Squares that only look like its markers and agree with one pose of it, where nothing was decoded and there is no
    /// track.
    pub agreeing: u32,
    /// Its focal length, pixels.
    pub focal_px: f64,
    /// How far from its middle the target is, as a tangent.
    pub off_centre: f64,
    /// Its place in the plan.
    pub view_index: u32,
}

impl ViewQuality {
    /// How well a view shows a body, by what was found in it. `None` where it is not the body's own
    /// region and shows no marker of it.
    pub fn of(
        record: &Record,
        view: &ViewHeader,
        body: &Body,
        is_own: bool,
        is_tracked: bool,
        stop_rule: StopRule,
    ) -> Option<Self> {
        let middle = (f64::from(view.size_px) - 1.0) / 2.0;
        let of_body = record.markers.iter().filter(|marker| body.marker(marker.id).is_some());
        let decoded = of_body.clone().filter(|marker| marker.is_decoded()).count() as u32;
        let counted = of_body.filter(|marker| marker.is_decoded() || decoded == 0);
        let agreeing = match decoded == 0 && !is_tracked {
            true => agreeing_candidates(body, &candidate_rays(body, &record.markers)),
            false => 0,
        };
        let (mut sum, mut count) = ([0.0; 2], 0.0);
        for [u, v] in counted.flat_map(|marker| marker.corners_in_view) {
            sum = [sum[0] + f64::from(u), sum[1] + f64::from(v)];
            count += 1.0;
        }
        if !is_own && count == 0.0 {
            return None;
        }
        let view_index = view.view_index;
        Some(match stop_rule {
            StopRule::All | StopRule::Deadline => {
                let off_px = match count {
                    0.0 => 0.0,
                    _ => (sum[0] / count - middle).hypot(sum[1] / count - middle),
                };
                let (focal_px, off_centre) = (view.focal_px, off_px / view.focal_px);
                Self { is_own, decoded, agreeing, focal_px, off_centre, view_index }
            }
            // Views beyond the first hit count for nothing, so the earliest view must win.
            StopRule::FirstHit => {
                let (decoded, agreeing, focal_px, off_centre) = (0, 0, 0.0, 0.0);
                Self { is_own: false, decoded, agreeing, focal_px, off_centre, view_index }
            }
        })
    }

    fn is_above(&self, other: &Self) -> bool {
        self.is_own
            .cmp(&other.is_own)
            .then(self.decoded.cmp(&other.decoded))
            .then(self.agreeing.cmp(&other.agreeing))
            .then(self.focal_px.total_cmp(&other.focal_px))
            .then(other.off_centre.total_cmp(&self.off_centre))
            .then(other.view_index.cmp(&self.view_index))
            .is_gt()
    }
}

impl<P> ViewCache<P> {
    /// Holds at most `max_unanswered` views without a record, and `max_best` with one.
    pub fn new(max_unanswered: usize, max_best: usize) -> Self {
        Self { unanswered: BTreeMap::new(), best: BTreeMap::new(), max_unanswered, max_best }
    }

    /// Holds a view that was cut. Where there are too many without a record, the oldest are released.
    pub fn add(&mut self, header: ViewHeader, pixels: P) {
        self.unanswered
            .insert((header.stamp.order(), header.view_index), (header, Rc::new(pixels)));
        while self.unanswered.len() > self.max_unanswered {
            self.unanswered.pop_first();
        }
    }

    /// Whether one more view would release the oldest.
    pub fn is_full(&self) -> bool {
        self.unanswered.len() >= self.max_unanswered
    }

    /// A held view without a record yet, with its pixels.
    pub fn unanswered(&self, order: FrameOrder, view_index: u32) -> Option<(&ViewHeader, &P)> {
        self.unanswered.get(&(order, view_index)).map(|(header, pixels)| (header, &**pixels))
    }

    /// Notes that a view's record has come. `shows` are the targets that it shows, and how well. It stays
    /// held for those that it shows best.
    pub fn answered(&mut self, order: FrameOrder, view_index: u32, shows: &[(usize, ViewQuality)]) {
        let Some((header, pixels)) = self.unanswered.remove(&(order, view_index)) else { return };
        for &(target, quality) in shows {
            let known = self.best.get(&(order, target));
            if known.is_none_or(|known| quality.is_above(&known.quality)) {
                let cached = CachedView { quality, header, pixels: pixels.clone() };
                self.best.insert((order, target), cached);
            }
        }
        // Newer frames give way to a stalled one: their targets are measured without pixels.
        while self.best.len() > self.max_best {
            self.best.pop_last();
        }
    }

    /// The best views of a frame's targets, and how good they are.
    pub fn best_of(
        &self,
        order: FrameOrder,
    ) -> impl Iterator<Item = (usize, &ViewQuality, &ViewHeader, &P)> {
        self.best.range((order, 0)..=(order, usize::MAX)).map(|(&(_, target), cached)| {
            (target, &cached.quality, &cached.header, &*cached.pixels)
        })
    }

    /// Releases a target's best view in a frame, because the target is measured.
    pub fn release(&mut self, order: FrameOrder, target: usize) {
        self.best.remove(&(order, target));
    }

    /// Releases all views up to and with this frame.
    pub fn release_until(&mut self, order: FrameOrder) {
        self.unanswered.retain(|(of, _), _| *of > order);
        self.best.retain(|(of, _), _| *of > order);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::FrameStamp;

    fn header(sequence: u64, view_index: u32) -> ViewHeader {
        let stamp = FrameStamp { sequence, ..FrameStamp::default() };
        ViewHeader { stamp, view_index, ..ViewHeader::default() }
    }

    fn quality(is_own: bool, focal_px: f64, off_centre: f64, view_index: u32) -> ViewQuality {
        ViewQuality { is_own, decoded: 0, agreeing: 0, focal_px, off_centre, view_index }
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
            let mut cache = ViewCache::new(8, 8);
            (0..4).for_each(|index| cache.add(header(5, index), index));
            for k in 0..4 {
                let index = (k + turn) % 4;
                cache.answered((0, 0, 5), index as u32, &[(7, qualities[index])]);
            }
            let best: Vec<_> =
                cache.best_of((0, 0, 5)).map(|(target, _, _, pixels)| (target, *pixels)).collect();
            assert_eq!(best, [(7, 2)]);
        }
    }

    #[test]
    fn decoded_markers_rank_above_squares_that_look_like_markers() {
        let squares = quality(false, 1200.0, 0.0, 0);
        let markers = ViewQuality { decoded: 1, ..quality(false, 611.0, 0.4, 1) };
        assert!(markers.is_above(&squares) && !squares.is_above(&markers));
        let agreeing = ViewQuality { agreeing: 2, ..quality(false, 611.0, 0.4, 2) };
        assert!(agreeing.is_above(&squares) && markers.is_above(&agreeing));
    }

    #[test]
    fn views_that_no_target_needs_are_released() {
        let mut cache = ViewCache::new(3, 2);
        let pixels = Rc::new(());
        for index in 0..5 {
            cache.add(header(1, index), pixels.clone());
        }
        assert_eq!(Rc::strong_count(&pixels), 4, "three are unanswered");
        cache.answered((0, 0, 1), 2, &[]);
        assert_eq!(Rc::strong_count(&pixels), 3, "it shows no target");
        cache.answered((0, 0, 1), 3, &[(0, quality(true, 1.0, 0.0, 3))]);
        assert_eq!(Rc::strong_count(&pixels), 3, "it shows a target");
        cache.release_until((0, 0, 1));
        assert_eq!(Rc::strong_count(&pixels), 1);
    }

    #[test]
    fn newer_frames_give_way_to_the_oldest() {
        let mut cache = ViewCache::new(8, 2);
        for sequence in 1..5 {
            cache.add(header(sequence, 0), sequence);
            cache.answered((0, 0, sequence), 0, &[(0, quality(true, 1.0, 0.0, 0))]);
        }
        assert_eq!(cache.best_of((0, 0, 1)).count(), 1);
        assert_eq!(cache.best_of((0, 0, 4)).count(), 0);
    }
}
