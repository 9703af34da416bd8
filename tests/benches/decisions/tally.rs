//! Shares of right and of wrong poses that each decision accepts.

use flockeye_fusion::{StartSource, of_tracked, turn_log};
use flockeye_geometry::pose::{PoseEstimate, is_false, least_lead};
use flockeye_geometry::statistics::quantile;
use flockeye_imaging::align::Alignment;
use nalgebra::{Isometry3, Matrix6};

use crate::STOPS;

/// The start of an alignment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Near the right pose.
    Right,
    /// Near a mirror pose of one of its facets.
    Mirrored,
    /// In another attitude, at the place of the body.
    Turned,
    /// At the place of another body.
    Other,
    /// At a place without a body.
    Absent,
}

/// A pose that alignment found.
pub struct Hypothesis {
    pub kind: Kind,
    pub origin: &'static str,
    /// Exposure, stops from the right one.
    pub stop: f64,
    /// The right pose; `None` at a place without a body.
    pub truth: Option<Isometry3<f64>>,
    /// Length of the motion blur, pixels; 0 without a body.
    pub blur_px: f64,
    /// Start of the alignment.
    pub start: Isometry3<f64>,
    pub found: Alignment,
    /// The mirror pose of what was found, if it differs.
    pub rival: Option<Alignment>,
    /// The prediction of a track that has coasted for half a second.
    pub coasted: PoseEstimate,
}

impl Hypothesis {
    fn distance_m(&self) -> f64 {
        self.truth.unwrap_or(self.start).translation.vector.norm()
    }

    fn is_right(&self) -> bool {
        self.truth.is_some_and(|truth| !is_false(&self.found.camera_from_markers, &truth))
    }

    fn log_odds(&self) -> f64 {
        self.found.evidence.log_odds
    }

    /// Log odds minus those of the mirror pose.
    fn lead(&self) -> f64 {
        let rival = self.rival.as_ref();
        rival.map_or(f64::INFINITY, |rival| self.log_odds() - rival.evidence.log_odds)
    }

    /// Whether the decision accepts it for a body without a track.
    fn is_accepted(&self) -> bool {
        self.found.is_accepted() && self.found.is_precise && self.lead() > least_lead()
    }

    /// Whether the decision accepts it for a body whose track predicts the right pose.
    fn is_confirmed(&self) -> bool {
        let known =
            |truth| PoseEstimate { camera_from_markers: truth, covariance: Matrix6::zeros() };
        let found = &self.found.camera_from_markers;
        let turn_log = self.truth.map_or(0.0, |truth| turn_log(found, &known(truth)));
        self.found.is_precise && self.found.is_accepted_with_track_prior(turn_log)
    }

    /// Whether the decision accepts it as a measurement for a body whose track has coasted.
    fn is_confirmed_after_coasting(&self) -> bool {
        let tried: Vec<flockeye_fusion::Hypothesis> = [Some(&self.found), self.rival.as_ref()]
            .into_iter()
            .flatten()
            .map(|found| flockeye_fusion::Hypothesis {
                turn_log: Some(turn_log(&found.camera_from_markers, &self.coasted)),
                ..flockeye_fusion::Hypothesis::of(StartSource::Prediction, Ok(found.clone()))
            })
            .collect();
        let decision = of_tracked(&tried);
        decision.hypothesis() == Some(0) && decision.lead.is_none() && self.found.is_precise
    }
}

/// A name, and the hypotheses of the group.
type Group = (String, Box<dyn Fn(&Hypothesis) -> bool>);

/// All hypotheses.
#[derive(Default)]
pub struct Tally(Vec<Hypothesis>);

impl Tally {
    pub fn add(&mut self, hypothesis: Hypothesis) {
        self.0.push(hypothesis);
    }

    pub fn print(&self) {
        self.print_starts();
        self.print_decisions();
        self.print_calibration();
        self.print_groups();
    }

    fn begun(&self, kind: Kind) -> impl Iterator<Item = &Hypothesis> {
        self.0.iter().filter(move |hypothesis| hypothesis.kind == kind)
    }

    fn print_starts(&self) {
        println!("begun      poses  right");
        for kind in [Kind::Right, Kind::Mirrored, Kind::Turned, Kind::Other, Kind::Absent] {
            let right = self.begun(kind).filter(|h| h.is_right()).count();
            println!("{:<9} {:>6} {right:>6}", format!("{kind:?}"), self.begun(kind).count());
        }
    }

    fn print_decisions(&self) {
        println!("\naccepted                    right  wrong: of the body  of another  of nobody");
        let right: Vec<_> = self.begun(Kind::Right).filter(|h| h.is_right()).collect();
        let row = |name: &str, accepts: &dyn Fn(&Hypothesis) -> bool| {
            let hits = right.iter().filter(|h| accepts(h)).count();
            let wrong = |kinds: &[Kind]| {
                let of = self.0.iter().filter(|h| kinds.contains(&h.kind) && !h.is_right());
                of.filter(|h| accepts(h)).count()
            };
            println!(
                "{name:<24} {:>6.1} % {:>19} {:>11} {:>10}",
                100.0 * hits as f64 / right.len() as f64,
                wrong(&[Kind::Right, Kind::Mirrored, Kind::Turned]),
                wrong(&[Kind::Other]),
                wrong(&[Kind::Absent]),
            );
        };
        row("without a track", &Hypothesis::is_accepted);
        row("as its track predicts", &Hypothesis::is_confirmed);
        row("half a second coasted", &Hypothesis::is_confirmed_after_coasting);
        for least in 0..=8 {
            row(&format!("log odds above {least}"), &|h| h.log_odds() > f64::from(least));
        }
        for least in [2.0, 4.0, 6.0] {
            row(&format!("{least} and {least} before its mirror"), &|h| {
                h.log_odds() > least && h.lead() > least
            });
        }
    }

    /// Prints, for poses without a body, the number with log odds above x beside the expected one:
    /// the number above 0 times e^-x.
    fn print_calibration(&self) {
        let above = |least: f64| self.begun(Kind::Absent).filter(|h| h.log_odds() > least).count();
        println!("\nlog odds above   of nobody   e^-x of those above 0");
        for least in 0..=8 {
            let least = f64::from(least);
            let stated = above(0.0) as f64 * (-least).exp();
            println!("{least:>14} {:>11} {stated:>23.1}", above(least));
        }
        let likely = self.begun(Kind::Absent).filter(|h| h.log_odds() > 1.0);
        let mut turned: Vec<f64> = likely
            .map(|h| h.start.rotation.angle_to(&h.found.camera_from_markers.rotation))
            .collect();
        turned.sort_by(f64::total_cmp);
        let turned = [0.1, 0.5, 0.9].map(|share| quantile(&turned, share).unwrap_or(f64::NAN));
        println!(
            "those above 1 have turned from where they began, radians: 10 % {:.2}, median {:.2}, 90 % {:.2}",
            turned[0], turned[1], turned[2]
        );
    }

    fn print_groups(&self) {
        println!(
            "\nbegun near the right pose       poses  without a track  as predicted  log odds > 5"
        );
        let mut groups: Vec<Group> = Vec::new();
        for (near, far) in [(0.6, 1.5), (1.5, 2.2), (2.2, 3.0), (3.0, 4.0)] {
            let is_in =
                move |h: &Hypothesis| (near..far).contains(&h.distance_m()) && h.stop == 0.0;
            groups.push((format!("{near} to {far} m"), Box::new(is_in)));
        }
        for (least, most) in [(0.0, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 99.0)] {
            let is_in = move |h: &Hypothesis| (least..most).contains(&h.blur_px) && h.stop == 0.0;
            groups.push((format!("blur {least} to {most} px"), Box::new(is_in)));
        }
        for stop in STOPS {
            let is_in = move |h: &Hypothesis| h.stop == stop && h.origin == "simulated";
            groups.push((format!("simulated, {stop:+} stops"), Box::new(is_in)));
        }
        for origin in ["flight1", "flight4", "stills"] {
            groups.push((origin.to_owned(), Box::new(move |h| h.origin == origin)));
        }
        for (name, is_in) in groups {
            let all: Vec<_> = self.begun(Kind::Right).filter(|h| is_in(h)).collect();
            let share = |accepts: &dyn Fn(&Hypothesis) -> bool| {
                let accepted = all.iter().filter(|h| h.is_right() && accepts(h)).count();
                100.0 * accepted as f64 / all.len().max(1) as f64
            };
            println!(
                "{name:<30} {:>6} {:>14.1} % {:>11.1} % {:>11.1} %",
                all.len(),
                share(&Hypothesis::is_accepted),
                share(&Hypothesis::is_confirmed),
                share(&|h| h.log_odds() > 5.0),
            );
        }
    }
}
