//! The views whose pixels fusion looks into: for each neighbour in a frame, the best one.
//!
//! Views stay in shared memory and are read in place; here is only which of them are still held.

use std::collections::BTreeMap;
use std::rc::Rc;

use flockeye_contract::ViewHeader;
use flockeye_geometry::body::Body;
use flockeye_geometry::search::StopRule;

use crate::assembly::Record;

/// A frame's place among all frames.
pub type FrameOrder = (u32, u32, u64);

/// Held views, with `P` the hold on their pixels.
#[derive(Debug)]
pub struct Gallery<P> {
    /// Views that were not answered yet, by frame and place in the plan.
    waiting: BTreeMap<(FrameOrder, u32), (ViewHeader, Rc<P>)>,
    /// The best view of each neighbour in a frame.
    best: BTreeMap<(FrameOrder, usize), Hung<P>>,
    waiting_most: usize,
    best_most: usize,
}

#[derive(Debug)]
struct Hung<P> {
    rank: Rank,
    header: ViewHeader,
    pixels: Rc<P>,
}

/// How much a view shows of a neighbour. Views of a frame may come in any order, so no two are
/// equal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rank {
    /// Whether it was cut for this neighbour.
    pub is_own: bool,
    /// Markers of the neighbour that were decoded in it: squares that only look like some are found
    /// in many views.
    pub decoded: u32,
    /// Its focal length, pixels.
    pub focal_px: f64,
    /// How far from its middle the neighbour is, as a tangent.
    pub off_centre: f64,
    /// Its place in the plan.
    pub view_index: u32,
}

impl Rank {
    /// How well a view shows a body, by what was found in it; `None` where it is not its own and shows
    /// no marker of it.
    pub fn of(
        record: &Record,
        view: &ViewHeader,
        body: &Body,
        is_own: bool,
        stop_rule: StopRule,
    ) -> Option<Self> {
        let middle = (f64::from(view.size_px) - 1.0) / 2.0;
        let of_body = record.markers.iter().filter(|marker| body.marker(marker.id).is_some());
        let decoded = of_body.clone().filter(|marker| marker.is_decoded()).count() as u32;
        let counted = of_body.filter(|marker| marker.is_decoded() || decoded == 0);
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
                Self { is_own, decoded, focal_px, off_centre, view_index }
            }
            // What is searched beyond the first hit must not take its place.
            StopRule::FirstHit => {
                Self { is_own: false, decoded: 0, focal_px: 0.0, off_centre: 0.0, view_index }
            }
        })
    }

    fn is_above(&self, other: &Self) -> bool {
        self.is_own
            .cmp(&other.is_own)
            .then(self.decoded.cmp(&other.decoded))
            .then(self.focal_px.total_cmp(&other.focal_px))
            .then(other.off_centre.total_cmp(&self.off_centre))
            .then(other.view_index.cmp(&self.view_index))
            .is_gt()
    }
}

impl<P> Gallery<P> {
    /// Holds at most so many views that were not answered, and so many that were.
    pub fn new(waiting_most: usize, best_most: usize) -> Self {
        Self { waiting: BTreeMap::new(), best: BTreeMap::new(), waiting_most, best_most }
    }

    /// A view was issued. Of too many that wait, the oldest are let go.
    pub fn add(&mut self, header: ViewHeader, pixels: P) {
        self.waiting.insert((header.stamp.order(), header.view_index), (header, Rc::new(pixels)));
        while self.waiting.len() > self.waiting_most {
            self.waiting.pop_first();
        }
    }

    /// Whether the next view would push out the oldest.
    pub fn is_full(&self) -> bool {
        self.waiting.len() >= self.waiting_most
    }

    /// Whether this view is held and was not answered yet.
    pub fn is_waiting(&self, order: FrameOrder, view_index: u32) -> bool {
        self.waiting.contains_key(&(order, view_index))
    }

    /// A view that is held and was not answered yet, with its pixels.
    pub fn waiting(&self, order: FrameOrder, view_index: u32) -> Option<(&ViewHeader, &P)> {
        self.waiting.get(&(order, view_index)).map(|(header, pixels)| (header, &**pixels))
    }

    /// A view was answered; `shows` are the neighbours it shows or was cut for, and how well. It is
    /// held for those that it shows best.
    pub fn answered(&mut self, order: FrameOrder, view_index: u32, shows: &[(usize, Rank)]) {
        let Some((header, pixels)) = self.waiting.remove(&(order, view_index)) else { return };
        for &(target, rank) in shows {
            let known = self.best.get(&(order, target));
            if known.is_none_or(|known| rank.is_above(&known.rank)) {
                let hung = Hung { rank, header, pixels: pixels.clone() };
                self.best.insert((order, target), hung);
            }
        }
        // Frames behind a stalled one give way: theirs are looked at without pixels.
        while self.best.len() > self.best_most {
            self.best.pop_last();
        }
    }

    /// The best views of a frame's neighbours.
    pub fn of_frame(&self, order: FrameOrder) -> impl Iterator<Item = (usize, &ViewHeader, &P)> {
        self.best
            .range((order, 0)..=(order, usize::MAX))
            .map(|(&(_, target), hung)| (target, &hung.header, &*hung.pixels))
    }

    /// Lets go of a neighbour's best view in a frame: it was looked at.
    pub fn release(&mut self, order: FrameOrder, target: usize) {
        self.best.remove(&(order, target));
    }

    /// Lets go of everything up to and with this frame.
    pub fn forget(&mut self, order: FrameOrder) {
        self.waiting.retain(|(of, _), _| *of > order);
        self.best.retain(|(of, _), _| *of > order);
    }

    /// Views that are held, for whatever reason, at most.
    pub fn len_most(&self) -> usize {
        self.waiting_most + self.best_most
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

    fn rank(is_own: bool, focal_px: f64, off_centre: f64, view_index: u32) -> Rank {
        Rank { is_own, decoded: 0, focal_px, off_centre, view_index }
    }

    #[test]
    fn the_best_view_is_the_same_in_whatever_order_they_are_answered() {
        let ranks = [
            rank(false, 611.0, 0.3, 0),
            rank(false, 611.0, 0.1, 1),
            rank(true, 900.0, 0.2, 2),
            rank(false, 1200.0, 0.0, 3),
        ];
        for turn in 0..4 {
            let mut gallery = Gallery::new(8, 8);
            (0..4).for_each(|index| gallery.add(header(5, index), index));
            for k in 0..4 {
                let index = (k + turn) % 4;
                gallery.answered((0, 0, 5), index as u32, &[(7, ranks[index])]);
            }
            let best: Vec<_> =
                gallery.of_frame((0, 0, 5)).map(|(target, _, pixels)| (target, *pixels)).collect();
            assert_eq!(best, [(7, 2)]);
        }
    }

    #[test]
    fn decoded_markers_say_more_than_squares_that_look_like_some() {
        let squares = rank(false, 1200.0, 0.0, 0);
        let markers = Rank { decoded: 1, ..rank(false, 611.0, 0.4, 1) };
        assert!(markers.is_above(&squares) && !squares.is_above(&markers));
    }

    #[test]
    fn what_nobody_needs_is_let_go() {
        let mut gallery = Gallery::new(3, 2);
        let pixels = Rc::new(());
        for index in 0..5 {
            gallery.add(header(1, index), pixels.clone());
        }
        assert_eq!(Rc::strong_count(&pixels), 4, "three wait");
        gallery.answered((0, 0, 1), 2, &[]);
        assert_eq!(Rc::strong_count(&pixels), 3, "it shows nobody");
        gallery.answered((0, 0, 1), 3, &[(0, rank(true, 1.0, 0.0, 3))]);
        assert_eq!(Rc::strong_count(&pixels), 3, "it shows somebody");
        gallery.forget((0, 0, 1));
        assert_eq!(Rc::strong_count(&pixels), 1);
    }

    #[test]
    fn later_frames_give_way_to_the_one_that_is_waited_for() {
        let mut gallery = Gallery::new(8, 2);
        for sequence in 1..5 {
            gallery.add(header(sequence, 0), sequence);
            gallery.answered((0, 0, sequence), 0, &[(0, rank(true, 1.0, 0.0, 0))]);
        }
        assert_eq!(gallery.of_frame((0, 0, 1)).count(), 1);
        assert_eq!(gallery.of_frame((0, 0, 4)).count(), 0);
    }
}
