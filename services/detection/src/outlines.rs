//! Outlines of what is dark in a view: border following (S. Suzuki and K. Abe, "Topological structural
//! analysis of digitized binary images by border following", 1985), without their tree.
//!
//! Gives the outlines that OpenCV's `findContours` gives, each from the same point and in the same
//! direction, the first one first. A view of a hall has ten thousand of them, of which a few hundred are long enough for a marker:
//! the others leave no trace.

use std::ops::RangeInclusive;

use nalgebra::Vector2;

/// What is known of a dark pixel: nothing yet; that an outline goes through it; that one goes between
/// it and its right neighbour.
const NEW: u8 = 0;
const FOLLOWED: u8 = 1;
const FOLLOWED_RIGHT: u8 = 2;

/// The eight neighbours, counterclockwise from the right one: steps of column and row.
const STEPS: [Pixel; 8] = [
    Pixel::new(1, 0),
    Pixel::new(1, -1),
    Pixel::new(0, -1),
    Pixel::new(-1, -1),
    Pixel::new(-1, 0),
    Pixel::new(-1, 1),
    Pixel::new(0, 1),
    Pixel::new(1, 1),
];
const RIGHT: u32 = 0;
const LEFT: u32 = 4;

/// Pixels that are compared at once.
const WORD: usize = 8;

/// Follows outlines; keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct Follower {
    /// 1 where it is dark, with a border of 0.
    dark: Vec<u8>,
    /// What is known of each pixel. Not in `dark`, because a processor waits for a byte that was just
    /// written if it is read together with its neighbours.
    marks: Vec<u8>,
    stride: usize,
    outlines: Outlines,
}

/// Column and row of a pixel.
pub(crate) type Pixel = Vector2<i32>;

/// The outlines of one image.
#[derive(Debug, Default)]
pub(crate) struct Outlines {
    /// The points of all of them, one after the other.
    points: Vec<Pixel>,
    /// Where each one's points end.
    ends: Vec<usize>,
}

impl Outlines {
    /// Each outline's points, neighbours beside each other, in pixels.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &[Pixel]> {
        let starts = std::iter::once(&0).chain(&self.ends);
        starts.zip(&self.ends).map(|(&start, &end)| &self.points[start..end])
    }

    /// Ends the outline of the points that were added last, or drops it.
    fn end(&mut self, lengths: &RangeInclusive<usize>) {
        let start = self.ends.last().copied().unwrap_or(0);
        if lengths.contains(&(self.points.len() - start)) {
            self.ends.push(self.points.len());
        } else {
            self.points.truncate(start);
        }
    }
}

impl Follower {
    /// Every outline with so many points of what is 1, and not 0, in rows of `width` pixels: of dark
    /// regions and of holes in them.
    pub(crate) fn follow(
        &mut self,
        dark: &[u8],
        width: usize,
        lengths: RangeInclusive<usize>,
    ) -> &Outlines {
        self.outlines.points.clear();
        self.outlines.ends.clear();
        self.copy(dark, width);
        let mut from = 0;
        // Each run of dark pixels in a row.
        while let Some(first) = next_of(&self.dark, 1, from) {
            // There is one: behind each row there is a pixel that is not dark.
            let Some(end) = next_of(&self.dark, 0, first) else { break };
            if self.marks[first] == NEW {
                self.trace(first, LEFT);
                self.outlines.end(&lengths);
            }
            // Unless an outline went between its last pixel and the bright one to the right.
            if self.marks[end - 1] != FOLLOWED_RIGHT {
                self.trace(end - 1, RIGHT);
                self.outlines.end(&lengths);
            }
            from = end;
        }
        &self.outlines
    }

    /// Copies what is dark.
    fn copy(&mut self, dark: &[u8], width: usize) {
        self.stride = width + 2;
        self.dark.clear();
        self.dark.resize(self.stride, 0);
        for row in dark.chunks_exact(width.max(1)) {
            self.dark.push(0);
            self.dark.extend_from_slice(row);
            self.dark.push(0);
        }
        let last = self.dark.len();
        self.dark.resize(last + self.stride + WORD, 0);
        self.marks.clear();
        self.marks.resize(last, NEW);
    }

    /// Follows the outline that goes between a dark pixel and its bright neighbour on that side.
    fn trace(&mut self, start: usize, bright_side: u32) {
        let stride = self.stride as i32;
        let steps = STEPS.map(|step| (step.y * stride + step.x) as isize);
        let mut place = Pixel::new(start as i32 % stride - 1, start as i32 / stride - 1);
        let dark = self.dark_neighbours(start);
        if dark == 0 {
            self.marks[start] = FOLLOWED_RIGHT;
            self.outlines.points.push(place);
            return;
        }
        // Clockwise from the bright side to the first dark neighbour: there the outline comes back.
        let bright = dark.rotate_right(bright_side).leading_zeros();
        let last_side = (bright_side + 7 - bright) % 8;
        let last = start.wrapping_add_signed(steps[last_side as usize]);
        let (mut here, mut came_from) = (start, last_side);
        loop {
            // Counterclockwise from where the outline came to the next dark neighbour; if there is no
            // other, that is where it came from.
            let first_side = (came_from + 1) % 8;
            let dark = self.dark_neighbours(here);
            let side = (first_side + dark.rotate_right(first_side).trailing_zeros()) % 8;
            if side != RIGHT && side <= came_from {
                self.marks[here] = FOLLOWED_RIGHT;
            } else if self.marks[here] == NEW {
                self.marks[here] = FOLLOWED;
            }
            self.outlines.points.push(place);
            let next = here.wrapping_add_signed(steps[side as usize]);
            if next == start && here == last {
                return;
            }
            place += STEPS[side as usize];
            (here, came_from) = (next, (side + 4) % 8);
        }
    }

    /// Which of the eight neighbours are dark: a bit for each of [`STEPS`], the first one lowest.
    fn dark_neighbours(&self, at: usize) -> u8 {
        let [above, beside, below] =
            [at - self.stride, at, at + self.stride].map(|middle| &self.dark[middle - 1..][..3]);
        beside[2]
            | above[2] << 1
            | above[1] << 2
            | above[0] << 3
            | beside[0] << 4
            | below[0] << 5
            | below[1] << 6
            | below[2] << 7
    }
}

/// The first index from `from` on where there is this pixel; the last seven may not be looked at.
fn next_of(dark: &[u8], pixel: u8, from: usize) -> Option<usize> {
    let other = u64::from_ne_bytes([1 - pixel; WORD]);
    let mut rest = dark.get(from..)?;
    while let Some((word, behind)) = rest.split_first_chunk::<WORD>() {
        let change = u64::from_le_bytes(*word) ^ other;
        if change != 0 {
            return Some(dark.len() - rest.len() + change.trailing_zeros() as usize / 8);
        }
        rest = behind;
    }
    None
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use opencv::core::{Mat, Point, Vector};
    use opencv::imgproc::{CHAIN_APPROX_NONE, RETR_LIST, find_contours};
    use opencv::prelude::*;
    use proptest::prelude::*;

    use super::*;

    fn theirs(dark: &[u8], width: usize) -> Vec<Vec<Pixel>> {
        let image = Mat::new_rows_cols_with_data((dark.len() / width) as i32, width as i32, dark);
        let image = image.unwrap().try_clone().unwrap();
        let mut outlines = Vector::<Vector<Point>>::new();
        find_contours(&image, &mut outlines, RETR_LIST, CHAIN_APPROX_NONE, Point::new(0, 0))
            .unwrap();
        let pixel = |point: Point| Pixel::new(point.x, point.y);
        outlines.iter().map(|outline| outline.iter().map(pixel).collect()).collect()
    }

    fn ours(follower: &mut Follower, dark: &[u8], width: usize) -> Vec<Vec<Pixel>> {
        let outlines = follower.follow(dark, width, 1..=usize::MAX);
        outlines.iter().map(<[Pixel]>::to_vec).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn outlines_are_opencvs(
            width in 1usize..24,
            (share, height) in (1u8..10, 1usize..24),
            dice in prop::collection::vec(0u8..10, 24 * 24),
        ) {
            let dark: Vec<u8> =
                dice[..width * height].iter().map(|&dice| u8::from(dice < share)).collect();
            let mut follower = Follower::default();
            let mut theirs = theirs(&dark, width);
            // The last one found is the first of their list.
            theirs.reverse();
            let found = ours(&mut follower, &dark, width);
            // Memory of another image is of no consequence.
            prop_assert_eq!(&ours(&mut follower, &dark, width), &found);
            prop_assert_eq!(found, theirs);
        }
    }

    #[test]
    fn only_outlines_of_a_length_are_kept() {
        // One pixel, and a square of three with a hole.
        #[rustfmt::skip]
        let dark = [
            1, 0, 0, 0, 0,
            0, 0, 1, 1, 1,
            0, 0, 1, 0, 1,
            0, 0, 1, 1, 1,
        ];
        let mut follower = Follower::default();
        let lengths = |follower: &mut Follower, lengths| -> Vec<usize> {
            follower.follow(&dark, 5, lengths).iter().map(<[Pixel]>::len).collect()
        };
        assert_eq!(lengths(&mut follower, 1..=100), [1, 8, 4]);
        assert_eq!(lengths(&mut follower, 2..=7), [4]);
        assert_eq!(lengths(&mut follower, 8..=8), [8]);
        assert_eq!(follower.follow(&[], 0, 1..=9).iter().count(), 0);
    }
}
