//! Progress of the measurement of each target in one frame.

use nalgebra::Isometry3;

use crate::account::Trial;
use crate::measurement::PoseMeasurement;
use crate::policy::TimeBudget;

/// The inputs of an attempt that determine whether a retry can have another result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Attempt {
    /// The view that was read.
    pub(crate) view_index: Option<u32>,
    /// The number of rays of decoded corners. A frame's records only add to it.
    pub(crate) decoded: usize,
    /// Its time budget.
    pub(crate) budget: TimeBudget,
}

impl Attempt {
    /// Whether an attempt with these inputs is pointless after `failed`. A spent budget allows only
    /// the first start, so it adds nothing to an attempt that had time.
    pub(crate) fn is_pointless_after(&self, failed: &Self) -> bool {
        (Self { budget: failed.budget, ..*self } == *failed)
            && (self.budget == failed.budget || self.budget == TimeBudget::Overspent)
    }
}

/// Progress of a target's measurement in one frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) enum Status {
    #[default]
    Pending,
    /// The last try with these inputs failed. Only new inputs are worth a retry.
    Failed(Attempt),
    /// Its pose was published, possibly by the previous process. `direct_pose` is that pose if it
    /// came from the direct pass: markers that are decoded later are compared with it.
    Published {
        /// `camera_from_markers` of the direct pass.
        direct_pose: Option<Isometry3<f64>>,
    },
}

/// One target's part in one frame.
#[derive(Debug, Clone, Default)]
pub(crate) struct Part {
    pub(crate) status: Status,
    /// Whether the corner pass over its region of interest has run.
    pub(crate) is_region_tried: bool,
    /// The direct pass whose pose was not accepted: the same start need not be aligned again.
    pub(crate) rejected: Option<Box<Trial>>,
    /// The inputs of the requested background pass.
    pub(crate) background: Option<Attempt>,
    /// Pose that corrects the track, if no better one is found until the frame is complete.
    pub(crate) imprecise: Option<PoseMeasurement>,
}

impl Part {
    /// Whether the target's pose in the frame was published.
    pub(crate) fn is_published(&self) -> bool {
        matches!(self.status, Status::Published { .. })
    }

    /// The inputs of the last attempt, if that failed.
    pub(crate) fn failed(&self) -> Option<Attempt> {
        match self.status {
            Status::Failed(attempt) => Some(attempt),
            Status::Pending | Status::Published { .. } => None,
        }
    }

    /// The pose that the direct pass published, `camera_from_markers`.
    pub(crate) fn direct_pose(&self) -> Option<&Isometry3<f64>> {
        match &self.status {
            Status::Published { direct_pose } => direct_pose.as_ref(),
            Status::Pending | Status::Failed(_) => None,
        }
    }
}

/// The parts of `targets` targets in a frame, by their numbers. Poses of those that `is_published`
/// were published by the previous process.
pub(crate) fn parts_of(targets: usize, is_published: impl Fn(usize) -> bool) -> Vec<Part> {
    let part = |target| match is_published(target) {
        true => Part { status: Status::Published { direct_pose: None }, ..Part::default() },
        false => Part::default(),
    };
    (0..targets).map(part).collect()
}

/// Whether a target's pose in the frame was published.
pub(crate) fn is_published(parts: &[Part], target: usize) -> bool {
    parts.get(target).is_some_and(Part::is_published)
}

/// Numbers of the targets whose pose in the frame was not published.
pub(crate) fn unpublished(parts: &[Part]) -> impl Iterator<Item = usize> {
    (0..parts.len()).filter(|&target| !parts[target].is_published())
}
