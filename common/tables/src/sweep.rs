//! Counts how often each tile of the sphere is searched, from the plans and detection records.
//!
//! An untracked target is found at the next search of the tile that shows it. So the largest gap
//! between two searches of one tile limits how long a target in range stays unseen.

use std::collections::VecDeque;
use std::fmt;

use flockeye_config::Resolved;
use flockeye_contract::{DetectionHeader, PlannedView, ViewKind};
use flockeye_geometry::view::View;
use serde::Serialize;

/// Plans that detection records may still refer to.
const PLANS_KEPT: usize = 64;

/// Frames between two searches of one part of the sphere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SearchGaps {
    /// Number of parts.
    pub views: usize,
    /// The mean gap. A part is included after its second search.
    pub mean_frames: Option<f64>,
    /// The largest gap. It includes gaps that have not ended, and gaps before a part's first
    /// search.
    pub worst_frames: u64,
}

/// The gaps between searches of the sphere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SweepReport {
    /// Frames from the first search to the newest.
    pub frames: u64,
    /// Gaps of the partition's tiles.
    pub partitions: SearchGaps,
    /// Gaps of the high-resolution tiles; `None` without such tiles.
    pub high_resolution: Option<SearchGaps>,
}

impl fmt::Display for SweepReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let every = |gaps: &SearchGaps| {
            let mean = gaps.mean_frames.map_or("-".to_owned(), |mean| format!("{mean:.1}"));
            format!("every {mean} frames ({} at most)", gaps.worst_frames)
        };
        write!(f, "each partition {}", every(&self.partitions))?;
        match &self.high_resolution {
            Some(fine) => write!(f, ", each high-resolution tile {}", every(fine)),
            None => Ok(()),
        }
    }
}

/// The searches of each part of the sphere.
#[derive(Debug)]
pub struct Sweep {
    /// `None` for a tile that the camera's mask hides: it is never searched.
    partitions: Vec<Option<SweptPart>>,
    high_resolution: Vec<Option<SweptPart>>,
    /// Kind and tile of each view, by plan.
    plans: VecDeque<(u64, Vec<(u32, u32)>)>,
    /// The source and its epoch. Frame numbers cannot be compared between different ones.
    epoch: Option<(u32, u32)>,
    first: Option<u64>,
    newest: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct SweptPart {
    last: Option<u64>,
    sum: u64,
    gaps: u64,
    worst: u64,
}

impl Sweep {
    /// Begins the counts. The flags of partitions and high-resolution tiles state whether the
    /// camera sees any part of a tile.
    pub fn new(partitions: &[bool], high_resolution: &[bool]) -> Self {
        let parts = |seen: &[bool]| seen.iter().map(|seen| seen.then(SweptPart::default)).collect();
        Self {
            partitions: parts(partitions),
            high_resolution: parts(high_resolution),
            plans: VecDeque::new(),
            epoch: None,
            first: None,
            newest: 0,
        }
    }

    /// Begins the counts for the tiles of a pipeline. `None` unless the search mode is roi: other
    /// modes begin at the first tile in each frame.
    ///
    /// # Errors
    /// The configuration names files or a partition that cannot be used.
    pub fn of(resolved: &Resolved) -> anyhow::Result<Option<Self>> {
        if !resolved.pipeline.has_regions() {
            return Ok(None);
        }
        let mask = resolved.mask()?;
        let seen = |views: &[View]| -> Vec<bool> {
            views.iter().map(|view| !mask.hides_view(view)).collect()
        };
        let (near, far) = (seen(&resolved.partition_views), seen(&resolved.high_resolution_tiles));
        Ok(Some(Self::new(&near, &far)))
    }

    /// Takes a plan.
    pub fn plan(&mut self, plan_id: u64, views: &[PlannedView]) {
        let tiles = views.iter().map(|view| (view.kind, view.tile)).collect();
        self.plans.push_back((plan_id, tiles));
        if self.plans.len() > PLANS_KEPT {
            self.plans.pop_front();
        }
    }

    /// Takes the record of a searched view.
    pub fn searched(&mut self, header: &DetectionHeader) {
        let stamp = &header.stamp;
        let epoch = (stamp.source_generation, stamp.epoch);
        if self.epoch != Some(epoch) {
            self.epoch = Some(epoch);
            (self.first, self.newest) = (None, stamp.sequence);
            let parts = self.partitions.iter_mut().chain(&mut self.high_resolution);
            parts.flatten().for_each(|part| part.last = None);
        }
        let first = *self.first.get_or_insert(stamp.sequence);
        self.newest = self.newest.max(stamp.sequence);
        // A restarted fusion counts its plans from 1 again: take the newest plan of that number.
        let plan = self.plans.iter().rev().find(|(id, _)| *id == header.plan_id);
        let part = plan
            .and_then(|(_, tiles)| tiles.get(header.view_index as usize))
            .and_then(|&(kind, tile)| {
                let parts = match ViewKind::try_from(kind).ok()? {
                    ViewKind::Partition => &mut self.partitions,
                    ViewKind::HighResolution => &mut self.high_resolution,
                    ViewKind::Roi | ViewKind::Proposal => return None,
                };
                parts.get_mut(tile as usize)?.as_mut()
            })
            .filter(|_| header.failed == 0);
        let Some(part) = part else { return };
        // Records of a frame may arrive after records of the next frame.
        let Some(gap) = stamp.sequence.checked_sub(part.last.unwrap_or(first)) else { return };
        if part.last.is_some() && gap > 0 {
            (part.sum, part.gaps) = (part.sum.saturating_add(gap), part.gaps + 1);
        }
        part.worst = part.worst.max(gap);
        part.last = Some(stamp.sequence);
    }

    /// The gaps so far. `None` before the first record.
    pub fn report(&self) -> Option<SweepReport> {
        let first = self.first?;
        let gaps = |parts: &[Option<SweptPart>]| {
            let parts: Vec<SweptPart> = parts.iter().copied().flatten().collect();
            let (sum, count) = parts.iter().fold((0u64, 0), |(sum, gaps), part| {
                (sum.saturating_add(part.sum), gaps + part.gaps)
            });
            let open = |part: &SweptPart| self.newest - part.last.unwrap_or(first).min(self.newest);
            SearchGaps {
                views: parts.len(),
                mean_frames: (count > 0).then(|| sum as f64 / count as f64),
                worst_frames: parts
                    .iter()
                    .map(|part| part.worst.max(open(part)))
                    .max()
                    .unwrap_or(0),
            }
        };
        Some(SweepReport {
            frames: (self.newest - first).saturating_add(1),
            partitions: gaps(&self.partitions),
            high_resolution: (!self.high_resolution.is_empty())
                .then(|| gaps(&self.high_resolution)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::FrameStamp;

    use ViewKind::{HighResolution, Partition, Roi};

    fn plan_of(views: &[(ViewKind, u32)]) -> Vec<PlannedView> {
        let view = |&(kind, tile): &(ViewKind, u32)| {
            let kind = kind.code();
            PlannedView { kind, tile, ..PlannedView::default() }
        };
        views.iter().map(view).collect()
    }

    fn search(sweep: &mut Sweep, sequence: u64, plan_id: u64, view_index: u32) {
        let stamp = FrameStamp { sequence, ..FrameStamp::default() };
        sweep.searched(&DetectionHeader {
            stamp,
            plan_id,
            view_index,
            ..DetectionHeader::default()
        });
    }

    #[test]
    fn gaps_are_those_counted_by_hand() {
        // The camera does not see the third partition: it has no gap.
        let mut sweep = Sweep::new(&[true, true, false], &[true]);
        assert_eq!(sweep.report(), None);
        // A region of interest first; then partition 1, partition 0 and a high-resolution tile.
        let views = [(Roi, u32::MAX), (Partition, 1), (Partition, 0), (HighResolution, 0)];
        sweep.plan(1, &plan_of(&views));
        for (sequence, views) in [(10, vec![0, 1, 2]), (11, vec![0, 3]), (14, vec![0, 1])] {
            views.into_iter().for_each(|view| search(&mut sweep, sequence, 1, view));
        }
        search(&mut sweep, 16, 1, 1);
        // The record comes late, and the part was searched after it: no gap.
        search(&mut sweep, 12, 1, 1);
        let report = sweep.report().expect("there are records");
        assert_eq!(report.frames, 7);
        // Partition 1: 10, 14, 16; partition 0: 10, and not again until 16.
        let near = SearchGaps { views: 2, mean_frames: Some(3.0), worst_frames: 6 };
        assert_eq!(report.partitions, near);
        let far = SearchGaps { views: 1, mean_frames: None, worst_frames: 5 };
        assert_eq!(report.high_resolution, Some(far));
        assert_eq!(
            report.to_string(),
            "each partition every 3.0 frames (6 at most), each high-resolution tile every - frames (5 at most)"
        );
    }

    #[test]
    fn the_wait_for_the_first_search_counts_as_a_gap() {
        let mut sweep = Sweep::new(&[true, true], &[]);
        sweep.plan(1, &plan_of(&[(Partition, 0), (Partition, 1)]));
        for (sequence, view) in [(20, 0), (21, 0), (27, 1), (28, 1), (28, 0)] {
            search(&mut sweep, sequence, 1, view);
        }
        let report = sweep.report().expect("there are records");
        assert_eq!(report.partitions.worst_frames, 7);
        assert_eq!(
            report.partitions.mean_frames,
            Some(3.0),
            "the first wait has no beginning, so the mean leaves it out"
        );
    }

    #[test]
    fn unknown_plans_and_failed_searches_are_ignored() {
        let mut sweep = Sweep::new(&[true], &[]);
        sweep.plan(1, &plan_of(&[(Partition, 0)]));
        search(&mut sweep, 5, 1, 0);
        search(&mut sweep, 9, 7, 0);
        search(&mut sweep, 9, 1, 3);
        let failed = DetectionHeader {
            stamp: FrameStamp { sequence: 9, ..FrameStamp::default() },
            plan_id: 1,
            failed: 1,
            ..DetectionHeader::default()
        };
        sweep.searched(&failed);
        let report = sweep.report().expect("there are records");
        assert_eq!((report.partitions.mean_frames, report.partitions.worst_frames), (None, 4));
        // The source restarts: frame numbers begin again.
        let stamp = FrameStamp { epoch: 1, ..FrameStamp::default() };
        sweep.searched(&DetectionHeader { stamp, plan_id: 1, ..DetectionHeader::default() });
        assert_eq!(sweep.report().expect("a record").partitions.worst_frames, 0);
    }
}
