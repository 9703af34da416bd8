//! The core of detection: a pure function of a view, without port, clock or thread.

use flockeye_config::Resolved;
use flockeye_contract::{
    DetectedMarker, DetectionHeader, MAX_DETECTED_MARKERS, Search, ViewHeader, ViewKind,
};
use flockeye_convert::{RadianceCache, image_of, view_of};
use flockeye_geometry::body::Bodies;
use flockeye_geometry::pose::LensError;
use flockeye_imaging::edges::CornerFit;

use crate::detector::MarkerInView;
use crate::engine::Engine;
use crate::parameters::DetectorParameters;
use crate::windows::thresholds;

/// Most markers in one record: as many as the topic has room for, and no more than the contract
/// allows.
pub const MAX_MARKERS: usize = 64;
const _: () = assert!(MAX_MARKERS <= MAX_DETECTED_MARKERS);

/// Handles the views of one worker. A result depends on its view alone, never on earlier ones.
pub struct Core {
    engine: Engine,
    bodies: Bodies,
    lights: RadianceCache,
    /// The error of the camera's model, which corners have in addition to their own.
    lens: LensError,
    /// The sphere image's own resolution.
    pixels_per_radian: f64,
    worker: u32,
    generation: u32,
}

impl Core {
    /// Creates the core of `worker`, whose process was replaced `generation` times.
    ///
    /// # Errors
    /// An invalid configuration; files named there that cannot be read.
    pub fn new(resolved: &Resolved, worker: u32, generation: u32) -> anyhow::Result<Self> {
        let (pipeline, bodies) = (&resolved.pipeline, &resolved.bodies);
        let parameters = DetectorParameters {
            min_side_px: pipeline.detection.min_side_px,
            // Where fusion aligns whole bodies, corners are only a start, and time matters more.
            corner_fit: match pipeline.fusion.align {
                true => CornerFit::Edges,
                false => CornerFit::WholePrint,
            },
            ..DetectorParameters::default()
        };
        let engine = Engine::new(pipeline.detection.engine, &bodies.dictionary, parameters)?
            .with_mask(resolved.mask()?.clone());
        engine.dictionary().check(bodies)?;
        Ok(Self {
            engine,
            bodies: bodies.clone(),
            lights: RadianceCache::new(resolved.measured_response)?,
            lens: resolved.lens_error(),
            pixels_per_radian: resolved.camera.pixels_per_radian(),
            worker,
            generation,
        })
    }

    /// The name of the dictionary whose markers are found.
    pub fn dictionary(&self) -> &str {
        &self.bodies.dictionary
    }

    /// The record for a view: its header without the times of the search, and the markers found.
    /// An error in their place has the reason why the view could not be searched; the header
    /// acknowledges the view all the same. `None` if the view is meant for another worker.
    pub fn on_view(
        &mut self,
        header: &ViewHeader,
        pixels: &[u8],
    ) -> Option<(DetectionHeader, anyhow::Result<Vec<DetectedMarker>>)> {
        if header.worker != self.worker {
            return None;
        }
        let mut found = self.find(header, pixels);
        if let Ok(found) = &mut found {
            found.truncate(MAX_MARKERS);
        }
        let is_hit = |found: &&MarkerInView| self.bodies.owner(found.id).is_some();
        let header = DetectionHeader {
            generation: self.generation,
            worker: self.worker,
            hits: found.iter().flatten().filter(is_hit).count() as u32,
            failed: u32::from(found.is_err()),
            ..DetectionHeader::answering(header)
        };
        let lens = self.lens;
        let detected = |found: &MarkerInView| detected(found, lens);
        Some((header, found.map(|found| found.iter().map(detected).collect())))
    }

    fn find(&mut self, header: &ViewHeader, pixels: &[u8]) -> anyhow::Result<Vec<MarkerInView>> {
        let search = Search::try_from(header.search)?;
        if search == Search::Nothing {
            return Ok(Vec::new());
        }
        let (image, view) = (image_of(header, pixels)?, view_of(header));
        let magnification = header.focal_px / self.pixels_per_radian;
        let kind = ViewKind::try_from(header.kind)?;
        let thresholds = thresholds(kind, search, magnification);
        let light = self.lights.of(header)?;
        Ok(self.engine.detect(&image, &view, light, magnification, thresholds)?)
    }
}

fn detected(found: &MarkerInView, lens: LensError) -> DetectedMarker {
    DetectedMarker {
        rays_in_camera: found.rays_in_camera.map(|ray| [ray.x, ray.y, ray.z]),
        deviations: found.deviations_rad.map(|deviation_rad| lens.with(deviation_rad)),
        corners_in_view: found.corners_in_view.map(|corner| [corner.0.x as f32, corner.0.y as f32]),
        id: found.id,
        reserved: 0,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use flockeye_contract::{FrameStamp, Transfer};
    use flockeye_dictionary::Dictionary;

    use super::*;

    const SIZE: u32 = 600;
    /// Focal length of the default camera's sphere: 3840 pixels for the whole circle.
    const FOCAL_PX: f64 = 3840.0 / std::f64::consts::TAU;

    fn core() -> Core {
        core_with("own")
    }

    fn core_with(engine: &str) -> Core {
        let overrides = [
            "bodies.list=[{name: alpha, preset: squares}]".to_owned(),
            format!("detection.engine={engine}"),
        ];
        let pipeline = flockeye_config::Pipeline::parse("", &overrides, "a test");
        let resolved = Resolved::of(pipeline.expect("a configuration")).expect("its files");
        Core::new(&resolved, 2, 5).expect("nothing is missing")
    }

    /// A white view with these markers, each with its first corner at a column and a row, and with
    /// `cell` pixels for each cell.
    fn drawn(markers: &[(u32, usize, usize)], cell: usize) -> Vec<u8> {
        let dictionary = Dictionary::load(core().dictionary()).expect("a known one");
        let size = SIZE as usize;
        let mut pixels = vec![220; size * size];
        for &(id, left, top) in markers {
            let print = dictionary.print(id).expect("it is in the dictionary");
            let side = print.cells() * cell;
            for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
                if !print.is_white((y / cell) as isize, (x / cell) as isize) {
                    pixels[(top + y) * size + left + x] = 30;
                }
            }
        }
        pixels
    }

    /// The answer to a view that can be searched.
    fn answer(
        core: &mut Core,
        header: &ViewHeader,
        pixels: &[u8],
    ) -> (DetectionHeader, Vec<DetectedMarker>) {
        let (header, markers) = core.on_view(header, pixels).expect("it is ours");
        (header, markers.expect("it can be searched"))
    }

    fn view() -> ViewHeader {
        ViewHeader {
            stamp: FrameStamp { sequence: 7, epoch: 1, ..FrameStamp::default() },
            plan_id: 3,
            taken_ns: 11,
            issued_ns: 12,
            camera_from_view: [0.0, 0.0, 0.0, 1.0],
            focal_px: FOCAL_PX,
            size_px: SIZE,
            stride: SIZE,
            view_index: 4,
            attempt: 1,
            worker: 2,
            ..ViewHeader::default()
        }
    }

    #[test]
    fn a_view_is_answered_with_its_markers() {
        let pixels = drawn(&[(3, 100, 200), (240, 400, 300)], 6);
        let (header, markers) = answer(&mut core(), &view(), &pixels);
        assert_eq!(header.check(&markers), Ok(()));
        assert_eq!((header.stamp, header.plan_id), (view().stamp, 3));
        assert_eq!((header.taken_ns, header.issued_ns), (11, 12));
        assert_eq!((header.view_index, header.attempt), (4, 1));
        assert_eq!((header.worker, header.generation, header.failed), (2, 5, 0));
        let ids: Vec<u32> = markers.iter().map(|marker| marker.id).collect();
        assert_eq!(ids, [3, 240]);
        // Only the first belongs to the configured body.
        assert_eq!(header.hits, 1);
        let [x, y] = markers[0].corners_in_view[0];
        assert!((x - 99.5).abs() < 0.2 && (y - 199.5).abs() < 0.2, "{x} {y}");
        let [right, down, _] = markers[0].rays_in_camera[0];
        assert!(right < 0.0 && down < 0.0, "it is left of the middle, and above it");
    }

    #[test]
    fn opencv_finds_the_same_markers() {
        let pixels = drawn(&[(3, 100, 200), (240, 400, 300)], 6);
        let [own, theirs] =
            ["own", "opencv"].map(|engine| answer(&mut core_with(engine), &view(), &pixels).1);
        let ids = |markers: &[DetectedMarker]| markers.iter().map(|m| m.id).collect::<Vec<u32>>();
        assert_eq!(ids(&own), ids(&theirs));
        for (own, theirs) in own.iter().zip(&theirs) {
            let corners = own.corners_in_view.iter().zip(&theirs.corners_in_view);
            for ([x, y], [their_x, their_y]) in corners {
                assert!((x - their_x).hypot(y - their_y) < 2.0, "{own:?}, {theirs:?}");
            }
        }
    }

    #[test]
    fn one_id_at_two_places_is_reported_twice() {
        let pixels = drawn(&[(3, 100, 200), (3, 400, 300)], 6);
        for engine in ["own", "opencv"] {
            let (_, markers) = answer(&mut core_with(engine), &view(), &pixels);
            let ids: Vec<u32> = markers.iter().map(|marker| marker.id).collect();
            assert_eq!(ids, [3, 3], "{engine}");
        }
    }

    #[test]
    fn a_narrow_margin_on_something_dark_is_enough() {
        let cell = 10;
        let mut pixels = drawn(&[(3, 100, 200)], cell);
        let (side, margin) = (7 * cell, 2 * cell / 5);
        for (k, pixel) in pixels.iter_mut().enumerate() {
            let (x, y) = (k % SIZE as usize, k / SIZE as usize);
            let is_inside = (100 - margin..100 + side + margin).contains(&x)
                && (200 - margin..200 + side + margin).contains(&y);
            if !is_inside {
                *pixel = 25;
            }
        }
        assert_eq!(answer(&mut core(), &view(), &pixels).0.hits, 1);
    }

    #[test]
    fn an_empty_square_is_no_marker_whatever_its_noise_reads_as() {
        let dictionary = Dictionary::load(core().dictionary()).expect("a known one");
        let print = dictionary.print(3).expect("it is in the dictionary");
        let mut pixels = drawn(&[(3, 100, 200)], 8);
        for (y, x) in (8..48).flat_map(|y| (8..48).map(move |x| (y, x))) {
            // The cells' own pattern, but hardly visible.
            let is_white = print.is_white((y / 8) as isize, (x / 8) as isize);
            pixels[(200 + y) * SIZE as usize + 100 + x] = if is_white { 40 } else { 30 };
        }
        let (header, markers) = answer(&mut core(), &view(), &pixels);
        assert_eq!(header.hits, 0, "{markers:?}");
    }

    #[test]
    fn a_view_for_another_worker_is_not_answered() {
        let header = ViewHeader { worker: 1, ..view() };
        assert!(core().on_view(&header, &drawn(&[], 6)).is_none());
    }

    #[test]
    fn a_view_whose_pixels_alone_are_wanted_is_acknowledged_unsearched() {
        let header = ViewHeader { search: Search::Nothing.code(), ..view() };
        let (header, markers) = answer(&mut core(), &header, &drawn(&[(3, 100, 200)], 6));
        assert!(markers.is_empty());
        assert_eq!((header.hits, header.failed), (0, 0));
    }

    #[test]
    fn a_view_that_cannot_be_searched_is_acknowledged_as_failed() {
        let pixels = drawn(&[(3, 100, 200)], 6);
        let refused = |change: &dyn Fn(&mut ViewHeader)| {
            let mut header = view();
            change(&mut header);
            let (header, markers) = core().on_view(&header, &pixels).expect("it is ours");
            assert_eq!((header.hits, header.failed), (0, 1));
            markers.expect_err("it says why").to_string()
        };
        let no_table = refused(&|header| header.transfer = Transfer::Table.code());
        assert!(no_table.contains("camera.response_table"), "{no_table}");
        let too_short = refused(&|header| (header.size_px, header.stride) = (900, 900));
        assert!(!too_short.is_empty());
        assert!(refused(&|header| header.search = 77).contains("unknown search code 77"));
        assert!(refused(&|header| header.kind = 77).contains("unknown view kind code 77"));
    }

    #[test]
    fn each_window_alone_finds_a_plain_marker() {
        let pixels = drawn(&[(3, 100, 200)], 4);
        for search in [Search::FineWindow, Search::CoarseWindow, Search::AllWindows] {
            let header = ViewHeader { search: search.code(), ..view() };
            assert_eq!(answer(&mut core(), &header, &pixels).0.hits, 1, "{search:?}");
        }
    }

    #[test]
    fn an_answer_does_not_depend_on_earlier_views() {
        let pixels = drawn(&[(3, 100, 200), (190, 300, 120)], 5);
        let fresh = answer(&mut core(), &view(), &pixels);
        let mut used = core();
        let magnified = ViewHeader {
            kind: ViewKind::Roi.code(),
            focal_px: 3.0 * FOCAL_PX,
            search: Search::CoarseWindow.code(),
            ..view()
        };
        answer(&mut used, &magnified, &drawn(&[(5, 50, 50)], 9));
        assert_eq!(answer(&mut used, &view(), &pixels), fresh);
    }

    #[test]
    fn a_view_full_of_markers_gives_as_many_as_a_record_holds() {
        // Nine rows of nine markers of 35 px; one is a body's, with the lowest id.
        let id = |k: usize| if k == 40 { 3 } else { 100 + k as u32 };
        let markers: Vec<(u32, usize, usize)> =
            (0..81).map(|k| (id(k), 20 + k % 9 * 62, 20 + k / 9 * 62)).collect();
        let (header, markers) = answer(&mut core(), &view(), &drawn(&markers, 5));
        assert_eq!(markers.len(), MAX_MARKERS);
        assert_eq!(header.check(&markers), Ok(()));
        assert_eq!(header.hits, 1);
    }
}
