//! Decisions: measures how often a pose from alignment is wrong, by its log odds from the picture.
//!
//! Bodies are aligned in pictures that show them: from the right pose, from mirror poses, from
//! other attitudes, and with another body's print. They are also aligned in pictures without them.
//! Prints the accepted shares of right and of wrong poses, by distance, blur and light. `make
//! results PARTS=decisions` keeps the tables.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "decisions/chance.rs"]
mod chance;
#[path = "shared/frames.rs"]
mod frames;
#[path = "decisions/pictures.rs"]
mod pictures;
#[path = "decisions/tally.rs"]
mod tally;

use flockeye_imaging::align::{AlignOptions, BodyPrint, Picture, align};
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Isometry3, Translation3, Vector3};

use chance::Chance;
use pictures::{Shown, Still};
use tally::{Hypothesis, Kind, Tally};

/// Largest angle between equal poses.
const SAME_RAD: f64 = 0.2;
/// Number of wrong attitudes that are tried for each body.
const TURNS: usize = 3;
/// Share of the facets by which a body is mirrored.
const MIRRORS: f64 = 0.15;
/// Numbers of places without a body that are tried in each original picture, and in each picture
/// with another exposure.
const PLACES: usize = 60;
const PLACES_EXPOSED: usize = 6;
/// Least angle between a body and a place without a body, radians.
const APART_RAD: f64 = 0.35;
/// Distances of the bodies, metres.
const RANGES_M: std::ops::Range<f64> = 0.6..4.0;
/// Exposures of simulated pictures, stops from the right one.
const STOPS: [f64; 8] = [-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0];

fn main() {
    // `cargo test` runs each benchmark once, without this argument.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    let mut bench = Bench {
        light: LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap(),
        chance: Chance::new(77),
        tally: Tally::default(),
    };
    pictures::simulated(|still| {
        for stop in STOPS {
            bench.judge(&still.exposed(stop), stop);
        }
    });
    pictures::recorded(|still| bench.judge(still, 0.0));
    bench.tally.print();
}

struct Bench {
    light: LinearLight,
    chance: Chance,
    tally: Tally,
}

impl Bench {
    /// Aligns bodies at places with and without them in a picture.
    fn judge(&mut self, still: &Still, stop: f64) {
        for shown in &still.bodies {
            if RANGES_M.contains(&shown.camera_from_markers.translation.vector.norm()) {
                self.judge_body(still, shown, stop);
            }
        }
        for _ in 0..if stop == 0.0 { PLACES } else { PLACES_EXPOSED } {
            self.judge_place(still, stop);
        }
    }

    fn judge_body(&mut self, still: &Still, shown: &Shown, stop: f64) {
        let truth = &shown.camera_from_markers;
        let own = &still.prints[shown.body];
        let others = || still.prints.iter().enumerate().filter(|(k, _)| *k != shown.body);
        let mut starts: Vec<(Kind, &BodyPrint, Isometry3<f64>)> = Vec::new();
        starts.push((Kind::Right, own, self.chance.near(truth)));
        for mirror in (0..).map_while(|facet| own.mirrored(facet, truth)) {
            if self.chance.share() < MIRRORS {
                starts.push((Kind::Mirrored, own, self.chance.near(&mirror)));
            }
        }
        for _ in 0..TURNS {
            let turned = Isometry3::from_parts(truth.translation, self.chance.attitude());
            starts.push((Kind::Turned, own, turned));
            starts.extend(others().map(|(_, print)| (Kind::Other, print, turned)));
        }
        starts.extend(others().map(|(_, print)| (Kind::Other, print, *truth)));
        let view = still.view_of(truth);
        let picture =
            Picture::still(view.image(), view.view, &self.light, still.pixels_per_radian());
        let options = AlignOptions::default();
        for (kind, print, start) in starts {
            let Ok(found) = align(print, &picture, &start, &options) else { continue };
            let mirror = found.evidence.most_informative_facet.and_then(|facet| {
                let mirror = print.mirrored(facet, &found.camera_from_markers)?;
                align(print, &picture, &mirror, &options).ok()
            });
            let rival = mirror.filter(|mirror| {
                let (mirror, found) = (&mirror.camera_from_markers, &found.camera_from_markers);
                mirror.rotation.angle_to(&found.rotation) > SAME_RAD
            });
            let coasted = self.chance.coasted(truth);
            let truth = (kind != Kind::Other).then_some(*truth);
            let (origin, blur_px) = (still.origin, shown.blur_px);
            self.tally.add(Hypothesis {
                kind,
                origin,
                stop,
                truth,
                blur_px,
                start,
                found,
                rival,
                coasted,
            });
        }
    }

    fn judge_place(&mut self, still: &Still, stop: f64) {
        let range_m = RANGES_M.start + self.chance.share() * (RANGES_M.end - RANGES_M.start);
        let position: Vector3<f64> = self.chance.direction() * range_m;
        let is_near_a_body = |shown: &Shown| {
            shown.camera_from_markers.translation.vector.angle(&position) < APART_RAD
        };
        if still.bodies.iter().any(is_near_a_body) {
            return;
        }
        let start = Isometry3::from_parts(Translation3::from(position), self.chance.attitude());
        let view = still.view_of(&start);
        let picture =
            Picture::still(view.image(), view.view, &self.light, still.pixels_per_radian());
        for print in still.prints.iter() {
            if let Ok(found) = align(print, &picture, &start, &AlignOptions::default()) {
                self.tally.add(Hypothesis {
                    kind: Kind::Absent,
                    origin: still.origin,
                    stop,
                    truth: None,
                    blur_px: 0.0,
                    start,
                    found,
                    rival: None,
                    coasted: self.chance.coasted(&start),
                });
            }
        }
    }
}
