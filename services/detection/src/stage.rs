//! The ports around detection.

use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, MAX_DETECTED_MARKERS, ViewHeader, ViewKind, Views,
};
use flockeye_convert::{RadianceCache, image_of, view_of};
use flockeye_geometry::body::Bodies;
use flockeye_imaging::edges::Effort;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::detector::{Detector, DetectorParameters, Found, Threshold};
use crate::keep_plausible;
use crate::turns::Turns;

/// Markers in one record: as many as the topic has room for, and below the contract's limit.
const MAX_MARKERS: usize = 64;
const _: () = assert!(MAX_MARKERS <= MAX_DETECTED_MARKERS);

/// Takes the views of its lane; gives a detection record for each, also where there is nothing.
pub struct DetectionStage {
    views: Subscriber<Views>,
    detections: Publisher<Detections>,
    detector: Detector,
    /// Where the sphere is swept again and again.
    turns: Option<Turns>,
    bodies: Bodies,
    lights: RadianceCache,
    /// The sphere image's own resolution.
    pixels_per_radian: f64,
    worker: u32,
    generation: u32,
    counters: SharedCounters,
    failures: Throttle,
}

impl Stage for DetectionStage {
    const NAME: &'static str = "detection";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let bodies = context.pipeline.bodies()?;
        let parameters = DetectorParameters {
            min_side_px: context.pipeline.detection.min_side_px,
            // Where fusion aligns whole bodies, corners are what it begins from, and time matters.
            effort: match context.pipeline.fusion.align {
                true => Effort::Edges,
                false => Effort::WholePrint,
            },
            ..DetectorParameters::default()
        };
        context.counters.set_detail(bodies.dictionary.as_str());
        let pipeline = &context.pipeline;
        let detector = Detector::new(&bodies.dictionary, parameters)?
            .with_mask(pipeline.mask()?)
            .with_expected(bodies.iter().flat_map(|body| &body.markers).map(|marker| marker.id));
        detector.dictionary().check(&bodies)?;
        Ok(Self {
            views: ports.subscriber_of_lane(context.identity.replica as usize)?,
            detections: ports.publisher()?,
            detector,
            turns: pipeline.sweeps_by_turns().then(Turns::default),
            bodies,
            lights: RadianceCache::new(pipeline.measured_response()?)?,
            pixels_per_radian: context.pipeline.camera_model()?.pixels_per_radian(),
            worker: context.identity.replica,
            generation: context.identity.generation,
            counters: context.counters.clone(),
            failures: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let Some(message) = self.views.receive()? else { return Ok(Step::Wait) };
        if message.header.worker == self.worker {
            self.search(&message)?;
        }
        Ok(Step::Again)
    }
}

impl DetectionStage {
    fn search(&mut self, message: &Message<Views>) -> anyhow::Result<()> {
        let received_ns = clock::monotonic_ns();
        let header = message.header;
        // Fusion looks at its pixels alone.
        let outcome = match header.unsearched {
            0 => self.find(&header, message.items()),
            _ => Ok(Vec::new()),
        };
        let failed = u32::from(outcome.is_err());
        let mut found = outcome.unwrap_or_else(|error| {
            self.counters.add_failed(1);
            if let Some(more) = self.failures.admit() {
                tracing::warn!(more_since = more, "a view cannot be searched: {error:#}");
            }
            Vec::new()
        });
        found.truncate(MAX_MARKERS);
        let markers: Vec<DetectedMarker> = found.iter().map(detected).collect();
        let is_hit = |found: &&Found| !found.is_doubtful && self.bodies.owner(found.id).is_some();
        let hits = found.iter().filter(is_hit).count();
        let sent_ns = clock::monotonic_ns();
        self.counters.add_latency_ns(sent_ns - received_ns);
        let record = DetectionHeader {
            stamp: header.stamp,
            plan_id: header.plan_id,
            taken_ns: header.taken_ns,
            issued_ns: header.issued_ns,
            received_ns,
            sent_ns,
            generation: self.generation,
            view_index: header.view_index,
            attempt: header.attempt,
            worker: self.worker,
            hits: hits as u32,
            failed,
        };
        Ok(self.detections.send(record, &markers)?)
    }

    fn find(&mut self, header: &ViewHeader, pixels: &[u8]) -> anyhow::Result<Vec<Found>> {
        let (image, view) = (image_of(header, pixels)?, view_of(header));
        let magnification = header.focal_px / self.pixels_per_radian;
        let mut thresholds = thresholds(header.kind, magnification);
        if let Some(turns) = &mut self.turns
            && header.kind == ViewKind::Partition.code()
        {
            thresholds = turns.take(header.partition, &thresholds);
        }
        self.detector.set_thresholds(thresholds)?;
        self.detector.set_magnification(magnification);
        let found = self.detector.detect(&image, &view, self.lights.of(header)?);
        Ok(keep_plausible(found, &self.bodies))
    }
}

/// Windows of the local threshold, pixels of the sphere's own resolution, and how much darker than
/// its window a pixel of a marker is.
///
/// Lens blur is of a fixed size on the sphere, so what separates a marker from its surroundings is
/// too: windows grow with a view's magnification. A small one finds markers in the shade and beside
/// dark things, a large one those in bright light. Gaze views are small, and worth more passes.
const PARTITION_WINDOWS: &[(f64, u8)] = &[(7.0, 4), (31.0, 10)];
const GAZE_WINDOWS: &[(f64, u8)] = &[(5.5, 4), (7.5, 4), (15.0, 6), (31.0, 10)];

/// What is looked for in a view of this [`ViewKind`] and magnification.
pub fn thresholds(kind: u32, magnification: f64) -> Vec<Threshold> {
    let windows = if kind == ViewKind::Gaze.code() { GAZE_WINDOWS } else { PARTITION_WINDOWS };
    let odd =
        |window: f64| 2 * (window * magnification / 2.0).floor().clamp(1.0, 500.0) as usize + 1;
    windows
        .iter()
        .map(|&(window, darker_by)| Threshold { window_px: odd(window), darker_by })
        .collect()
}

fn detected(found: &Found) -> DetectedMarker {
    DetectedMarker {
        rays_in_camera: found.rays_in_camera.map(|ray| [ray.x, ray.y, ray.z]),
        deviations: found.deviations_rad,
        corners_in_view: found.corners_in_view.map(|corner| [corner.0.x as f32, corner.0.y as f32]),
        id: found.id,
        doubtful: u32::from(found.is_doubtful),
    }
}
