//! Poses with their evidence and priors, and the decision which of them is the body's.
//!
//! Two poses of a flat marker project almost alike (planar pose ambiguity), so one facet can agree with
//! two attitudes, and a second facet of a few pixels agrees by chance with the wrong one. A track decides
//! between them by its prediction ([`Aligner::confirm`]). Without one, hypotheses compete by their
//! evidence ([`Aligner::initiate`]).

use std::sync::{Arc, OnceLock};

use flockeye_geometry::body::{Bodies, Body};
use flockeye_geometry::pose::is_false;
use flockeye_imaging::align::{
    AlignError, AlignOptions, Alignment, BodyPrint, Coding, Motion, Picture, Place, PrintError,
    Templates, align, least_lead, reacquire, starts_at,
};
use flockeye_imaging::edges::MarkerPrint;
use nalgebra::{Isometry3, Unit, Vector3};

use crate::account::{Hypothesis, Notes, Source, Verdict};
use crate::policy::TimeBudget;

/// Log of the prior probability of a pose beyond the tilt limit: one in a thousand.
const TILTED_LOG: f64 = -6.9;
/// Standard deviation, about each axis, of the turn of right poses from their tracks' predictions, radians.
const TURN_SIGMA_RAD: f64 = 0.15;
/// The same of poses that alignment finds where no body is, from where it started: half of those with log odds above 1 had
/// turned by more than 0.46 (docs/results/decisions.md).
const FALSE_TURN_SIGMA_RAD: f64 = 0.3;

/// The view that shows a body best.
#[derive(Debug, Clone, Copy)]
pub struct BestView<'p> {
    /// The view, with its pixels.
    pub picture: Picture<'p>,
    /// Its place in the plan.
    pub view_index: u32,
    /// Squares in it that agree with one pose, where no marker was decoded and there is no track.
    pub agreeing: u32,
    /// The distance that its rays are right for, metres. It matters for lenses off the camera's centre.
    pub rays_m: f64,
}

impl BestView<'_> {
    /// The same view of a body that moves.
    pub fn moving(&self, motion: Motion) -> Self {
        Self { picture: Picture { motion, ..self.picture }, ..*self }
    }
}

/// Where alignment may start.
#[derive(Debug, Clone, PartialEq)]
pub enum Start {
    /// A pose (`camera_from_markers`) that is off by half a cell at most.
    Fine(Isometry3<f64>),
    /// A pose that may be off by more.
    Rough(Isometry3<f64>),
    /// A pose that was tried before with the same picture, and what it led to.
    Tried(Result<Box<Alignment>, AlignError>),
}

/// What a body is looked for in, and from where.
#[derive(Debug, Clone, Copy)]
pub struct Sought<'s> {
    /// The body's number.
    pub target: usize,
    /// The picture.
    pub picture: &'s Picture<'s>,
    /// Where alignment starts, in this order.
    pub starts: &'s [(Source, Start)],
    /// How much time there is.
    pub budget: TimeBudget,
}

/// Aligns the configured bodies with pictures, and decides which results are the bodies.
#[derive(Debug, Clone)]
pub struct Aligner {
    prints: Vec<BodyPrint>,
    /// Those of each print, made when they are needed first.
    templates: Arc<[OnceLock<Templates>]>,
    pixels_per_radian: f64,
    options: AlignOptions,
    tilt: Option<TiltPrior>,
}

/// How far from level neighbours fly.
#[derive(Debug, Clone)]
struct TiltPrior {
    /// Up on the observer, in the camera frame.
    up_in_camera: Unit<Vector3<f64>>,
    /// Up on each target, in its markers' frame. `None` for a target that may hang in any attitude.
    up_in_markers: Vec<Option<Unit<Vector3<f64>>>>,
    /// The largest tilt between a target and its observer, radians.
    max_rad: f64,
}

impl Aligner {
    /// For `bodies` whose markers look as `print_of` says, on a sphere image of this resolution.
    ///
    /// # Errors
    /// A marker that cannot be drawn.
    pub fn new<'p>(
        bodies: &Bodies,
        print_of: impl Fn(u32) -> Option<&'p MarkerPrint>,
        pixels_per_radian: f64,
    ) -> Result<Self, PrintError> {
        let prints: Vec<BodyPrint> =
            bodies.iter().map(|body| BodyPrint::new(body, &print_of)).collect::<Result<_, _>>()?;
        let templates = prints.iter().map(|_| OnceLock::new()).collect();
        let options = AlignOptions::default();
        Ok(Self { prints, templates, pixels_per_radian, options, tilt: None })
    }

    /// Multiplies covariances by this; see [`AlignOptions::covariance_scale`].
    pub fn with_covariance_scale(mut self, covariance_scale: f64) -> Self {
        self.options.covariance_scale = covariance_scale;
        self
    }

    /// Sets how the pictures are coded.
    pub fn with_coding(mut self, coding: Coding) -> Self {
        self.options.coding = coding;
        self
    }

    /// Sets how far targets may be tilted from their observer, whose camera is mounted as given: of two
    /// poses that look alike, one beyond `max_rad` is not the body's. With 0 nothing is known of the
    /// tilt. Nor is it ever of a body with a single marker, which may be stuck on anything.
    pub fn with_max_tilt(
        mut self,
        bodies: &Bodies,
        observer_from_camera: &Isometry3<f64>,
        max_rad: f64,
    ) -> Self {
        let up_in_markers = |body: &Body| {
            let up = body.target_from_markers.inverse() * Vector3::z_axis();
            (body.markers.len() > 1).then_some(up)
        };
        let tilt = || TiltPrior {
            up_in_camera: observer_from_camera.inverse() * Vector3::z_axis(),
            up_in_markers: bodies.iter().map(up_in_markers).collect(),
            max_rad,
        };
        self.tilt = (max_rad > 0.0).then(tilt);
        self
    }

    /// The sphere image's resolution.
    pub fn pixels_per_radian(&self) -> f64 {
        self.pixels_per_radian
    }

    /// Confirms where a body is, which its track `predicted`: aligns it from its starts until one
    /// leads to a precise pose that is accepted by itself, else takes the most likely of those that the
    /// track or decoded markers support, precise or not. Where the budget is spent, only the first start is tried.
    /// `is_marked` tells whether markers were decoded where a pose has them.
    pub fn confirm(
        &self,
        sought: &Sought<'_>,
        predicted: &Isometry3<f64>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
        notes: &mut Notes<'_>,
    ) -> Option<Alignment> {
        let Sought { target, picture, starts, budget } = *sought;
        let mut best: Option<(f64, Alignment)> = None;
        let max_starts = if budget == TimeBudget::Overspent { 1 } else { starts.len() };
        for (source, start) in starts.iter().take(max_starts) {
            let aligned = self.try_align(target, picture, start);
            let turn = aligned.as_ref().ok().map(|found| turn_log(found, predicted));
            notes.note(|| Hypothesis {
                turn_log: turn,
                is_marked: is_marked_at(&aligned, &is_marked),
                ..Hypothesis::of(*source, aligned.clone())
            });
            let (Some(turn), Ok(found)) = (turn, aligned) else { continue };
            let is_predicted = found.is_accepted_with_track_prior(turn);
            if is_predicted && found.is_accepted() && found.is_precise {
                notes.accept(&found);
                return Some(found);
            }
            let likelihood = found.evidence.log_odds + turn;
            // The prediction may speak against a marker's mirror pose. It does not make up for what the picture lacks.
            let is_supported =
                is_predicted || is_supported_by_markers(&found, turn.min(0.0), &is_marked);
            if is_supported {
                notes.decide_last(Verdict::LessLikely);
            }
            if is_supported && best.as_ref().is_none_or(|(most, _)| likelihood > *most) {
                best = Some((likelihood, found));
            }
        }
        let (_, found) = best?;
        notes.accept(&found);
        Some(found)
    }

    /// Finds a body of which no track is confirmed from all of its starts. The most likely precise hypothesis is
    /// accepted if it is likely enough by itself, and much more likely than all its rivals together.
    /// Rivals are what the other starts led to, and the mirror pose of its most informative facet.
    ///
    /// With a limited budget the first accepted pose that several facets tell ends the search: all starts
    /// of an untracked target took 113 ms, in which every other pose waits.
    pub fn initiate(
        &self,
        sought: &Sought<'_>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
        notes: &mut Notes<'_>,
    ) -> Option<Alignment> {
        let Sought { target, picture, starts, budget } = *sought;
        let mut found: Vec<Alignment> = Vec::new();
        for (source, start) in starts {
            let aligned = self.try_align(target, picture, start);
            notes.note(|| self.rival(target, *source, aligned.clone(), &is_marked));
            found.extend(aligned);
            let is_certain = |found: &Alignment| {
                found.is_accepted() && found.is_precise && found.evidence.is_unambiguous()
            };
            if budget != TimeBudget::Unlimited && found.last().is_some_and(is_certain) {
                break;
            }
        }
        let best = found
            .iter()
            .filter(|found| found.is_precise)
            .filter(|found| found.is_accepted() || is_supported_by_markers(found, 0.0, &is_marked))
            .max_by(|a, b| self.likelihood(target, a).total_cmp(&self.likelihood(target, b)))?;
        let mirror = self.mirror_of(target, picture, best);
        if let Some(mirror) = &mirror {
            notes.note(|| self.rival(target, Source::Mirror, Ok(mirror.clone()), &is_marked));
        }
        let rivals = found.iter().chain(&mirror).filter(|other| !is_same(best, other));
        let mut rivals: Vec<&Alignment> = rivals.collect();
        rivals.sort_by(|a, b| self.likelihood(target, b).total_cmp(&self.likelihood(target, a)));
        // Starts that led to the same pose are one rival: the most likely of them.
        let mut distinct: Vec<&Alignment> = Vec::new();
        for rival in rivals {
            if !distinct.iter().any(|other| is_same(other, rival)) {
                distinct.push(rival);
            }
        }
        let best_log = self.likelihood(target, best);
        let together: f64 =
            distinct.iter().map(|rival| (self.likelihood(target, rival) - best_log).exp()).sum();
        let is_chosen = together <= (-least_lead()).exp();
        notes.choose(best, &distinct, is_chosen, -together.ln());
        is_chosen.then(|| best.clone())
    }

    /// A hypothesis that competes with others, with what is known of it by itself.
    fn rival(
        &self,
        target: usize,
        source: Source,
        aligned: Result<Alignment, AlignError>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
    ) -> Hypothesis {
        let mut rival = Hypothesis {
            is_marked: is_marked_at(&aligned, &is_marked),
            ..Hypothesis::of(source, aligned)
        };
        if let Ok(found) = &rival.found {
            rival.tilt_log = self.tilt_log(target, found);
            if found.is_accepted() || is_supported_by_markers(found, 0.0, &is_marked) {
                rival.verdict =
                    if found.is_precise { Verdict::LessLikely } else { Verdict::Imprecise };
            }
        }
        rival
    }

    /// Log odds of a hypothesis, with what is known of how neighbours fly.
    fn likelihood(&self, target: usize, found: &Alignment) -> f64 {
        found.evidence.log_odds + self.tilt_log(target, found)
    }

    /// What is known of how neighbours fly, as log odds.
    fn tilt_log(&self, target: usize, found: &Alignment) -> f64 {
        if self.is_within_tilt(target, found) == Some(false) { TILTED_LOG } else { 0.0 }
    }

    /// What the mirror pose of a hypothesis, about its most informative facet, leads to.
    fn mirror_of(
        &self,
        target: usize,
        picture: &Picture<'_>,
        found: &Alignment,
    ) -> Option<Alignment> {
        let facet = found.evidence.most_informative_facet?;
        let mirror = self.prints.get(target)?.mirrored(facet, &found.camera_from_markers)?;
        self.align(target, picture, &Start::Fine(mirror))
    }

    /// Whether body `target` is tilted within the limit in a pose; `None` where no limit is known.
    fn is_within_tilt(&self, target: usize, found: &Alignment) -> Option<bool> {
        let tilt = self.tilt.as_ref()?;
        let up_in_markers = tilt.up_in_markers.get(target)?.as_ref()?;
        let tilt_rad = (found.camera_from_markers * up_in_markers).angle(&tilt.up_in_camera);
        Some(tilt_rad <= tilt.max_rad)
    }

    /// Searches for body `target` round where it was predicted.
    pub fn reacquire(
        &self,
        target: usize,
        picture: &Picture<'_>,
        predicted: &Isometry3<f64>,
    ) -> Option<Alignment> {
        reacquire(self.prints.get(target)?, picture, predicted, &self.options)
    }

    /// What was found, if it is precise. Else the likelier one of that and of what a search round a prediction finds.
    pub fn or_round(
        &self,
        found: Option<Alignment>,
        target: usize,
        picture: &Picture<'_>,
        predicted: &Isometry3<f64>,
        notes: &mut Notes<'_>,
    ) -> Option<Alignment> {
        if found.as_ref().is_some_and(|found| found.is_precise) {
            return found;
        }
        let searched = self.reacquire(target, picture, predicted);
        notes.note(|| {
            let aligned = searched.clone().ok_or(AlignError::Nothing);
            let verdict = if aligned.is_ok() { Verdict::Accepted } else { Verdict::NothingFound };
            Hypothesis { verdict, ..Hypothesis::of(Source::Search, aligned) }
        });
        let (Some(imprecise), Some(round)) = (&found, &searched) else { return found.or(searched) };
        let likelihood = |found: &Alignment| found.evidence.log_odds + turn_log(found, predicted);
        if likelihood(imprecise) > likelihood(round) {
            notes.decide_last(Verdict::LessLikely);
            return found;
        }
        searched
    }

    /// Searches for body `target` in any attitude at a place.
    ///
    /// What it finds competes as in [`Self::initiate`]. No more is asked of it: docs/results/places.md counts how likely
    /// the best pose is where nobody is.
    pub fn find_at(
        &self,
        target: usize,
        picture: &Picture<'_>,
        place: &Place,
        notes: &mut Notes<'_>,
    ) -> Option<Alignment> {
        let print = self.prints.get(target)?;
        let templates = self.templates.get(target)?.get_or_init(|| Templates::new(print));
        let starts = starts_at(print, templates, picture, place, &self.options);
        let starts: Vec<(Source, Start)> =
            starts.into_iter().map(|start| (Source::Place, Start::Rough(start))).collect();
        // The first that several facets tell will do: starts come best first.
        let sought = Sought { target, picture, starts: &starts, budget: TimeBudget::OneFrame };
        self.initiate(&sought, |_| false, notes)
    }

    /// What a start leads to, whether it is the body or not.
    pub fn align(&self, target: usize, picture: &Picture<'_>, start: &Start) -> Option<Alignment> {
        self.try_align(target, picture, start).ok()
    }

    /// The same, or why it leads to nothing.
    ///
    /// # Errors
    /// [`AlignError`].
    pub fn try_align(
        &self,
        target: usize,
        picture: &Picture<'_>,
        start: &Start,
    ) -> Result<Alignment, AlignError> {
        let (pose, coarse_first) = match start {
            Start::Fine(pose) => (pose, false),
            Start::Rough(pose) => (pose, true),
            Start::Tried(found) => return found.clone().map(|found| *found),
        };
        let options = AlignOptions { coarse_first, ..self.options };
        let print = self.prints.get(target).ok_or(AlignError::Nothing)?;
        align(print, picture, pose, &options)
    }
}

/// Log of the likelihood ratio of a pose's turn from its track's prediction, if it is right against if it is false. A
/// neighbour that was out of sight for a third of a second may have turned by as much as its mirror pose, and the
/// filter's gate allows for that.
pub fn turn_log(found: &Alignment, predicted: &Isometry3<f64>) -> f64 {
    let turn_rad = found.camera_from_markers.rotation.angle_to(&predicted.rotation);
    // Two normal densities in three axes.
    let density = |sigma: f64| -3.0 * sigma.ln() - 0.5 * (turn_rad / sigma).powi(2);
    density(TURN_SIGMA_RAD) - density(FALSE_TURN_SIGMA_RAD)
}

/// Whether a pose that is too weak alone is supported by markers that were decoded where it has them.
fn is_supported_by_markers(
    found: &Alignment,
    prior_log_odds: f64,
    is_marked: impl Fn(&Isometry3<f64>) -> bool,
) -> bool {
    found.is_accepted_with_markers(prior_log_odds) && is_marked(&found.camera_from_markers)
}

/// Whether markers were decoded where a pose has them that was found.
fn is_marked_at(
    aligned: &Result<Alignment, AlignError>,
    is_marked: impl Fn(&Isometry3<f64>) -> bool,
) -> bool {
    aligned.as_ref().is_ok_and(|found| is_marked(&found.camera_from_markers))
}

/// Whether two poses are the same for whoever uses them: neither is false if the other one is true.
fn is_same(one: &Alignment, other: &Alignment) -> bool {
    !is_false(&one.camera_from_markers, &other.camera_from_markers)
}

#[cfg(test)]
mod tests;
