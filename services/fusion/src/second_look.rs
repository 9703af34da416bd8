//! Second looks: what takes several times as long as the first, on a thread of its own.
//!
//! A neighbour that is not where its track has it may be found from rougher starts, or by searching
//! round its prediction; one that nobody knows yet, by trying whatever its markers may mean. On two busy
//! processors starts were seen to take 20 to 70 ms and the search 60 to 150, in which nobody else's pose
//! should wait. One is under way at a time; who asks meanwhile is refused: a newer frame will ask again.
//! Only of one that nobody knows no newer frame need show anything for a while: its look may wait behind a
//! tracked one's.

use std::collections::BTreeSet;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::CornerRay;
use flockeye_geometry::view::View;
use flockeye_imaging::align::Picture;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use flockeye_runtime::background;
use nalgebra::Isometry3;

use crate::alignment::{Aligner, Pace, Start};
use crate::gallery::FrameOrder;
use crate::sighting::{Look, Sighting, distinct_markers, is_where_seen};

/// Of which frame a look is, and of which neighbour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Subject {
    /// The frame.
    pub order: FrameOrder,
    /// When it was exposed, seconds.
    pub at_s: f64,
    /// The neighbour's number.
    pub target: usize,
}

/// What a second look said.
#[derive(Debug)]
pub struct Answer {
    /// Of what.
    pub subject: Subject,
    /// What it found, if anything.
    pub sighting: Option<Sighting>,
    /// Whether it was found without believing a track, and so may begin one.
    pub stands_alone: bool,
    /// The distance that the view's rays are right for, metres.
    pub rays_m: f64,
}

/// The thread for second looks has panicked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the thread that looks again for neighbours has ended; its panic was said before")]
pub struct ThreadEnded;

/// The thread.
#[derive(Debug)]
pub struct SecondLooks {
    jobs: Sender<Job>,
    answers: Receiver<Answer>,
    under_way: Option<UnderWay>,
    /// What will be looked at next.
    waiting: Option<Job>,
    /// Who had the last look...
    last: Option<usize>,
    /// ...and who was refused one since.
    refused: BTreeSet<usize>,
}

#[derive(Debug)]
struct UnderWay {
    subject: Subject,
    /// Whether nobody knew the neighbour.
    is_newcomer: bool,
    /// Whether the neighbour was measured in that frame meanwhile.
    is_moot: bool,
}

impl SecondLooks {
    /// Starts the thread. It ends when this is dropped, after what it is at.
    ///
    /// # Errors
    /// The system starts no thread.
    pub fn start(aligner: Arc<Aligner>) -> io::Result<Self> {
        let (jobs, asked) = channel::<Job>();
        let (tell, answers) = channel();
        background::spawn("second-look", move || {
            for job in asked {
                if tell.send(job.answer(&aligner)).is_err() {
                    return;
                }
            }
        })?;
        let (last, refused) = (None, BTreeSet::new());
        Ok(Self { jobs, answers, under_way: None, waiting: None, last, refused })
    }

    /// Looks again, and says so; not while another look is under way, but for a neighbour that has no
    /// track, which may wait behind one that has; and not for who had the last one before those were
    /// asked who were refused meanwhile.
    pub fn ask(&mut self, subject: Subject, look: &Look<'_>) -> bool {
        let target = subject.target;
        if let Some(under_way) = &self.under_way {
            if under_way.subject.target != target {
                let may_wait = look.predicted.is_none() && !under_way.is_newcomer;
                if may_wait && self.waiting.is_none() {
                    self.waiting = Job::new(subject, look);
                    return self.waiting.is_some();
                }
                self.refused.insert(target);
            }
            return false;
        }
        let had_last = self.last.take() == Some(target);
        let is_first = self.refused.is_empty() || self.refused.contains(&target);
        if had_last && !is_first {
            self.refused.clear();
            return false;
        }
        Job::new(subject, look).is_some_and(|job| self.begin(job))
    }

    fn begin(&mut self, job: Job) -> bool {
        let (subject, is_newcomer) = (job.subject, job.is_newcomer);
        // Where the thread has ended, that is said when its answer is asked for.
        let is_begun = self.jobs.send(job).is_ok();
        if is_begun {
            self.refused.remove(&subject.target);
            self.last = Some(subject.target);
            self.under_way = Some(UnderWay { subject, is_newcomer, is_moot: false });
        }
        is_begun
    }

    /// The neighbour was measured in that frame: a second look at it has nothing to add, nor has one that
    /// waits because nobody knew the neighbour.
    pub fn settle(&mut self, order: FrameOrder, target: usize) {
        self.waiting.take_if(|job| job.subject.target == target);
        if let Some(under_way) = &mut self.under_way
            && (under_way.subject.order, under_way.subject.target) == (order, target)
        {
            under_way.is_moot = true;
        }
    }

    /// The frame of which a look is under way that may still say something.
    pub fn awaited(&self) -> Option<FrameOrder> {
        let under_way = self.under_way.as_ref().filter(|under_way| !under_way.is_moot)?;
        Some(under_way.subject.order)
    }

    /// What the look that was under way said, if it is over and not moot.
    ///
    /// # Errors
    /// [`ThreadEnded`].
    pub fn take(&mut self) -> Result<Option<Answer>, ThreadEnded> {
        let answer = match self.answers.try_recv() {
            Ok(answer) => answer,
            Err(TryRecvError::Empty) => return Ok(None),
            Err(TryRecvError::Disconnected) => return Err(ThreadEnded),
        };
        let is_moot = self.under_way.take().is_none_or(|under_way| under_way.is_moot);
        if let Some(next) = self.waiting.take() {
            self.begin(next);
        }
        Ok((!is_moot).then_some(answer))
    }
}

/// What a look needs, copied: its view goes back to the pool meanwhile.
#[derive(Debug)]
struct Job {
    subject: Subject,
    /// Whether it has no track.
    is_newcomer: bool,
    body: Body,
    rays: Vec<CornerRay>,
    starts: Vec<Start>,
    /// Where its track, if it is believed, has it.
    believed: Option<Isometry3<f64>>,
    /// Round where it is searched for if no start leads to it.
    search_round: Option<Isometry3<f64>>,
    pixels: Vec<u8>,
    size: (usize, usize),
    view: View,
    light: LinearLight,
    pixels_per_radian: f64,
    rays_m: f64,
}

impl Job {
    /// `None` where there is nothing to look at.
    fn new(subject: Subject, look: &Look<'_>) -> Option<Self> {
        let best = look.best_view?;
        let image = best.picture.image;
        let mut pixels = Vec::with_capacity(image.width() * image.height());
        (0..image.height()).for_each(|y| pixels.extend_from_slice(image.row(y)));
        Some(Self {
            subject,
            is_newcomer: look.predicted.is_none(),
            body: look.body.clone(),
            rays: look.rays.clone(),
            starts: look.second_starts(),
            believed: look.prior.as_ref().map(|prior| prior.camera_from_markers),
            search_round: look.predicted.filter(|_| look.may_search),
            pixels,
            size: (image.width(), image.height()),
            view: best.picture.view,
            light: best.picture.light.clone(),
            pixels_per_radian: best.picture.pixels_per_radian,
            rays_m: best.rays_m,
        })
    }

    fn answer(&self, aligner: &Aligner) -> Answer {
        let (sighting, stands_alone) = self.sighting(aligner).unzip();
        Answer {
            subject: self.subject,
            sighting,
            stands_alone: stands_alone.unwrap_or_default(),
            rays_m: self.rays_m,
        }
    }

    /// The neighbour, if it is there, and whether it was found without believing a track.
    fn sighting(&self, aligner: &Aligner) -> Option<(Sighting, bool)> {
        let (width, height) = self.size;
        let picture = Picture {
            image: LumaImage::new(&self.pixels, width, height, width).ok()?,
            view: self.view,
            light: &self.light,
            pixels_per_radian: self.pixels_per_radian,
        };
        let (target, starts) = (self.subject.target, &self.starts);
        let is_marked = |pose: &Isometry3<f64>| is_where_seen(&self.body, &self.rays, pose);
        let found = match &self.believed {
            Some(predicted) => {
                aligner.follow(target, &picture, starts, predicted, Pace::Live, is_marked)
            }
            None => aligner.discover(target, &picture, starts, Pace::Live, is_marked),
        };
        let stands_alone = self.believed.is_none() && found.is_some();
        let found =
            found.or_else(|| aligner.reacquire(target, &picture, self.search_round.as_ref()?))?;
        Some((Sighting::aligned(&found, distinct_markers(&self.rays)), stands_alone))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::alignment::BestView;
    use flockeye_geometry::body::{Bodies, squares};
    use flockeye_geometry::pose::PosePrior;
    use flockeye_imaging::edges::MarkerPrint;
    use flockeye_imaging::light::{CodeRange, TransferCurve};
    use nalgebra::{Matrix6, Vector3};
    use std::time::{Duration, Instant};

    fn wait(looks: &mut SecondLooks) {
        wait_while(looks, |looks| looks.under_way.is_some());
    }

    fn wait_while(looks: &mut SecondLooks, waits: impl Fn(&SecondLooks) -> bool) {
        let until = Instant::now() + Duration::from_secs(60);
        while waits(looks) {
            looks.take().expect("the thread lives");
            assert!(Instant::now() < until, "it is never over");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Asks for looks at an empty picture, at a neighbour that is tracked or at one that nobody knows.
    fn with_looks(
        by: impl FnOnce(&mut SecondLooks, &dyn Fn(&mut SecondLooks, usize, bool) -> bool),
    ) {
        let body = squares("alpha", 0.0625, 0.05, 0);
        let bodies = Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).unwrap();
        let print = MarkerPrint::of_bits(&[true; 25]).unwrap();
        let aligner = Aligner::new(&bodies, |_| Some(&print), 611.0).unwrap();
        let mut looks = SecondLooks::start(Arc::new(aligner)).unwrap();
        let (pixels, light) =
            ([128; 64 * 64], LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap());
        let picture = Picture {
            image: LumaImage::new(&pixels, 64, 64, 64).unwrap(),
            view: View::looking_at(&Vector3::x_axis(), 0.5, 64),
            light: &light,
            pixels_per_radian: 611.0,
        };
        let camera_from_markers = Isometry3::translation(1.0, 0.0, 0.0);
        let covariance = Matrix6::identity();
        let ask = |looks: &mut SecondLooks, target: usize, is_known: bool| {
            let look = Look {
                target,
                body: &body,
                rays: Vec::new(),
                doubtful: Vec::new(),
                rays_m: f64::INFINITY,
                prior: is_known.then_some(PosePrior { camera_from_markers, covariance }),
                predicted: is_known.then_some(camera_from_markers),
                best_view: Some(BestView { picture, view_index: 0, rays_m: f64::INFINITY }),
                may_search: false,
                pace: Pace::Live,
                needed: 1,
                tried: None,
                peek: None,
                has_second: true,
                second: None,
            };
            looks.ask(subject(target), &look)
        };
        by(&mut looks, &ask);
    }

    fn subject(target: usize) -> Subject {
        Subject { order: (0, 0, 0), at_s: 0.0, target }
    }

    #[test]
    fn one_look_at_a_time_and_who_was_refused_goes_first() {
        with_looks(|looks, ask| {
            let ask = |looks: &mut SecondLooks, target| ask(looks, target, true);
            assert!(ask(looks, 0));
            assert!(!ask(looks, 1) && !ask(looks, 0), "one is under way");
            wait(looks);
            assert!(!ask(looks, 0), "1 goes first");
            assert!(ask(looks, 1));
            wait(looks);
            assert!(ask(looks, 1), "nobody else asked");
            assert!(!ask(looks, 0));
            wait(looks);
            assert!(!ask(looks, 1));
            assert!(ask(looks, 1), "0 was left the place once and did not take it");
        });
    }

    #[test]
    fn who_is_not_known_waits_until_a_look_is_over() {
        with_looks(|looks, ask| {
            let under_way = |looks: &SecondLooks| looks.under_way.as_ref().map(|look| look.subject);
            assert!(ask(looks, 0, true));
            assert!(ask(looks, 1, false), "there is a place for one");
            assert!(!ask(looks, 2, false) && !ask(looks, 3, true));
            wait_while(looks, |looks| under_way(looks) == Some(subject(0)));
            assert_eq!(under_way(looks), Some(subject(1)));
            wait(looks);
            // Newcomers do not wait behind each other: who is tracked would never get a turn.
            assert!(ask(looks, 2, false));
            assert!(!ask(looks, 1, false) && !ask(looks, 3, true));
            wait(looks);
            // Another frame told of it before its turn came.
            assert!(ask(looks, 3, true));
            assert!(ask(looks, 1, false));
            looks.settle((0, 0, 1), 1);
            wait_while(looks, |looks| under_way(looks) == Some(subject(3)));
            assert_eq!(under_way(looks), None);
        });
    }

    #[test]
    fn a_thread_that_has_ended_is_told() {
        let ((jobs, _), (_, answers)) = (channel(), channel());
        let (last, refused) = (None, BTreeSet::new());
        let mut looks =
            SecondLooks { jobs, answers, under_way: None, waiting: None, last, refused };
        assert_eq!(looks.take().unwrap_err(), ThreadEnded);
    }
}
