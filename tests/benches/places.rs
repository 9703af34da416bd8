//! Places: measures the search in all attitudes, for bodies with a rough place and at places
//! without a body.
//!
//! Prints how many bodies it finds in simulated pictures with any exposure and in recorded ones,
//! beside alignment from the right pose. It also prints how often the best pose at a place without
//! a body has log odds above x. `make results PARTS=places` keeps the tables.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[allow(dead_code, reason = "the bench of decisions uses more of it")]
#[path = "decisions/chance.rs"]
mod chance;
#[path = "shared/frames.rs"]
mod frames;
#[allow(dead_code, reason = "the bench of decisions uses more of it")]
#[path = "decisions/pictures.rs"]
mod pictures;

use std::rc::Rc;
use std::time::{Duration, Instant};

use chance::Chance;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::pose::is_false;
use flockeye_imaging::align::{
    AlignOptions, Alignment, BodyPrint, Picture, Place, Templates, align, starts_at,
};
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_imaging::proposals::{Detail, MarkerSizes, Proposer};
use flockeye_imaging::sphere::SphereImage;
use nalgebra::{Isometry3, Unit, Vector3};
use pictures::{Cutting, Still};

/// Exposures of simulated pictures, stops from the right one.
const STOPS: [f64; 4] = [-4.0, -2.0, 0.0, 3.0];
/// Least distance of the bodies, metres.
const NEAREST_M: f64 = 1.2;
/// Ends of the ranges that are counted, metres.
const RANGES_M: [f64; 3] = [2.2, 3.0, 4.0];
/// Errors of a rough place: its shift in radii of the body, and the relative error of its range.
const OFF_RADII: f64 = 0.7;
const OFF_RANGE: f64 = 0.2;
/// The body of all pictures: side of its markers and its radius, metres.
const SIDE_M: f64 = 0.05;
const RADIUS_M: f64 = 0.0817;
/// Places without a body that are searched in each picture.
const PLACES: usize = 4;
/// Least angle between a body and a place without a body, radians.
const APART_RAD: f64 = 0.35;

fn main() {
    // `cargo test` runs each benchmark once, without this argument.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    let mut bench = Bench::new();
    pictures::simulated(|still| {
        for stops in STOPS {
            bench.judge(&still.exposed(stops), &format!("simulated, {stops:+} stops"));
        }
        bench.judge_places(still);
    });
    pictures::recorded(|still| {
        bench.judge(still, still.origin);
        bench.judge_places(still);
    });
    bench.print();
}

/// The results for a body.
struct Sought {
    origin: String,
    range_m: f64,
    /// Whether it was found from its rough place.
    is_found: bool,
    /// Whether alignment finds it from the right pose.
    is_told: bool,
    /// Whether a wrong pose was accepted.
    is_wrong: bool,
}

struct Bench {
    light: LinearLight,
    chance: Chance,
    proposer: Proposer,
    /// Templates of the pictures' bodies, which are kept while their prints stay the same.
    templates: Option<(Rc<Vec<BodyPrint>>, Vec<Templates>)>,
    sought: Vec<Sought>,
    /// Log odds of the best precise pose at each place without a body.
    of_nobody: Vec<f64>,
    search: Duration,
    searches: u32,
}

impl Bench {
    fn new() -> Self {
        Self {
            light: LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap(),
            chance: Chance::new(5),
            proposer: Proposer::default(),
            templates: None,
            sought: Vec::new(),
            of_nobody: Vec::new(),
            search: Duration::ZERO,
            searches: 0,
        }
    }

    fn judge(&mut self, still: &Still, origin: &str) {
        let prints = &still.prints;
        if self.templates.as_ref().is_none_or(|(of, _)| !Rc::ptr_eq(of, prints)) {
            self.templates = Some((prints.clone(), prints.iter().map(Templates::new).collect()));
        }
        for shown in &still.bodies {
            let truth = &shown.camera_from_markers;
            let (direction, range_m) = Unit::new_and_get(truth.translation.vector);
            if range_m < NEAREST_M {
                continue;
            }
            let off = self.chance.direction() * (OFF_RADII * RADIUS_M / range_m);
            let across = off - direction.into_inner() * off.dot(&direction);
            let place = Place {
                direction_in_camera: (direction.into_inner() + across).normalize(),
                range_m: range_m * (1.0 + OFF_RANGE * (2.0 * self.chance.share() - 1.0)),
            };
            let found = self.best_at(still, shown.body, &place);
            let near = self.chance.near(truth);
            let view = view_of(still, &place);
            let picture =
                Picture::still(view.image(), view.view, &self.light, still.pixels_per_radian());
            let options = AlignOptions::default();
            let told = align(&still.prints[shown.body], &picture, &near, &options).ok();
            let accepted = |found: &&Alignment| found.is_accepted() && found.is_precise;
            let is_right = |found: &Alignment| !is_false(&found.camera_from_markers, truth);
            let found = found.as_ref().filter(accepted);
            self.sought.push(Sought {
                origin: origin.to_owned(),
                range_m,
                is_found: found.is_some_and(is_right),
                is_told: told.as_ref().filter(accepted).is_some_and(is_right),
                is_wrong: found.is_some_and(|found| !is_right(found)),
            });
        }
    }

    /// Searches places that look like a body but show none.
    fn judge_places(&mut self, still: &Still) {
        let image =
            SphereImage::new(&still.luma, 3840, Camera::equirectangular(3840, 1920)).unwrap();
        let sizes = MarkerSizes {
            least_rad: 0.65 * 11.0 / still.pixels_per_radian(),
            most_rad: SIDE_M / 0.4,
            radius_in_sides: RADIUS_M / SIDE_M,
        };
        let proposals = self.proposer.propose(&image, &sizes, Detail::Thorough, PLACES);
        for proposal in proposals {
            let direction = proposal.direction_in_camera.into_inner();
            let place =
                Place { direction_in_camera: direction, range_m: SIDE_M / proposal.side_rad };
            let apart_rad = |pose: &Isometry3<f64>| pose.translation.vector.angle(&direction);
            let mut bodies = still.bodies.iter().map(|shown| &shown.camera_from_markers);
            if bodies.all(|pose| apart_rad(pose) > APART_RAD) {
                let best = self.best_at(still, 0, &place);
                self.of_nobody.push(best.map_or(f64::NEG_INFINITY, |best| best.evidence.log_odds));
            }
        }
    }

    /// The likeliest precise pose that the search of a place leads to.
    fn best_at(&mut self, still: &Still, body: usize, place: &Place) -> Option<Alignment> {
        let view = view_of(still, place);
        let picture =
            Picture::still(view.image(), view.view, &self.light, still.pixels_per_radian());
        let options = AlignOptions::default();
        let (print, (_, templates)) = (&still.prints[body], self.templates.as_ref().unwrap());
        let begun = Instant::now();
        let starts = starts_at(print, &templates[body], &picture, place, &options);
        self.search += begun.elapsed();
        self.searches += 1;
        let options = AlignOptions { coarse_first: true, ..options };
        let found = starts.iter().filter_map(|start| align(print, &picture, start, &options).ok());
        found
            .filter(|found| found.is_precise)
            .max_by(|a, b| a.evidence.log_odds.total_cmp(&b.evidence.log_odds))
    }

    fn print(&self) {
        println!(
            "bodies                   range    sought   found  found from the right pose  wrong"
        );
        let mut origins: Vec<&str> = Vec::new();
        for sought in &self.sought {
            if !origins.contains(&sought.origin.as_str()) {
                origins.push(&sought.origin);
            }
        }
        for origin in origins {
            let mut near_m = NEAREST_M;
            for far_m in RANGES_M {
                let is_in = |sought: &&Sought| {
                    sought.origin == origin && (near_m..far_m).contains(&sought.range_m)
                };
                let count = |counts: &dyn Fn(&Sought) -> bool| {
                    self.sought.iter().filter(is_in).filter(|sought| counts(sought)).count()
                };
                if count(&|_| true) > 0 {
                    println!(
                        "{origin:<20} {near_m:>4} to {far_m} m {:>6} {:>7} {:>26} {:>6}",
                        count(&|_| true),
                        count(&|sought| sought.is_found),
                        count(&|sought| sought.is_told),
                        count(&|sought| sought.is_wrong),
                    );
                }
                near_m = far_m;
            }
        }
        println!("\nlog odds above   of {} places without a body", self.of_nobody.len());
        for least in 0..=7 {
            let above = self.of_nobody.iter().filter(|odds| **odds > f64::from(least)).count();
            println!("{least:>14} {above:>8}");
        }
        let each_ms = 1e3 * self.search.as_secs_f64() / f64::from(self.searches);
        println!(
            "\na search takes {each_ms:.0} ms of one processor, before its starts are aligned"
        );
    }
}

/// A view around a place.
fn view_of(still: &Still, place: &Place) -> Cutting {
    let middle: Vector3<f64> = place.direction_in_camera * (0.75 * place.range_m);
    still.view_of(&Isometry3::translation(middle.x, middle.y, middle.z))
}
