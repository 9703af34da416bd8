//! How far the measurement of each target has come in one frame.

use flockeye_imaging::align::{AlignError, Alignment};
use nalgebra::Isometry3;

use crate::measurement::Measurement;
use crate::policy::TimeBudget;

/// The inputs of an attempt, as far as they decide whether a retry can find anything new.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attempt {
    /// The view that was read.
    pub view_index: Option<u32>,
    /// The number of rays of decoded corners. A frame's records only add to it.
    pub decoded: usize,
    /// The number of rays of squares that are probably markers.
    pub candidates: usize,
    /// How much time there was.
    pub budget: TimeBudget,
}

impl Attempt {
    /// Whether an attempt with these inputs is pointless after `failed` found nothing. A spent
    /// budget allows only the first start, so it adds nothing to an attempt that had time.
    pub fn is_pointless_after(&self, failed: &Self) -> bool {
        (Self { budget: failed.budget, ..*self } == *failed)
            && (self.budget == failed.budget || self.budget == TimeBudget::Overspent)
    }
}

/// What a direct pass found and did not accept, whether it is the body or not.
#[derive(Debug, Clone)]
pub struct RejectedAlignment {
    /// The prediction that it started from, `camera_from_markers`.
    pub predicted: Isometry3<f64>,
    /// The view's place in the plan.
    pub view_index: u32,
    /// What it led to.
    pub found: Result<Box<Alignment>, AlignError>,
}

/// How far a target's measurement in one frame has come.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Status {
    /// The target was not tried yet.
    #[default]
    Pending,
    /// The last try with these inputs led to nothing. Only new inputs are worth a retry.
    Failed(Attempt),
    /// Its pose has left, or may have left the process before this one. `direct_pose` is that pose
    /// where it came from the direct pass: markers that are decoded later are compared with it.
    Published {
        /// `camera_from_markers` of the direct pass.
        direct_pose: Option<Isometry3<f64>>,
    },
}

/// One target's part in one frame.
#[derive(Debug, Clone, Default)]
pub struct Part {
    /// How far its measurement has come.
    pub status: Status,
    /// Whether the corner pass over its region of interest has run.
    pub is_region_tried: bool,
    /// What the direct pass found but did not accept: the same start need not be aligned again.
    pub rejected: Option<RejectedAlignment>,
    /// The inputs of the background pass that was asked for.
    pub background: Option<Attempt>,
    /// What is left to correct the track by, if nothing better is found until the frame is complete.
    pub imprecise: Option<Measurement>,
}

impl Part {
    /// Whether the target's pose in the frame has left.
    pub fn is_published(&self) -> bool {
        matches!(self.status, Status::Published { .. })
    }

    /// The inputs of the last attempt, if that failed.
    pub fn failed(&self) -> Option<Attempt> {
        match self.status {
            Status::Failed(attempt) => Some(attempt),
            Status::Pending | Status::Published { .. } => None,
        }
    }

    /// The pose that the direct pass published, `camera_from_markers`.
    pub fn direct_pose(&self) -> Option<&Isometry3<f64>> {
        match &self.status {
            Status::Published { direct_pose } => direct_pose.as_ref(),
            Status::Pending | Status::Failed(_) => None,
        }
    }
}

/// The parts of all targets in one frame, by the targets' numbers.
#[derive(Debug, Clone, Default)]
pub struct Parts(Vec<Part>);

impl Parts {
    /// Parts of `targets` targets. Poses of those that `is_published` have left the process before
    /// this one.
    pub fn new(targets: usize, is_published: impl Fn(usize) -> bool) -> Self {
        let part = |target| match is_published(target) {
            true => Part { status: Status::Published { direct_pose: None }, ..Part::default() },
            false => Part::default(),
        };
        Self((0..targets).map(part).collect())
    }

    /// A target's part; `None` where there is no such target.
    pub fn get(&self, target: usize) -> Option<&Part> {
        self.0.get(target)
    }

    /// A target's part, to be changed; `None` where there is no such target.
    pub fn get_mut(&mut self, target: usize) -> Option<&mut Part> {
        self.0.get_mut(target)
    }

    /// Whether a target's pose in the frame has left.
    pub fn is_published(&self, target: usize) -> bool {
        self.get(target).is_some_and(Part::is_published)
    }

    /// Numbers of the targets whose pose in the frame has not left.
    pub fn unpublished(&self) -> impl Iterator<Item = usize> {
        (0..self.0.len()).filter(|&target| !self.is_published(target))
    }

    /// Numbers of the targets that the direct pass has measured.
    pub fn measured_directly(&self) -> impl Iterator<Item = usize> {
        (0..self.0.len()).filter(|&target| self.0[target].direct_pose().is_some())
    }
}
