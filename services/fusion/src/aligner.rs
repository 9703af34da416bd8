//! Tries poses: aligns bodies with pictures from several starts, and collects the results for a
//! decision.
//!
//! Two poses of a flat marker project almost alike (planar pose ambiguity). So one facet can fit
//! two attitudes, and a second facet of a few pixels fits the wrong one by chance. A track decides
//! between them by its prediction ([`Aligner::confirm`]). Without one, hypotheses compete by their
//! evidence ([`Aligner::initiate`]).

use std::sync::{Arc, OnceLock};

use flockeye_geometry::body::{Bodies, Body};
use flockeye_geometry::pose::PoseEstimate;
use flockeye_imaging::align::{
    AlignError, AlignOptions, Alignment, BodyPrint, Motion, Picture, Place, PrintError, Templates,
    align, starts_at,
};
use flockeye_imaging::edges::MarkerPrint;
use nalgebra::{Isometry3, Unit, Vector3};

use crate::decide::{self, Decision};
use crate::hypothesis::{Hypothesis, StartSource};
use crate::policy::TimeBudget;

/// The best view of a body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BestView<'p> {
    /// The view, with its pixels.
    pub picture: Picture<'p>,
    /// Its place in the plan.
    pub(crate) view_index: u32,
    /// Distance for which its rays are exact, metres. It matters for lenses off the camera's
    /// centre.
    pub(crate) rays_m: f64,
}

impl BestView<'_> {
    /// Returns this view for a body that moves.
    pub(crate) fn moving(&self, motion: Motion) -> Self {
        Self { picture: Picture { motion, ..self.picture }, ..*self }
    }
}

/// Start of an alignment.
#[derive(Debug, Clone, PartialEq)]
pub enum Start {
    /// A pose (`camera_from_markers`) with an error of half a cell at most.
    Fine(Isometry3<f64>),
    /// A pose with a possibly larger error.
    Rough(Isometry3<f64>),
    /// A pose that was tried before with the same picture, with its result.
    Tried(Result<Box<Alignment>, AlignError>),
}

/// Search for a body: its picture and starts.
#[derive(Debug, Clone, Copy)]
pub struct Sought<'s> {
    /// The body's number.
    pub target: usize,
    /// The picture.
    pub picture: &'s Picture<'s>,
    /// Starts of the alignment, in this order.
    pub starts: &'s [(StartSource, Start)],
    /// The time budget.
    pub budget: TimeBudget,
}

/// Aligns the configured bodies with pictures.
#[derive(Debug, Clone)]
pub struct Aligner {
    prints: Vec<BodyPrint>,
    /// Templates of each print, made at their first use.
    templates: Arc<[OnceLock<Templates>]>,
    pub(crate) pixels_per_radian: f64,
    options: AlignOptions,
    /// The largest tilt between a target and its observer, radians; 0 if it is not known.
    max_tilt_rad: f64,
    /// Up on the observer, in the camera frame.
    up_in_camera: Unit<Vector3<f64>>,
    /// Up on each target, in its markers' frame. `None` for a target that may have any attitude.
    up_in_markers: Vec<Option<Unit<Vector3<f64>>>>,
}

impl Aligner {
    /// Creates the aligner of `bodies`, with their markers from `print_of`, on a sphere image of
    /// this resolution.
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
        Ok(Self {
            prints,
            templates,
            pixels_per_radian,
            options: AlignOptions::default(),
            max_tilt_rad: 0.0,
            up_in_camera: Vector3::z_axis(),
            up_in_markers: Vec::new(),
        })
    }

    /// Sets a factor on covariances; see [`AlignOptions::covariance_scale`].
    pub(crate) fn with_covariance_scale(mut self, covariance_scale: f64) -> Self {
        self.options.covariance_scale = covariance_scale;
        self
    }

    /// Sets another factor on covariances; see [`AlignOptions::coding_covariance_scale`].
    pub(crate) fn with_coding_covariance_scale(mut self, scale: f64) -> Self {
        self.options.coding_covariance_scale = scale;
        self
    }

    /// Sets the largest tilt of targets from their observer, whose camera is mounted as given. If
    /// two poses look alike, one beyond `max_rad` is not the body's. With 0 the tilt is not known.
    /// It is never known for a body with a single marker, which may be attached to anything.
    pub(crate) fn with_max_tilt(
        mut self,
        bodies: &Bodies,
        observer_from_camera: &Isometry3<f64>,
        max_rad: f64,
    ) -> Self {
        let up_in_markers = |body: &Body| {
            let up = body.target_from_markers.inverse() * Vector3::z_axis();
            (body.markers.len() > 1).then_some(up)
        };
        self.max_tilt_rad = max_rad;
        self.up_in_camera = observer_from_camera.inverse() * Vector3::z_axis();
        self.up_in_markers = bodies.iter().map(up_in_markers).collect();
        self
    }

    /// Searches for a body from its starts. `confirmed` is the prediction of a confirmed track. The
    /// other parameters are those of [`Self::confirm`] and [`Self::initiate`].
    pub(crate) fn find(
        &self,
        sought: &Sought<'_>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
        confirmed: Option<&PoseEstimate>,
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        match confirmed {
            Some(predicted) => self.confirm(sought, predicted, is_marked, tried),
            None => self.initiate(sought, is_marked, tried),
        }
    }

    /// Confirms the pose of a body, which its track `predicted`. Aligns it from its starts until
    /// one leads to a certain pose. With a spent budget, only the first start is tried. `is_marked`
    /// returns whether markers were decoded at the places of a pose. The hypotheses are added to
    /// `tried`.
    pub fn confirm(
        &self,
        sought: &Sought<'_>,
        predicted: &PoseEstimate,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        let Sought { target, picture, starts, budget } = *sought;
        let max_starts = if budget == TimeBudget::Overspent { 1 } else { starts.len() };
        for (source, start) in starts.iter().take(max_starts) {
            // The prediction would pull other starts away from the pose that they support.
            let guide = source.is_prediction().then_some(predicted);
            let found = self.try_align(target, picture, start, guide);
            let hypothesis = self.predicted(target, *source, found, predicted, &is_marked);
            let is_certain = decide::is_certain(&hypothesis);
            tried.push(hypothesis);
            if is_certain {
                break;
            }
        }
        let decision = decide::of_tracked(tried);
        self.or_mirror(decision, target, picture, predicted, is_marked, tried)
    }

    /// Also tries the mirror pose of the chosen pose, unless that is imprecise, or several facets or
    /// the prediction exclude the mirror pose.
    fn or_mirror(
        &self,
        decision: Decision,
        target: usize,
        picture: &Picture<'_>,
        predicted: &PoseEstimate,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        let is_undecided =
            |found: &&Alignment| found.is_precise && !found.evidence.is_unambiguous();
        let Some(best) = decision.chosen_of(tried).filter(is_undecided) else { return decision };
        let Some(mirror) = self.mirror_pose(target, best) else { return decision };
        if decide::excludes_mirror(predicted, &best.camera_from_markers, &mirror) {
            return decision;
        }
        let found = self.try_align(target, picture, &Start::Fine(mirror), None);
        tried.push(self.predicted(target, StartSource::Mirror, found, predicted, is_marked));
        decide::with_mirror(decision, tried)
    }

    /// A hypothesis about a body that a confirmed track predicts.
    fn predicted(
        &self,
        target: usize,
        source: StartSource,
        found: Result<Alignment, AlignError>,
        predicted: &PoseEstimate,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
    ) -> Hypothesis {
        let found_pose = found.as_ref().ok().map(|found| found.camera_from_markers);
        let turn_log = found_pose.map(|found| decide::turn_log(&found, predicted));
        Hypothesis { turn_log, ..self.competing(target, source, found, is_marked) }
    }

    /// Finds a body of which no track is confirmed from all of its starts. Hypotheses compete: the
    /// results of the starts, and the mirror pose of the likeliest one about its most informative
    /// facet. The hypotheses are added to `tried`.
    ///
    /// Every other pose waits for these starts. So with a limited budget the first accepted pose that
    /// several facets support ends the search.
    pub fn initiate(
        &self,
        sought: &Sought<'_>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        let Sought { target, picture, starts, budget } = *sought;
        for (source, start) in starts {
            let found = self.try_align(target, picture, start, None);
            let hypothesis = self.competing(target, *source, found, &is_marked);
            let is_last = decide::ends_competition(&hypothesis, budget);
            tried.push(hypothesis);
            if is_last {
                break;
            }
        }
        let likeliest = decide::likeliest(tried);
        let best = likeliest.and_then(|index| tried.get(index)?.alignment());
        if let Some(mirror) = best.and_then(|best| self.mirror_pose(target, best)) {
            let found = self.try_align(target, picture, &Start::Fine(mirror), None);
            tried.push(self.competing(target, StartSource::Mirror, found, &is_marked));
        }
        // The mirror pose may be the likelier one.
        decide::of_untracked(tried, decide::likeliest(tried))
    }

    /// A hypothesis that competes with others, with the evidence for it alone.
    fn competing(
        &self,
        target: usize,
        source: StartSource,
        found: Result<Alignment, AlignError>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
    ) -> Hypothesis {
        let is_within_tilt = found.as_ref().ok().map(|found| self.is_within_tilt(target, found));
        let tilt_log = decide::tilt_log(is_within_tilt.flatten());
        Hypothesis { tilt_log, ..Hypothesis::marked(source, found, is_marked) }
    }

    /// The mirror pose of a hypothesis, about its most informative facet.
    fn mirror_pose(&self, target: usize, found: &Alignment) -> Option<Isometry3<f64>> {
        let facet = found.evidence.most_informative_facet?;
        self.prints.get(target)?.mirrored(facet, &found.camera_from_markers)
    }

    /// Whether body `target` is tilted within the limit in a pose; `None` where no limit is known.
    fn is_within_tilt(&self, target: usize, found: &Alignment) -> Option<bool> {
        let up_in_markers = self.up_in_markers.get(target)?.filter(|_| self.max_tilt_rad > 0.0)?;
        let tilt_rad = (found.camera_from_markers * up_in_markers).angle(&self.up_in_camera);
        Some(tilt_rad <= self.max_tilt_rad)
    }

    /// Searches for body `target` in any attitude at a place.
    ///
    /// The results compete as in [`Self::initiate`]. There is no further condition:
    /// docs/results/places.md has the log odds of the best pose at places without a body.
    pub(crate) fn find_at(
        &self,
        target: usize,
        picture: &Picture<'_>,
        place: &Place,
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        let Some((print, templates)) = self.prints.get(target).zip(self.templates.get(target))
        else {
            return Decision::default();
        };
        let templates = templates.get_or_init(|| Templates::new(print));
        let starts = starts_at(print, templates, picture, place, &self.options);
        let starts: Vec<(StartSource, Start)> =
            starts.into_iter().map(|start| (StartSource::Place, Start::Rough(start))).collect();
        // The first pose that several facets support is enough, because starts come best first.
        let sought = Sought { target, picture, starts: &starts, budget: TimeBudget::OneFrame };
        self.initiate(&sought, |_| false, tried)
    }

    /// Aligns from a start. The pose may belong to no body.
    pub fn align(&self, target: usize, picture: &Picture<'_>, start: &Start) -> Option<Alignment> {
        self.try_align(target, picture, start, None).ok()
    }

    /// Aligns from a start, as [`Aligner::align`], guided by a prediction. Without a result, returns
    /// the reason.
    ///
    /// # Errors
    /// [`AlignError`].
    pub(crate) fn try_align(
        &self,
        target: usize,
        picture: &Picture<'_>,
        start: &Start,
        predicted: Option<&PoseEstimate>,
    ) -> Result<Alignment, AlignError> {
        let (pose, coarse_first) = match start {
            Start::Fine(pose) => (pose, false),
            Start::Rough(pose) => (pose, true),
            Start::Tried(found) => return found.clone().map(|found| *found),
        };
        let predicted = predicted.copied();
        let options = AlignOptions { coarse_first, predicted, ..self.options };
        let print = self.prints.get(target).ok_or(AlignError::Nothing)?;
        align(print, picture, pose, &options)
    }
}

#[cfg(test)]
mod tests;
