//! Choice of the places in a frame that resemble a body (proposals).

use flockeye_config::Resolved;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::search::{PROPOSAL_FIELD_RADII, ROI_SIZE_MAX_PX};
use flockeye_geometry::view::View;
use flockeye_imaging::proposals::{Detail, MarkerSizes, Proposal};

/// Maximum number of places per frame. In simulated gusts, they include 10 of 12 bodies within 2.2
/// m and below 4 px blur (docs/results/experiments.md, quick look).
const MOST: usize = 24;

/// Maximum motion of a place between frames, radians: 170 degrees/s at 30 frames/s.
const MAX_MOVE_RAD: f64 = 0.1;

/// Maximum ratio between the marker sides of a place in two frames.
const MAX_SIDE_RATIO: f64 = 1.5;

/// Side of a marker in a view, pixels; the magnification is at most [`MAX_MAGNIFICATION`].
const MARKER_PX: f64 = 32.0;
const MAX_MAGNIFICATION: f64 = 3.0;

/// Frames after which a place becomes a view again: an unchanged picture gives the same result.
const AGAIN_AFTER: u64 = 3;

/// Minimum marker size in single images, relative to the smallest readable one: bodies can be found
/// there without readable markers.
const LEAST_UNREAD_SIDES: f64 = 0.65;

/// Minimum marker size assumed for a place, relative to the smallest readable one. A smaller marker
/// is seen obliquely, and its neighbours are larger.
const LEAST_SIDES: f64 = 1.2;

/// Maximum half field of a view, radians (40 degrees): tiles find near bodies too.
const MAX_HALF_FIELD_RAD: f64 = 0.7;

/// Parameters of a proposal search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProposalSearch {
    /// Sizes of the markers.
    pub sizes: MarkerSizes,
    /// Detail of the search.
    pub detail: Detail,
    /// Maximum number of places, the best first.
    pub most: usize,
}

/// A place that resembles a body.
#[derive(Debug, Clone, Copy)]
struct BodyPlace {
    proposal: Proposal,
    /// Number of the frame in which it was last a view; 0: never.
    looked: u64,
}

/// Chooses the places: least recently cut first, then by score.
#[derive(Debug)]
pub(crate) struct ProposalChooser {
    /// `None` without bodies.
    sizes: Option<MarkerSizes>,
    /// Whether frames are independent images: no place was cut before, and a thorough search is
    /// possible.
    is_single: bool,
    mask: Mask,
    pixels_per_radian: f64,
    places: Vec<BodyPlace>,
    /// Indices into `places` of the chosen places, in the order of the views.
    planned: Vec<usize>,
    /// Number of frames with proposals.
    frames: u64,
}

impl ProposalChooser {
    /// The chooser for the bodies and the camera of a configuration.
    pub(crate) fn of(resolved: &Resolved) -> anyhow::Result<Self> {
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
            sizes: (radius_in_sides > 0.0).then_some(sizes),
            is_single,
            mask: resolved.mask()?.clone(),
            pixels_per_radian,
            places: Vec::new(),
            planned: Vec::new(),
            frames: 0,
        })
    }

    /// The search for at most `views` views. `None` without bodies.
    pub(crate) fn search(&self, views: usize) -> Option<ProposalSearch> {
        let detail = if self.is_single { Detail::Thorough } else { Detail::Quick };
        // Factor 2: the mask may hide some places.
        let most = 2 * MOST.max(views);
        self.sizes.map(|sizes| ProposalSearch { sizes, detail, most })
    }

    /// At most `views` views of the places `found` by [`ProposalChooser::search`].
    pub(crate) fn choose(&mut self, mut found: Vec<Proposal>, views: usize) -> Vec<View> {
        let Some(sizes) = self.sizes else { return Vec::new() };
        if self.is_single {
            self.places.clear();
        }
        found.retain(|proposal| !self.mask.hides(&proposal.direction_in_camera));
        found.truncate(MOST.max(views));
        let place = |proposal| BodyPlace { proposal, looked: self.last_looked(&proposal) };
        self.places = found.into_iter().map(place).collect();
        self.frames += 1;
        let is_due = |&place: &usize| {
            let looked = self.places[place].looked;
            looked == 0 || self.frames >= looked + AGAIN_AFTER
        };
        self.planned = (0..self.places.len()).filter(is_due).collect();
        // The sort is stable: places of one frame keep their order by score.
        self.planned.sort_by_key(|&place| self.places[place].looked);
        self.planned.truncate(views);
        self.planned.iter().map(|&place| self.view(&self.places[place].proposal, &sizes)).collect()
    }

    /// Number of the frame in which the place of a proposal was last a view; 0: never.
    fn last_looked(&self, proposal: &Proposal) -> u64 {
        let apart = |place: &&BodyPlace| {
            place.proposal.direction_in_camera.angle(&proposal.direction_in_camera)
        };
        let ratio = |place: &BodyPlace| place.proposal.side_rad / proposal.side_rad;
        let alike = self.places.iter().filter(|place| {
            (1.0 / MAX_SIDE_RATIO..=MAX_SIDE_RATIO).contains(&ratio(place))
                && apart(place) < MAX_MOVE_RAD
        });
        let nearest = alike.min_by(|a, b| apart(a).total_cmp(&apart(b)));
        nearest.map_or(0, |place| place.looked)
    }

    /// Notes that view number `view` of the last frame was cut.
    pub(crate) fn note_cut(&mut self, view: usize) {
        if let Some(&place) = self.planned.get(view) {
            self.places[place].looked = self.frames;
        }
    }

    fn view(&self, place: &Proposal, sizes: &MarkerSizes) -> View {
        let side_rad = place.side_rad.max(LEAST_SIDES * sizes.least_rad);
        let half_rad =
            (PROPOSAL_FIELD_RADII * sizes.radius_in_sides * side_rad).min(MAX_HALF_FIELD_RAD);
        let field_rad = 2.0 * half_rad;
        // Limit: the size of a region of interest, for which shared memory has room.
        let most_px = f64::from(ROI_SIZE_MAX_PX) / (2.0 * half_rad.tan());
        let most = (MAX_MAGNIFICATION * self.pixels_per_radian).min(most_px);
        let focal_px = (MARKER_PX / side_rad).min(most);
        let size_px = (2.0 * focal_px * half_rad.tan()).ceil() as u32;
        let size_px = size_px.clamp(1, ROI_SIZE_MAX_PX);
        View { focal_px, ..View::looking_at(&place.direction_in_camera, field_rad, size_px) }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_config::Pipeline;
    use flockeye_imaging::proposals::Proposer;
    use flockeye_imaging::sphere::SphereImage;

    const WIDTH: usize = 3840;

    fn chooser() -> ProposalChooser {
        chooser_with(&[])
    }

    fn chooser_with(overrides: &[&str]) -> ProposalChooser {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        let pipeline = Pipeline::parse("", &overrides, "a test").unwrap();
        ProposalChooser::of(&Resolved::of(pipeline).unwrap()).unwrap()
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

    /// The views of a picture.
    fn views_of(chooser: &mut ProposalChooser, image: &SphereImage<'_>, views: usize) -> Vec<View> {
        let search = chooser.search(views).unwrap();
        let mut proposer = Proposer::default();
        let found = proposer.propose(image, &search.sizes, search.detail, search.most);
        chooser.choose(found, views)
    }

    /// Azimuths of the views of a picture, degrees; the first `cut` of them are cut.
    fn look(chooser: &mut ProposalChooser, pixels: &[u8], views: usize, cut: usize) -> Vec<i64> {
        let camera = flockeye_geometry::camera::Camera::equirectangular(3840, 1920);
        let image = SphereImage::new(pixels, WIDTH, camera).unwrap();
        let found = views_of(chooser, &image, views);
        (0..cut).for_each(|place| chooser.note_cut(place));
        let azimuth = |view: &View| {
            let direction = view.direction_in_camera();
            direction.y.atan2(direction.x).to_degrees().round() as i64
        };
        found.iter().map(azimuth).collect()
    }

    #[test]
    fn places_take_turns() {
        let (mut chooser, pixels) = (chooser(), squares(8));
        let mut seen = Vec::new();
        for _ in 0..4 {
            seen.extend(look(&mut chooser, &pixels, 2, 2));
        }
        let distinct: std::collections::BTreeSet<i64> = seen.iter().copied().collect();
        assert_eq!((seen.len(), distinct.len()), (8, 8), "{seen:?}");
    }

    #[test]
    fn a_place_that_was_not_cut_is_next() {
        let (mut chooser, pixels) = (chooser(), squares(8));
        let first = look(&mut chooser, &pixels, 3, 1);
        let second = look(&mut chooser, &pixels, 3, 3);
        assert_eq!(first[1..], second[..2]);
    }

    #[test]
    fn what_was_looked_at_rests_for_two_frames_and_what_is_new_does_not() {
        let mut chooser = chooser();
        let count = |chooser: &mut ProposalChooser, squares_shown| {
            look(chooser, &squares(squares_shown), 12, 12).len()
        };
        assert_eq!(count(&mut chooser, 4), 4);
        assert_eq!(count(&mut chooser, 5), 1);
        assert_eq!(count(&mut chooser, 5), 0);
        assert_eq!(count(&mut chooser, 5), 4);
    }

    #[test]
    fn nothing_of_a_single_image_was_looked_at_before() {
        let mut chooser = chooser_with(&["profile=stills"]);
        let pixels = squares(4);
        let first = look(&mut chooser, &pixels, 12, 12);
        assert_eq!(first.len(), 4);
        assert_eq!(look(&mut chooser, &pixels, 12, 12), first);
    }

    #[test]
    fn a_view_holds_a_body_and_is_small() {
        let mut chooser = chooser();
        let camera = flockeye_geometry::camera::Camera::equirectangular(3840, 1920);
        let pixels = squares(1);
        let image = SphereImage::new(&pixels, WIDTH, camera).unwrap();
        let view = views_of(&mut chooser, &image, 1)[0];
        assert!((150..250).contains(&view.size_px), "{}", view.size_px);
        let radius_rad = 1.64 * 24.0 / camera.pixels_per_radian();
        assert!(view.field_rad() > 3.0 * radius_rad, "{}", view.field_rad());
    }
}
