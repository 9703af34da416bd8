//! What was searched, and when.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Purpose, Search};

/// When each tile and each target's region of interest was searched last, and which tile had the
/// last hit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Searched {
    partitions: Vec<LastSearch>,
    high_resolution: Vec<LastSearch>,
    targets: BTreeMap<usize, u64>,
    last_hit: Option<usize>,
    /// The last frame in which anything was searched, and in which a tile was.
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
    /// Nothing was searched yet of so many partitions and high-resolution tiles.
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

    /// Whether both are of as many tiles.
    pub fn has_tiles_of(&self, other: &Self) -> bool {
        self.partitions.len() == other.partitions.len()
            && self.high_resolution.len() == other.high_resolution.len()
    }

    /// Notes that a view was cut and searched in frame number `frame`, which must rise from frame
    /// to frame (also where the source begins anew). Tiles that do not exist are ignored.
    pub fn record(&mut self, frame: u64, purpose: Purpose) {
        self.last = Some(frame);
        if let Some(tile) = self.tile_mut(purpose) {
            tile.frame = Some(frame);
            self.last_of_tile = Some(frame);
        } else if let Purpose::Roi(target) = purpose {
            self.targets.insert(target, frame);
        }
    }

    /// Notes how a tile was searched, which decides its [`Searched::next_window`].
    ///
    /// What counts is the last window used, not the number of searches: two frames may follow one
    /// plan, and both search the tile with the same window.
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

    /// Notes the first view, in plan order, in which a marker of a configured body was found: where
    /// it was a partition, that is the paper's n.
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

    /// The frame in which this was last searched; `None`, which sorts before every frame, if never.
    pub fn last_searched(&self, purpose: Purpose) -> Option<u64> {
        match purpose {
            Purpose::Roi(target) => self.targets.get(&target).copied(),
            _ => self.tile(purpose)?.frame,
        }
    }

    /// How many frames in a row were searched without any of the tiles.
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
