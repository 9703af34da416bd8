//! The ports around detection.

use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, MAX_DETECTED_MARKERS, Search, ViewHeader,
    ViewKind, Views,
};
use flockeye_geometry::body::Bodies;
use flockeye_imaging::edges::Effort;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};
use flockeye_viewing::{Lights, image_of, view_of};

use crate::detector::{Detector, DetectorParameters, Found};
use crate::keep_plausible;
use crate::windows::thresholds;

/// Markers in one record: as many as the topic has room for, and below the contract's limit.
const MAX_MARKERS: usize = 64;
const _: () = assert!(MAX_MARKERS <= MAX_DETECTED_MARKERS);

/// Takes the views of its lane; gives a detection record for each, also where there is nothing.
pub struct DetectionStage {
    views: Subscriber<Views>,
    detections: Publisher<Detections>,
    detector: Detector,
    bodies: Bodies,
    lights: Lights,
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
            bodies,
            lights: Lights::new(pipeline.measured_response()?)?,
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
        let outcome = match Search::try_from(header.search)? {
            Search::Nothing => Ok(Vec::new()),
            search => self.find(&header, search, message.items()),
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

    fn find(
        &mut self,
        header: &ViewHeader,
        search: Search,
        pixels: &[u8],
    ) -> anyhow::Result<Vec<Found>> {
        let (image, view) = (image_of(header, pixels)?, view_of(header));
        let magnification = header.focal_px / self.pixels_per_radian;
        let kind = ViewKind::try_from(header.kind)?;
        self.detector.set_thresholds(thresholds(kind, search, magnification).collect())?;
        self.detector.set_magnification(magnification);
        let found = self.detector.detect(&image, &view, self.lights.of(header)?);
        Ok(keep_plausible(found, &self.bodies))
    }
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
