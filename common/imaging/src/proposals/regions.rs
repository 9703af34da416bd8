//! Runs joined to regions.

use std::ops::Range;

/// A region of dark pixels: its bounding box and its area.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Region {
    pub left: u16,
    /// The last column.
    pub right: u16,
    pub top: u16,
    /// The last row.
    pub bottom: u16,
    pub area: u32,
}

/// Joins runs of one row after the other to regions. Runs that touch along an edge belong together.
#[derive(Debug, Default)]
pub(super) struct Regions {
    parents: Vec<u32>,
    regions: Vec<Region>,
    above: Vec<(Range<u16>, u32)>,
    here: Vec<(Range<u16>, u32)>,
    row: usize,
}

impl Regions {
    pub(super) fn clear(&mut self) {
        self.parents.clear();
        self.regions.clear();
        self.above.clear();
        self.row = 0;
    }

    /// Adds the runs of row `row`; rows come in order.
    #[inline(always)]
    pub(super) fn add(&mut self, row: usize, runs: &[Range<u16>]) {
        self.here.clear();
        let mut first = 0;
        for run in runs {
            let own = Region {
                left: run.start,
                right: run.end - 1,
                top: row as u16,
                bottom: row as u16,
                area: u32::from(run.end - run.start),
            };
            let mut label = None;
            while self.above.get(first).is_some_and(|(above, _)| above.end <= run.start) {
                first += 1;
            }
            for k in first..self.above.len() {
                let (above, its) = (&self.above[k].0, self.above[k].1);
                if above.start >= run.end {
                    break;
                }
                label = Some(match label {
                    None => root(&mut self.parents, its),
                    Some(label) => self.join(label, its),
                });
            }
            let label = match label {
                Some(label) => {
                    let region = &mut self.regions[label as usize];
                    *region = region.with(&own);
                    label
                }
                None => {
                    let label = self.parents.len() as u32;
                    self.parents.push(label);
                    self.regions.push(own);
                    label
                }
            };
            self.here.push((run.clone(), label));
        }
        std::mem::swap(&mut self.above, &mut self.here);
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Region> {
        let own = |(label, &parent): (usize, &u32)| label == parent as usize;
        let roots = self.parents.iter().enumerate().map(own);
        self.regions.iter().zip(roots).filter(|(_, is_root)| *is_root).map(|(region, _)| region)
    }

    fn join(&mut self, one: u32, other: u32) -> u32 {
        let other = root(&mut self.parents, other);
        if one == other {
            return one;
        }
        let (keep, gone) = (one.min(other), one.max(other));
        self.parents[gone as usize] = keep;
        self.regions[keep as usize] =
            self.regions[keep as usize].with(&self.regions[gone as usize]);
        keep
    }
}

impl Region {
    fn with(&self, other: &Self) -> Self {
        Self {
            left: self.left.min(other.left),
            right: self.right.max(other.right),
            top: self.top.min(other.top),
            bottom: self.bottom.max(other.bottom),
            area: self.area + other.area,
        }
    }

    pub(super) fn width(&self) -> usize {
        usize::from(self.right - self.left) + 1
    }

    pub(super) fn height(&self) -> usize {
        usize::from(self.bottom - self.top) + 1
    }
}

/// The label that represents all labels joined with this one.
fn root(parents: &mut [u32], mut label: u32) -> u32 {
    while parents[label as usize] != label {
        let next = parents[parents[label as usize] as usize];
        parents[label as usize] = next;
        label = next;
    }
    label
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The regions of a picture of rows, in which `#` is dark.
    fn regions_of(rows: &[&str]) -> Vec<Region> {
        let mut regions = Regions::default();
        for (y, row) in rows.iter().enumerate() {
            let dark: Vec<bool> = row.bytes().map(|byte| byte == b'#').chain([false]).collect();
            let mut runs = Vec::new();
            let mut begin = None;
            for (x, &is_dark) in dark.iter().enumerate() {
                match (begin, is_dark) {
                    (None, true) => begin = Some(x),
                    (Some(from), false) => {
                        runs.push(from as u16..x as u16);
                        begin = None;
                    }
                    _ => {}
                }
            }
            regions.add(y, &runs);
        }
        regions.iter().copied().collect()
    }

    #[test]
    fn branches_that_meet_are_one_region() {
        let found = regions_of(&["#.#.#", "#.#.#", "###.#", "..###"]);
        assert_eq!(found, [Region { left: 0, right: 4, top: 0, bottom: 3, area: 13 }]);
    }

    #[test]
    fn corners_do_not_join() {
        assert_eq!(regions_of(&["##..", "..##"]).len(), 2);
        assert_eq!(regions_of(&["#.#", ".#.", "#.#"]).len(), 5);
    }

    #[test]
    fn a_ring_is_one_region_with_its_hole_left_out() {
        let found = regions_of(&["####", "#..#", "#..#", "####"]);
        assert_eq!(found, [Region { left: 0, right: 3, top: 0, bottom: 3, area: 12 }]);
        assert_eq!((found[0].width(), found[0].height()), (4, 4));
    }
}
