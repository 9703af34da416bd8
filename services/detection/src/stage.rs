//! The ports around detection.

use std::collections::BTreeMap;

use anyhow::Context as _;
use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, MAX_DETECTED_MARKERS, Range, Transfer, ViewHeader,
    ViewKind, Views,
};
use flockeye_geometry::body::Bodies;
use flockeye_geometry::view::View;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_runtime::config::Response;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};
use nalgebra::{Quaternion, UnitQuaternion};

use crate::detector::{Detector, DetectorParameters, Found, Threshold, use_one_thread};
use crate::keep_plausible;

/// Markers in one record: as many as the topic has room for, and below the contract's limit.
const MAX_MARKERS: usize = 64;
const _: () = assert!(MAX_MARKERS <= MAX_DETECTED_MARKERS);

/// Takes the views of its lane; gives a detection record for each, also where there is nothing.
pub struct DetectionStage {
    views: Subscriber<Views>,
    detections: Publisher<Detections>,
    detector: Detector,
    bodies: Bodies,
    lights: BTreeMap<(u32, u32, u32), LinearLight>,
    /// The camera's own curve, where it was measured.
    measured: Option<[f32; 256]>,
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
        // The work is spread over processes; OpenCV's threads would only be in each other's way.
        use_one_thread()?;
        let bodies = context.pipeline.bodies()?;
        let parameters = DetectorParameters {
            min_side_px: context.pipeline.detection.min_side_px,
            ..DetectorParameters::default()
        };
        context.counters.set_detail(bodies.dictionary.as_str());
        let pipeline = &context.pipeline;
        let measured = match pipeline.camera.response {
            Response::Table => Some(pipeline.response_table()?),
            Response::Srgb | Response::Gamma | Response::Linear => None,
        };
        Ok(Self {
            views: ports.subscriber_of_lane(context.identity.replica as usize)?,
            detections: ports.publisher()?,
            detector: Detector::new(&bodies.dictionary, parameters)?
                .with_mask(pipeline.mask()?)
                .with_expected(bodies.iter().flat_map(|body| &body.markers).map(|m| m.id)),
            bodies,
            lights: BTreeMap::new(),
            measured,
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
        let outcome = self.find(&header, message.items());
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
        let size = header.size_px as usize;
        let image = LumaImage::new(pixels, size, size, header.stride as usize)?;
        let [x, y, z, w] = header.camera_from_view;
        let view = View {
            camera_from_view: UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
            focal_px: header.focal_px,
            size_px: header.size_px,
        };
        let key = (header.transfer, header.gamma.to_bits(), header.range);
        if !self.lights.contains_key(&key) {
            // A source that changes its curve with every frame must not fill the memory.
            if self.lights.len() >= 8 {
                self.lights.clear();
            }
            self.lights.insert(key, linear_light(header, self.measured.as_ref())?);
        }
        let magnification = header.focal_px / self.pixels_per_radian;
        self.detector.set_thresholds(thresholds(header.kind, magnification))?;
        self.detector.set_magnification(magnification);
        let found = self.detector.detect(&image, &view, &self.lights[&key])?;
        Ok(keep_plausible(found, &self.bodies))
    }
}

/// Windows of the local threshold, pixels of the sphere's own resolution, and how much darker than
/// its window a pixel of a marker is.
///
/// Lens blur is of a fixed size on the sphere, so what separates a marker from its surroundings is
/// too: windows grow with a view's magnification. A small one finds markers in the shade and beside
/// dark things, a large one those in bright light. Gaze views are small, and worth more passes.
const PARTITION_WINDOWS: &[(f64, f64)] = &[(7.0, 4.0), (31.0, 10.0)];
const GAZE_WINDOWS: &[(f64, f64)] = &[(5.5, 4.0), (7.5, 4.0), (15.0, 6.0), (31.0, 10.0)];

fn thresholds(kind: u32, magnification: f64) -> Vec<Threshold> {
    let windows = if kind == ViewKind::Gaze.code() { GAZE_WINDOWS } else { PARTITION_WINDOWS };
    let odd = |window: f64| 2 * (window * magnification / 2.0).floor().clamp(1.0, 500.0) as i32 + 1;
    windows
        .iter()
        .map(|&(window, darker_by)| Threshold { window_px: odd(window), darker_by })
        .collect()
}

/// The light that a view's codes stand for; `measured` is the configured table.
fn linear_light(header: &ViewHeader, measured: Option<&[f32; 256]>) -> anyhow::Result<LinearLight> {
    // Unknown codes were refused with the message; the defaults here are never taken.
    let curve = match Transfer::try_from(header.transfer).unwrap_or(Transfer::Srgb) {
        Transfer::Srgb => TransferCurve::Srgb,
        Transfer::Gamma => TransferCurve::Gamma(header.gamma),
        Transfer::Linear => TransferCurve::Linear,
        Transfer::Table => {
            let table = measured.context(
                "its curve is a table, but the configuration has none. Cure: set camera.response \
                 to table, and camera.response_table",
            )?;
            return Ok(LinearLight::from_table(*table)?);
        }
    };
    let range = match Range::try_from(header.range).unwrap_or(Range::Full) {
        Range::Full => CodeRange::Full,
        Range::Limited => CodeRange::Limited,
    };
    Ok(LinearLight::new(curve, range)?)
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_measured_curve_is_taken_as_it_is() {
        let header = ViewHeader { transfer: Transfer::Table.code(), ..ViewHeader::default() };
        let table: [f32; 256] = std::array::from_fn(|code| (code as f32 / 255.0).sqrt());
        let light = linear_light(&header, Some(&table)).unwrap();
        assert_eq!(light, LinearLight::from_table(table).unwrap());
        assert_ne!(light, LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap());
        let message = linear_light(&header, None).unwrap_err().to_string();
        assert!(message.contains("camera.response_table"), "{message}");
    }
}
