//! A body aligned with the pixels of the best view of it.

use flockeye_geometry::body::Bodies;
use flockeye_imaging::align::{
    AlignOptions, Alignment, BodyPrint, Picture, PrintError, SURE_FACETS, Score, align, reacquire,
};
use flockeye_imaging::edges::MarkerPrint;
use nalgebra::Isometry3;

/// Two poses of a body are not the same one if they differ by more, radians, or by this share of
/// the range.
const OTHER_TURN_RAD: f64 = 0.2;
const OTHER_PLACE: f64 = 0.05;
/// Without a track, a pose that only one facet tells is believed if its facets agree so well
/// on average, and any other pose has at most this share of its log-likelihood. One marker of 14 px
/// was seen to reach 0.71 in the wrong attitude, and 1.2 times the right one's log-likelihood.
const ALONE_CORRELATION: f64 = 0.8;
const ALONE_RIVAL: f64 = 0.33;
/// One that two facets tell is believed if any other pose has at most this share of its evidence.
const TWICE_RIVAL: f64 = 0.9;
/// With a track, a pose that has turned by more than this from the prediction, radians, is believed if
/// it is sure: a neighbour that was out of sight for a third of a second may have turned by as much as
/// a mirror image, and the filter's gate, which knows that, lets it pass.
const SURPRISING_TURN_RAD: f64 = 0.35;

/// The view that shows a body best.
#[derive(Debug, Clone, Copy)]
pub struct BestView<'p> {
    /// The view, with its pixels.
    pub picture: Picture<'p>,
    /// Its place in the plan.
    pub view_index: u32,
    /// The distance that its rays are right for, metres; it matters for lenses beside the middle.
    pub rays_m: f64,
}

/// How much time there is for a look.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Pace {
    /// As much as it takes: nothing is late in a lossless run.
    #[default]
    Unhurried,
    /// The next frame is coming.
    Live,
    /// Newer frames wait already.
    Behind,
}

/// Aligns the configured bodies.
#[derive(Debug, Clone)]
pub struct Aligner {
    prints: Vec<BodyPrint>,
    pixels_per_radian: f64,
    options: AlignOptions,
}

impl Aligner {
    /// For `bodies` with markers that look as `print_of` says, on a sphere image of this resolution.
    ///
    /// # Errors
    /// A marker that cannot be drawn.
    pub fn new<'p>(
        bodies: &Bodies,
        print_of: impl Fn(u32) -> Option<&'p MarkerPrint>,
        pixels_per_radian: f64,
    ) -> Result<Self, PrintError> {
        let prints =
            bodies.iter().map(|body| BodyPrint::new(body, &print_of)).collect::<Result<_, _>>()?;
        Ok(Self { prints, pixels_per_radian, options: AlignOptions::default() })
    }

    /// Multiplies covariances by this; see [`AlignOptions::covariance_scale`].
    pub fn with_covariance_scale(mut self, covariance_scale: f64) -> Self {
        self.options.covariance_scale = covariance_scale;
        self
    }

    /// The sphere image's resolution.
    pub fn pixels_per_radian(&self) -> f64 {
        self.pixels_per_radian
    }

    /// Aligns body `target`, which was `predicted` by its track, from the first of `starts` that leads to
    /// it beyond doubt, or from the one whose end says most for it; from the first alone where newer
    /// frames wait. `None` if none does. `is_marked` says whether markers were decoded where a pose has them.
    pub fn follow(
        &self,
        target: usize,
        picture: &Picture<'_>,
        starts: &[Start],
        predicted: &Isometry3<f64>,
        pace: Pace,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
    ) -> Option<Alignment> {
        let mut best: Option<Alignment> = None;
        let most = if pace == Pace::Behind { 1 } else { starts.len() };
        for start in starts.iter().take(most) {
            let Some(found) = self.align(target, picture, start) else { continue };
            if is_surprising(&found, predicted) {
                continue;
            }
            if found.is_believed() {
                return Some(found);
            }
            let is_better = |best: &Alignment| found.score.log_ratio > best.score.log_ratio;
            let is_confirmed = found.confirms_track() || is_vouched_for(&found, &is_marked);
            if is_confirmed && best.as_ref().is_none_or(is_better) {
                best = Some(found);
            }
        }
        best
    }

    /// Aligns body `target`, of which nothing is known yet, from all of `starts`. One facet can look
    /// the same in two attitudes, mirror images of each other, and a second one agree by chance with the
    /// wrong one: the best pose is believed if three facets agree with it, or if it stands out among what
    /// its mirror image and the other starts lead to, by less if two facets tell it.
    /// Unless there is time, the first one that leads to a sure pose is the last: all eight of a newcomer
    /// were seen to take 113 ms, in which everybody's poses wait.
    pub fn discover(
        &self,
        target: usize,
        picture: &Picture<'_>,
        starts: &[Start],
        pace: Pace,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
    ) -> Option<Alignment> {
        let mut found: Vec<Alignment> = Vec::new();
        for start in starts {
            found.extend(self.align(target, picture, start));
            let is_sure = |found: &Alignment| {
                found.is_believed() && found.score.agreeing_facets >= SURE_FACETS
            };
            if pace != Pace::Unhurried && found.last().is_some_and(is_sure) {
                break;
            }
        }
        let best = found
            .iter()
            .filter(|found| found.is_believed() || is_vouched_for(found, &is_marked))
            .max_by(|a, b| a.score.evidence().total_cmp(&b.score.evidence()))?;
        if best.score.agreeing_facets >= SURE_FACETS {
            return Some(best.clone());
        }
        if !best.score.is_told_twice() && best.score.correlation <= ALONE_CORRELATION {
            return None;
        }
        let mirrored = best.score.foremost_facet.and_then(|facet| {
            let mirrored = self.prints.get(target)?.mirrored(facet, &best.camera_from_markers)?;
            self.align(target, picture, &Start::Fine(mirrored))
        });
        let mut rivals = found.iter().chain(&mirrored).filter(|other| !is_same(best, other));
        rivals.all(|rival| stands_out_against(&rival.score, &best.score)).then(|| best.clone())
    }

    /// Looks for body `target` round where it was predicted.
    pub fn reacquire(
        &self,
        target: usize,
        picture: &Picture<'_>,
        predicted: &Isometry3<f64>,
    ) -> Option<Alignment> {
        reacquire(self.prints.get(target)?, picture, predicted, &self.options)
    }

    /// What a start leads to, whether it is the body or not.
    pub fn align(&self, target: usize, picture: &Picture<'_>, start: &Start) -> Option<Alignment> {
        let (pose, coarse_first) = match start {
            Start::Fine(pose) => (pose, false),
            Start::Rough(pose) => (pose, true),
            Start::Tried(found) => return found.clone().map(|found| *found),
        };
        let options = AlignOptions { coarse_first, ..self.options };
        align(self.prints.get(target)?, picture, pose, &options).ok()
    }
}

/// Whether a pose has turned farther from the prediction than is believed of it.
pub fn is_surprising(found: &Alignment, predicted: &Isometry3<f64>) -> bool {
    let turn_rad = found.camera_from_markers.rotation.angle_to(&predicted.rotation);
    turn_rad > SURPRISING_TURN_RAD && found.score.agreeing_facets < SURE_FACETS
}

/// Whether so much more is said for the `best` pose than for another one that it may be believed.
fn stands_out_against(rival: &Score, best: &Score) -> bool {
    if best.is_told_twice() {
        rival.evidence() < TWICE_RIVAL * best.evidence()
    } else {
        rival.log_ratio < ALONE_RIVAL * best.log_ratio
    }
}

/// Whether markers that were decoded there speak for a pose.
fn is_vouched_for(found: &Alignment, is_marked: impl Fn(&Isometry3<f64>) -> bool) -> bool {
    found.confirms_marker() && is_marked(&found.camera_from_markers)
}

fn is_same(one: &Alignment, other: &Alignment) -> bool {
    let (one, other) = (&one.camera_from_markers, &other.camera_from_markers);
    let (here, there) = (one.translation.vector, other.translation.vector);
    one.rotation.angle_to(&other.rotation) < OTHER_TURN_RAD
        && (here - there).norm() < OTHER_PLACE * here.norm()
}

/// Where alignment may begin.
#[derive(Debug, Clone, PartialEq)]
pub enum Start {
    /// A pose (`camera_from_markers`) that is off by half a cell at most.
    Fine(Isometry3<f64>),
    /// One that may be off by more.
    Rough(Isometry3<f64>),
    /// One that was tried with the same picture before, and what it led to.
    Tried(Option<Box<Alignment>>),
}

#[cfg(test)]
mod tests;
