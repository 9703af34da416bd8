//! What was searched, and when.

use std::collections::BTreeMap;

use super::Purpose;

/// Which partitions and targets were looked at in which frame, and the partition of the last hit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Searched {
    partitions: Vec<Option<u64>>,
    targets: BTreeMap<usize, u64>,
    last_hit: Option<usize>,
}

impl Searched {
    /// Nothing of `partitions` partitions was searched yet.
    pub fn new(partitions: usize) -> Self {
        Self { partitions: vec![None; partitions], targets: BTreeMap::new(), last_hit: None }
    }

    /// Notes that a view was cut and searched in frame number `frame`, which must rise from frame
    /// to frame (also where the source begins anew). Partitions that do not exist are ignored.
    pub fn record(&mut self, frame: u64, purpose: Purpose) {
        match purpose {
            Purpose::Partition(part) => {
                if let Some(last) = self.partitions.get_mut(part) {
                    *last = Some(frame);
                }
            }
            Purpose::Gaze(target) => {
                self.targets.insert(target, frame);
            }
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
            Purpose::Partition(part) => self.partitions.get(part).copied().flatten(),
            Purpose::Gaze(target) => self.targets.get(&target).copied(),
        }
    }
}
