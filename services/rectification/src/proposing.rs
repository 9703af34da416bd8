//! Which places of a frame that look like a body are looked at.

use flockeye_config::Resolved;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::search::PROPOSAL_FIELD_RADII;
use flockeye_geometry::view::View;
use flockeye_imaging::proposals::{Detail, MarkerSizes, Proposal, Proposer};
use flockeye_imaging::sphere::SphereImage;

/// Places of a frame that are kept. Of the 28 bodies within 2.2 m and blurred by less than 4 px in the
/// simulated frames that the weights were chosen on, 27 are among these (docs/FUSION.md).
const MOST: usize = 24;

/// From one frame to the next a place moves by less than this, radians: 170 degrees/s at 30 frames/s.
const MAX_MOVE_RAD: f64 = 0.1;

/// The same place's side changes by less than this ratio.
const MAX_SIDE_RATIO: f64 = 1.5;

/// Pixels that a marker's side gets in a view, at most [`MAX_MAGNIFICATION`] times the sphere's.
const MARKER_PX: f64 = 32.0;
const MAX_MAGNIFICATION: f64 = 3.0;

/// A place is looked at again after so many frames: what is as it was reads no better.
const AGAIN_AFTER: u64 = 3;

/// In single images, smallest markers in sizes of the smallest that reads: bodies are found there whose markers do not.
const LEAST_UNREAD_SIDES: f64 = 0.65;

/// Markers of a place are taken for at least this size, in sizes of the smallest that reads: a smaller one
/// is seen at an angle, and others beside it are not.
const LEAST_SIDES: f64 = 1.2;

/// Half the field of a view is no larger, radians (40 degrees): near bodies are found by the tiles too.
const MAX_HALF_FIELD_RAD: f64 = 0.7;

/// A place that looks like a body.
#[derive(Debug, Clone, Copy)]
struct Place {
    proposal: Proposal,
    /// The frame in which it was looked at last; 0: never.
    looked: u64,
}

/// Chooses the places: least recently looked at first, those that look most like a body first among them.
#[derive(Debug)]
pub struct Proposing {
    proposer: Proposer,
    /// `None` without bodies.
    sizes: Option<MarkerSizes>,
    /// Whether each frame is an image for itself: no place was looked at before, and there is time for a thorough look.
    is_single: bool,
    mask: Mask,
    pixels_per_radian: f64,
    /// Longest side of a view, pixels.
    size_max_px: u32,
    /// The places of the last frame.
    known: Vec<Place>,
    /// The places in `known` that views were planned of, in their order.
    planned: Vec<usize>,
    /// Frames with proposals.
    frames: u64,
}

impl Proposing {
    /// For the bodies and the camera of a configuration.
    ///
    /// # Errors
    /// A mask that cannot be read.
    pub fn of(resolved: &Resolved) -> anyhow::Result<Self> {
        let pixels_per_radian = resolved.camera.pixels_per_radian();
        let radius_in_sides = resolved.bodies.radius_in_sides();
        let is_single = resolved.pipeline.has_single_images();
        let least_sides = if is_single { LEAST_UNREAD_SIDES } else { 1.0 };
        let least_px = least_sides * resolved.pipeline.detection.min_side_px;
        let sizes = MarkerSizes {
            least_rad: least_px / pixels_per_radian,
            most_rad: resolved.bodies.largest_side() / resolved.pipeline.partition.nearest_m,
            radius_in_sides,
        };
        Ok(Self {
            proposer: Proposer::default(),
            sizes: (radius_in_sides > 0.0).then_some(sizes),
            is_single,
            mask: resolved.mask()?.clone(),
            pixels_per_radian,
            size_max_px: resolved.gaze_options.size_max_px,
            known: Vec::new(),
            planned: Vec::new(),
            frames: 0,
        })
    }

    /// At most `views` views of places in `image`.
    pub fn views(&mut self, image: &SphereImage<'_>, views: usize) -> Vec<View> {
        let Some(sizes) = self.sizes else { return Vec::new() };
        let detail = if self.is_single { Detail::Thorough } else { Detail::Quick };
        if self.is_single {
            self.known.clear();
        }
        // Some of them may be behind the mask.
        let most = MOST.max(views);
        let mut found = self.proposer.propose(image, &sizes, detail, 2 * most);
        found.retain(|proposal| !self.mask.hides(&proposal.direction_in_camera));
        found.truncate(most);
        let looked = |proposal: &Proposal| {
            let apart = |place: &&Place| {
                place.proposal.direction_in_camera.angle(&proposal.direction_in_camera)
            };
            let ratio = |place: &Place| place.proposal.side_rad / proposal.side_rad;
            let alike = self.known.iter().filter(|place| {
                (1.0 / MAX_SIDE_RATIO..=MAX_SIDE_RATIO).contains(&ratio(place))
                    && apart(place) < MAX_MOVE_RAD
            });
            let nearest = alike.min_by(|a, b| apart(a).total_cmp(&apart(b)));
            nearest.map_or(0, |place| place.looked)
        };
        let place = |proposal| Place { proposal, looked: looked(&proposal) };
        let known: Vec<Place> = found.into_iter().map(place).collect();
        self.known = known;
        self.frames += 1;
        let is_due = |&place: &usize| {
            let looked = self.known[place].looked;
            looked == 0 || self.frames >= looked + AGAIN_AFTER
        };
        self.planned = (0..self.known.len()).filter(is_due).collect();
        // The sort is stable: the best come first among those looked at in the same frame.
        self.planned.sort_by_key(|&place| self.known[place].looked);
        self.planned.truncate(views);
        self.planned.iter().map(|&place| self.view(&self.known[place].proposal, &sizes)).collect()
    }

    /// The view in this place of those of the last frame was cut.
    pub fn note_cut(&mut self, place: usize) {
        if let Some(&place) = self.planned.get(place) {
            self.known[place].looked = self.frames;
        }
    }

    fn view(&self, place: &Proposal, sizes: &MarkerSizes) -> View {
        let side_rad = place.side_rad.max(LEAST_SIDES * sizes.least_rad);
        let half_rad =
            (PROPOSAL_FIELD_RADII * sizes.radius_in_sides * side_rad).min(MAX_HALF_FIELD_RAD);
        let field_rad = 2.0 * half_rad;
        // No larger than a region of interest: shared memory has room for that.
        let most_px = f64::from(self.size_max_px) / (2.0 * half_rad.tan());
        let most = (MAX_MAGNIFICATION * self.pixels_per_radian).min(most_px);
        let focal_px = (MARKER_PX / side_rad).min(most);
        let size_px = (2.0 * focal_px * half_rad.tan()).ceil() as u32;
        let size_px = size_px.clamp(1, self.size_max_px);
        View { focal_px, ..View::looking_at(&place.direction_in_camera, field_rad, size_px) }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_config::Pipeline;

    const WIDTH: usize = 3840;

    fn proposing() -> Proposing {
        proposing_with(&[])
    }

    fn proposing_with(overrides: &[&str]) -> Proposing {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        let pipeline = Pipeline::parse("", &overrides, "a test").unwrap();
        Proposing::of(&Resolved::of(pipeline).unwrap()).unwrap()
    }

    /// A white picture with `count` dark squares along the equator, each with a bright cell.
    fn squares(count: usize) -> Vec<u8> {
        let mut pixels = vec![220; WIDTH * WIDTH / 2];
        for k in 0..count {
            let left = 200 + k * 400;
            for y in 950..974 {
                pixels[y * WIDTH + left..y * WIDTH + left + 24].fill(30);
            }
            for y in 958..964 {
                pixels[y * WIDTH + left + 8..y * WIDTH + left + 14].fill(200);
            }
        }
        pixels
    }

    /// Azimuths of the views of a picture, degrees; the first `cut` of them are cut.
    fn look(proposing: &mut Proposing, pixels: &[u8], views: usize, cut: usize) -> Vec<i64> {
        let camera = flockeye_geometry::camera::Camera::equirectangular(3840, 1920);
        let image = SphereImage::new(pixels, WIDTH, camera).unwrap();
        let found = proposing.views(&image, views);
        (0..cut).for_each(|place| proposing.note_cut(place));
        let azimuth = |view: &View| {
            let direction = view.direction_in_camera();
            direction.y.atan2(direction.x).to_degrees().round() as i64
        };
        found.iter().map(azimuth).collect()
    }

    #[test]
    fn places_take_turns() {
        let (mut proposing, pixels) = (proposing(), squares(8));
        let mut seen = Vec::new();
        for _ in 0..4 {
            seen.extend(look(&mut proposing, &pixels, 2, 2));
        }
        let distinct: std::collections::BTreeSet<i64> = seen.iter().copied().collect();
        assert_eq!((seen.len(), distinct.len()), (8, 8), "{seen:?}");
    }

    #[test]
    fn a_place_that_was_not_cut_is_next() {
        let (mut proposing, pixels) = (proposing(), squares(8));
        let first = look(&mut proposing, &pixels, 3, 1);
        let second = look(&mut proposing, &pixels, 3, 3);
        assert_eq!(first[1..], second[..2]);
    }

    #[test]
    fn what_was_looked_at_rests_for_two_frames_and_what_is_new_does_not() {
        let mut proposing = proposing();
        let count = |proposing: &mut Proposing, squares_shown| {
            look(proposing, &squares(squares_shown), 12, 12).len()
        };
        assert_eq!(count(&mut proposing, 4), 4);
        assert_eq!(count(&mut proposing, 5), 1);
        assert_eq!(count(&mut proposing, 5), 0);
        assert_eq!(count(&mut proposing, 5), 4);
    }

    #[test]
    fn nothing_of_a_single_image_was_looked_at_before() {
        let mut proposing = proposing_with(&["profile=stills"]);
        let pixels = squares(4);
        let first = look(&mut proposing, &pixels, 12, 12);
        assert_eq!(first.len(), 4);
        assert_eq!(look(&mut proposing, &pixels, 12, 12), first);
    }

    #[test]
    fn a_view_holds_a_body_and_is_small() {
        let mut proposing = proposing();
        let camera = flockeye_geometry::camera::Camera::equirectangular(3840, 1920);
        let pixels = squares(1);
        let image = SphereImage::new(&pixels, WIDTH, camera).unwrap();
        let view = proposing.views(&image, 1)[0];
        assert!((150..250).contains(&view.size_px), "{}", view.size_px);
        let radius_rad = 1.64 * 24.0 / camera.pixels_per_radian();
        assert!(view.field_rad() > 3.0 * radius_rad, "{}", view.field_rad());
    }
}
