//! Outlines of dark regions: border following (S. Suzuki and K. Abe, "Topological structural
//! analysis of digitized binary images by border following", 1985), without the tree of borders.
//!
//! The outlines are those of OpenCV's `findContours`, each from the same point and in the same
//! direction, in the order of their first points. Regions of a single pixel are left out. A view of
//! a hall has ten thousand outlines, of which a few hundred are long enough for a marker. Only
//! those are kept.

use std::ops::RangeInclusive;

use nalgebra::Vector2;

use crate::darkness::DarkPixels;

/// Mark of a pixel: an outline goes through it.
const FOLLOWED: u8 = 1;
/// Mark of a pixel: an outline goes between it and its right neighbour.
const FOLLOWED_RIGHT: u8 = 2;
/// Mark of a pixel: it may be the first one of an outline.
const FIRST: u8 = 4;

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
const RIGHT: u8 = 0;
const ABOVE_RIGHT: u8 = 1;
const LEFT: u8 = 4;

/// The neighbours that precede a pixel in the order of rows and columns.
const BEFORE: u8 = 0b0001_1110;

/// Marks that are tested at once.
const WORD: usize = 8;

/// Follows outlines; reuses its memory for the next image.
#[derive(Debug, Default)]
pub(crate) struct Follower {
    /// Dark neighbours of each pixel: a bit for each of [`STEPS`], the first one lowest. It decides
    /// where an outline goes next, and is computed for all pixels at once beforehand.
    neighbours: Vec<u8>,
    /// [`FOLLOWED`], [`FOLLOWED_RIGHT`] and [`FIRST`] of each pixel.
    marks: Vec<u8>,
    /// The exit from a pixel, by the side that an outline came from and by the pixel's dark
    /// neighbours.
    exits: Vec<[Exit; 256]>,
    /// The length of a row, for which the exits hold.
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
    /// End of each outline's points, and the kind of its inside.
    ends: Vec<(usize, Encloses)>,
}

/// Inside of an outline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Encloses {
    /// A dark region.
    Dark,
    /// A bright hole in a dark region.
    Hole,
}

impl Outlines {
    /// The inside of each outline, and its points, each a neighbour of the next.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (Encloses, &[Pixel])> {
        let starts = std::iter::once(0).chain(self.ends.iter().map(|&(end, _)| end));
        starts.zip(&self.ends).map(|(start, &(end, encloses))| (encloses, &self.points[start..end]))
    }

    /// Ends the outline whose points were added last. Drops it if its length is not wanted.
    fn end(&mut self, encloses: Encloses, lengths: &RangeInclusive<usize>) {
        let start = self.ends.last().map_or(0, |&(end, _)| end);
        if lengths.contains(&(self.points.len() - start)) {
            self.ends.push((self.points.len(), encloses));
        } else {
            self.points.truncate(start);
        }
    }
}

/// Exit of an outline from a pixel.
#[derive(Debug, Clone, Copy, Default)]
struct Exit {
    /// The step to the next pixel: in memory, and along columns and rows.
    step: i32,
    columns: i8,
    rows: i8,
    /// Side of the next pixel on which this one lies.
    came_from: u8,
    /// The mark that this pixel gets.
    mark: u8,
}

/// The exit to the next dark neighbour, counterclockwise from where the outline came. If there is
/// no other, it goes back.
fn exit(came_from: u8, neighbours: u8, stride: usize) -> Exit {
    let first_side = (came_from + 1) % 8;
    let bright = neighbours.rotate_right(first_side.into()).trailing_zeros() as u8;
    let side = (first_side + bright) % 8;
    let step = STEPS[usize::from(side)];
    Exit {
        step: step.y * stride as i32 + step.x,
        columns: step.x as i8,
        rows: step.y as i8,
        came_from: (side + 4) % 8,
        mark: if side != RIGHT && side <= came_from { FOLLOWED_RIGHT } else { FOLLOWED },
    }
}

impl Follower {
    /// The outlines of dark regions and of holes in them with a number of points in `lengths`, two
    /// or more.
    pub(crate) fn follow(
        &mut self,
        dark: &DarkPixels,
        lengths: RangeInclusive<usize>,
    ) -> &Outlines {
        self.outlines.points.clear();
        self.outlines.ends.clear();
        self.set_size(dark);
        self.find_all_neighbours(dark);
        for word in 0..self.marks.len() / WORD {
            let marks = u64::from_le_bytes(self.marks.as_chunks::<WORD>().0[word]);
            let mut first = marks & u64::from_ne_bytes([FIRST; WORD]);
            while first != 0 {
                let at = word * WORD + first.trailing_zeros() as usize / 8;
                first &= first - 1;
                if self.neighbours[at] & 1 << ABOVE_RIGHT == 0 {
                    if self.marks[at] == FIRST {
                        self.trace(at, LEFT);
                        self.outlines.end(Encloses::Dark, &lengths);
                    }
                } else if self.marks[at] & FOLLOWED_RIGHT == 0 {
                    self.trace(at, RIGHT);
                    self.outlines.end(Encloses::Hole, &lengths);
                }
            }
        }
        &self.outlines
    }

    /// Prepares memory for images of this size. Everything but the border is written for each
    /// image.
    fn set_size(&mut self, dark: &DarkPixels) {
        let (stride, count) = (dark.stride, dark.pixels.len());
        if (self.stride, self.neighbours.len()) == (stride, count) {
            return;
        }
        let of_side = |came_from| std::array::from_fn(|bits| exit(came_from, bits as u8, stride));
        (self.exits, self.stride) = ((0..8).map(of_side).collect(), stride);
        self.neighbours.clear();
        self.neighbours.resize(count, 0);
        self.marks.clear();
        self.marks.resize(count.next_multiple_of(WORD), 0);
    }

    /// Finds the dark neighbours of all pixels, and where outlines may begin.
    fn find_all_neighbours(&mut self, dark: &DarkPixels) {
        let (stride, count) = (dark.stride, dark.pixels.len());
        // Each row without its border.
        let rows = (stride..count.saturating_sub(stride)).step_by(stride);
        for row in rows.map(|start| start + 1..start + stride - 1) {
            let pixels = |by: Pixel| {
                let by = (by.y * stride as i32 + by.x) as isize;
                &dark.pixels[row.start.wrapping_add_signed(by)..][..row.len()]
            };
            let marks = &mut self.marks[row.clone()];
            let neighbours = &mut self.neighbours[row.clone()];
            find_neighbours(neighbours, marks, pixels(Pixel::zeros()), STEPS.map(pixels));
        }
    }

    /// Follows the outline that passes between a dark pixel and its bright neighbour on that side.
    fn trace(&mut self, start: usize, bright_side: u8) {
        let stride = self.stride as i32;
        let mut place = Pixel::new(start as i32 % stride - 1, start as i32 / stride - 1);
        let neighbours = self.neighbours[start];
        // The outline ends at the first dark neighbour, clockwise from the bright side.
        let bright = neighbours.rotate_right(bright_side.into()).leading_zeros() as u8;
        let last_side = (bright_side + 7 - bright) % 8;
        let step = STEPS[usize::from(last_side)];
        let last = start.wrapping_add_signed((step.y * stride + step.x) as isize);
        let (mut here, mut came_from) = (start, last_side);
        let (neighbours, marks) = (&self.neighbours[..], &mut self.marks[..]);
        let (exits, points) = (&self.exits[..], &mut self.outlines.points);
        loop {
            let exit = exits[usize::from(came_from)][usize::from(neighbours[here])];
            marks[here] |= exit.mark;
            points.push(place);
            let next = here.wrapping_add_signed(exit.step as isize);
            if next == start && here == last {
                return;
            }
            place += Pixel::new(exit.columns.into(), exit.rows.into());
            (here, came_from) = (next, exit.came_from);
        }
    }
}

/// Finds the dark neighbours of a row's pixels, and where outlines may begin. `at` holds the row
/// shifted by each of the eight steps.
fn find_neighbours(neighbours: &mut [u8], marks: &mut [u8], pixels: &[u8], at: [&[u8]; 8]) {
    // With slices of equal length the compiler handles many pixels at once.
    let [a, b, c, d, e, f, g, h] = at.map(|row| &row[..neighbours.len()]);
    for (k, bits) in neighbours.iter_mut().enumerate() {
        let low = a[k] | b[k] << 1 | c[k] << 2 | d[k] << 3;
        let high = e[k] | f[k] << 1 | g[k] << 2 | h[k] << 3;
        *bits = low | high << 4;
    }
    for ((mark, &neighbours), pixel) in marks.iter_mut().zip(&*neighbours).zip(pixels) {
        *mark = FIRST * (pixel & may_be_first(neighbours));
    }
}

/// 1 if a dark pixel with these neighbours may be the first one of an outline, in the order of rows
/// and columns; 0 if it has none. The first pixel around a region has no dark one before it. The
/// first pixel around a hole has the hole's first pixel to its right, and a dark one above that.
fn may_be_first(neighbours: u8) -> u8 {
    const AT_HOLE: u8 = 1 << RIGHT | 1 << ABOVE_RIGHT;
    u8::from(neighbours & BEFORE == 0 && neighbours != 0)
        | u8::from(neighbours & AT_HOLE == 1 << ABOVE_RIGHT)
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

    fn bordered(pixels: &[u8], width: usize) -> DarkPixels {
        let mut dark = DarkPixels::default();
        dark.begin(width);
        pixels.chunks_exact(width).for_each(|row| dark.add(row.iter().copied()));
        dark.end();
        dark
    }

    fn ours(follower: &mut Follower, dark: &[u8], width: usize) -> Vec<Vec<Pixel>> {
        let dark = bordered(dark, width);
        let outlines = follower.follow(&dark, 1..=usize::MAX);
        outlines.iter().map(|(_, outline)| outline.to_vec()).collect()
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
            // OpenCV lists the outline found last first.
            theirs.reverse();
            theirs.retain(|outline| outline.len() > 1);
            let found = ours(&mut follower, &dark, width);
            // What is left in memory of another image must not matter.
            let inverted: Vec<u8> = dark.iter().map(|dark| 1 - dark).collect();
            ours(&mut follower, &inverted, width);
            prop_assert_eq!(&ours(&mut follower, &dark, width), &found);
            prop_assert_eq!(found, theirs);
        }
    }

    #[test]
    fn only_outlines_of_the_wanted_lengths_are_kept() {
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
            follower
                .follow(&bordered(&dark, 5), lengths)
                .iter()
                .map(|(_, outline)| outline.len())
                .collect()
        };
        assert_eq!(lengths(&mut follower, 1..=100), [8, 4]);
        assert_eq!(lengths(&mut follower, 2..=7), [4]);
        assert_eq!(lengths(&mut follower, 8..=8), [8]);
        assert_eq!(follower.follow(&bordered(&[], 1), 1..=9).iter().count(), 0);
    }
}
