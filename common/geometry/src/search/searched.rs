//! Record of searches, with their frames.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Purpose, Search};

/// Last search of each tile and of each target's region of interest, and the tile of the last hit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Searched {
    partitions: Vec<LastSearch>,
    high_resolution: Vec<LastSearch>,
    targets: BTreeMap<usize, u64>,
    last_hit: Option<usize>,
    /// The last frame with any search, and the last one with a search of a tile.
    last: Option<u64>,
    last_of_tile: Option<u64>,
}

/// The last search of a tile.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
struct LastSearch {
    frame: Option<u64>,
    /// Whether the tile was searched with the fine window alone, so that the coarse one is next.
    was_fine: bool,
}

impl Searched {
    /// Creates a record without searches for this many partitions and high-resolution tiles.
    pub fn new(partitions: usize, high_resolution_tiles: usize) -> Self {
        Self {
            partitions: vec![LastSearch::default(); partitions],
            high_resolution: vec![LastSearch::default(); high_resolution_tiles],
            targets: BTreeMap::new(),
            last_hit: None,
            last: None,
            last_of_tile: None,
        }
    }

    /// Whether both have the same numbers of tiles.
    pub fn has_tiles_of(&self, other: &Self) -> bool {
        self.partitions.len() == other.partitions.len()
            && self.high_resolution.len() == other.high_resolution.len()
    }

    /// Records that a view was cut and searched in frame number `frame`. The number must rise from
    /// frame to frame, also after a new start of the source. Tiles that do not exist are ignored.
    pub fn record(&mut self, frame: u64, purpose: Purpose) {
        self.last = Some(frame);
        if let Some(tile) = self.tile_mut(purpose) {
            tile.frame = Some(frame);
            self.last_of_tile = Some(frame);
        } else if let Purpose::Roi(target) = purpose {
            self.targets.insert(target, frame);
        }
    }

    /// Records the window of a tile's search, which determines its [`Searched::next_window`].
    ///
    /// The last window counts, not the number of searches. Two frames may follow one plan and
    /// search the tile with the same window.
    pub fn record_window(&mut self, purpose: Purpose, search: Search) {
        if let Some(tile) = self.tile_mut(purpose) {
            tile.was_fine = search == Search::FineWindow;
        }
    }

    /// The window for a tile's next search, where windows alternate: the fine one first, because it
    /// finds more markers.
    pub fn next_window(&self, purpose: Purpose) -> Search {
        match self.tile(purpose) {
            Some(tile) if tile.was_fine => Search::CoarseWindow,
            _ => Search::FineWindow,
        }
    }

    /// Records the first view, in plan order, with a marker of a configured body. If it was a
    /// partition, that is the paper's n.
    pub fn hit(&mut self, purpose: Purpose) {
        if let Purpose::Partition(part) = purpose
            && part < self.partitions.len()
        {
            self.last_hit = Some(part);
        }
    }

    /// The partition of the last hit: the paper's n, one for the whole swarm.
    pub fn last_hit(&self) -> Option<usize> {
        self.last_hit
    }

    /// Frame of the last search of this view; `None`, which sorts before every frame, if there was
    /// none.
    pub fn last_searched(&self, purpose: Purpose) -> Option<u64> {
        match purpose {
            Purpose::Roi(target) => self.targets.get(&target).copied(),
            _ => self.tile(purpose)?.frame,
        }
    }

    /// Number of consecutive frames in which no tile was searched.
    pub fn frames_without_tile(&self) -> u64 {
        match (self.last, self.last_of_tile) {
            (Some(last), Some(of_tile)) => last.saturating_sub(of_tile),
            (Some(last), None) => last.saturating_add(1),
            (None, _) => 0,
        }
    }

    fn tile(&self, purpose: Purpose) -> Option<&LastSearch> {
        match purpose {
            Purpose::Partition(index) => self.partitions.get(index),
            Purpose::HighResolution(index) => self.high_resolution.get(index),
            Purpose::Roi(_) | Purpose::Proposal => None,
        }
    }

    fn tile_mut(&mut self, purpose: Purpose) -> Option<&mut LastSearch> {
        match purpose {
            Purpose::Partition(index) => self.partitions.get_mut(index),
            Purpose::HighResolution(index) => self.high_resolution.get_mut(index),
            Purpose::Roi(_) | Purpose::Proposal => None,
        }
    }
}
