//! A body aligned with the pixels of the best view of it.

use flockeye_geometry::body::{Bodies, Body};
use flockeye_imaging::align::{
    AlignOptions, Alignment, BodyPrint, Evidence, Picture, PrintError, UNAMBIGUOUS_FACETS, align,
    reacquire,
};
use flockeye_imaging::edges::MarkerPrint;
use nalgebra::{Isometry3, Unit, Vector3};

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
/// One whose tilt alone tells it from its mirror image is believed if any other pose that flies as level
/// has at most this share of its evidence, and if so much of the body is as modelled.
const LEVEL_RIVAL: f64 = 0.3;
const LEVEL_SEEN: f64 = 0.5;
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
    level: Option<Level>,
}

/// How level everybody flies.
#[derive(Debug, Clone)]
struct Level {
    /// Up on the observer, in the camera frame.
    up_in_camera: Unit<Vector3<f64>>,
    /// Up on each target, in its markers' frame; `None` where one may hang anyhow.
    up_in_markers: Vec<Option<Unit<Vector3<f64>>>>,
    /// No target is tilted by more than this from its observer, radians.
    most_rad: f64,
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
        Ok(Self { prints, pixels_per_radian, options: AlignOptions::default(), level: None })
    }

    /// Multiplies covariances by this; see [`AlignOptions::covariance_scale`].
    pub fn with_covariance_scale(mut self, covariance_scale: f64) -> Self {
        self.options.covariance_scale = covariance_scale;
        self
    }

    /// Takes targets to be tilted by `most_rad` at most, as their observer sees them (with its camera
    /// mounted so): of two poses that look alike one that is tilted by more is not the one. 0: nothing is
    /// known of that, as it never is of one with a single marker, which may be stuck on anything.
    pub fn with_level(
        mut self,
        bodies: &Bodies,
        observer_from_camera: &Isometry3<f64>,
        most_rad: f64,
    ) -> Self {
        let up_in_markers = |body: &Body| {
            let up = body.target_from_markers.inverse() * Vector3::z_axis();
            (body.markers.len() > 1).then_some(up)
        };
        let level = || Level {
            up_in_camera: observer_from_camera.inverse() * Vector3::z_axis(),
            up_in_markers: bodies.iter().map(up_in_markers).collect(),
            most_rad,
        };
        self.level = (most_rad > 0.0).then(level);
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
            if found.is_accepted() {
                return Some(found);
            }
            let is_better = |best: &Alignment| found.evidence.log_ratio > best.evidence.log_ratio;
            let is_confirmed =
                found.is_accepted_with_track_prior() || is_vouched_for(&found, &is_marked);
            if is_confirmed && best.as_ref().is_none_or(is_better) {
                best = Some(found);
            }
        }
        best
    }

    /// Aligns body `target`, of which nothing is known yet, from all of `starts`. One facet can look
    /// the same in two attitudes, mirror images of each other, and a second one agree by chance with the
    /// wrong one: the best pose is believed if three facets agree with it, or if it stands out among what
    /// its mirror image and the other starts lead to, by less if two facets tell it and it flies level.
    /// Otherwise the best one that flies level is believed, if it stands out among those that do.
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
                found.is_accepted() && found.evidence.agreeing_facets >= UNAMBIGUOUS_FACETS
            };
            if pace != Pace::Unhurried && found.last().is_some_and(is_sure) {
                break;
            }
        }
        let believed: Vec<&Alignment> = found
            .iter()
            .filter(|found| found.is_accepted() || is_vouched_for(found, &is_marked))
            .collect();
        let best = says_most(believed.iter().copied())?;
        if best.evidence.agreeing_facets >= UNAMBIGUOUS_FACETS {
            return Some(best.clone());
        }
        let mirrored = self.mirrored(target, picture, best);
        let mut rivals = found.iter().chain(&mirrored).filter(|other| !is_same(best, other));
        // Nobody flies on its side by the word of two facets.
        let is_told_twice =
            best.evidence.is_unambiguous() && self.is_level(target, best) != Some(false);
        let is_told = is_told_twice || best.evidence.correlation > ALONE_CORRELATION;
        let stands_out =
            |rival: &Alignment| stands_out(&best.evidence, &rival.evidence, is_told_twice);
        if is_told && rivals.all(stands_out) {
            return Some(best.clone());
        }
        let is_level = |found: &&Alignment| self.is_level(target, found) == Some(true);
        let level = says_most(believed.into_iter().filter(is_level))?;
        let mirrored = if std::ptr::eq(level, best) {
            mirrored
        } else {
            self.mirrored(target, picture, level)
        };
        let rivals = found.iter().chain(&mirrored).filter(|other| !is_same(level, other));
        let rival_evidence = LEVEL_RIVAL * level.evidence.weighted_log_ratio();
        let is_believed = level.visible_share >= LEVEL_SEEN
            && rivals
                .filter(is_level)
                .all(|rival| rival.evidence.weighted_log_ratio() < rival_evidence);
        is_believed.then(|| level.clone())
    }

    /// What the mirror image of the facet that says most for a pose leads to.
    fn mirrored(
        &self,
        target: usize,
        picture: &Picture<'_>,
        found: &Alignment,
    ) -> Option<Alignment> {
        let facet = found.evidence.most_informative_facet?;
        let mirrored = self.prints.get(target)?.mirrored(facet, &found.camera_from_markers)?;
        self.align(target, picture, &Start::Fine(mirrored))
    }

    /// Whether body `target` flies as level in a pose as it does; `None` where that is not known.
    fn is_level(&self, target: usize, found: &Alignment) -> Option<bool> {
        let level = self.level.as_ref()?;
        let up_in_markers = level.up_in_markers.get(target)?.as_ref()?;
        let tilt_rad = (found.camera_from_markers * up_in_markers).angle(&level.up_in_camera);
        Some(tilt_rad <= level.most_rad)
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
    turn_rad > SURPRISING_TURN_RAD && found.evidence.agreeing_facets < UNAMBIGUOUS_FACETS
}

/// The pose that most is said for.
fn says_most<'a>(found: impl Iterator<Item = &'a Alignment>) -> Option<&'a Alignment> {
    found.max_by(|a, b| a.evidence.weighted_log_ratio().total_cmp(&b.evidence.weighted_log_ratio()))
}

/// Whether so much more is said for the `best` pose than for a `rival` that it may be believed.
fn stands_out(best: &Evidence, rival: &Evidence, is_told_twice: bool) -> bool {
    if is_told_twice {
        rival.weighted_log_ratio() < TWICE_RIVAL * best.weighted_log_ratio()
    } else {
        rival.log_ratio < ALONE_RIVAL * best.log_ratio
    }
}

/// Whether markers that were decoded there speak for a pose.
fn is_vouched_for(found: &Alignment, is_marked: impl Fn(&Isometry3<f64>) -> bool) -> bool {
    found.is_accepted_with_markers() && is_marked(&found.camera_from_markers)
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
