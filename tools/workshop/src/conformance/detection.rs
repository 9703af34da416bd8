//! Test of a detection stage: views with a marker whose corners are known, empty views, and
//! malformed ones.

use std::collections::BTreeSet;
use std::time::Duration;

use flockeye_config::Resolved;
use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, FrameStamp, NONE, Search, Transfer, ViewHeader,
    ViewKind, Views,
};
use flockeye_convert::rotation;
use flockeye_dictionary::Dictionary;
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Publisher, Subscriber};
use nalgebra::{Point2, UnitQuaternion, Vector3};

use super::bench::Bench;
use super::pictures::{self, ShownMarker};
use super::report::{ConformanceReport, OWES};

const PAGE: &str = "Detection (view to detection)";

/// Views of one test; every tenth shows nothing.
const VIEWS: u32 = 120;
const SIZE_PX: u32 = 240;
const FOCAL_PX: f64 = 260.0;
/// Timeout for an answer.
const PATIENCE: Duration = Duration::from_secs(1);
/// Time in which no answer must come.
const QUIET: Duration = Duration::from_millis(200);
/// Number of unanswered views after which the test ends.
const MOST_UNANSWERED: u32 = 3;
/// Largest angle between a ray and the ray of its corner by the contract, radians.
const LARGEST_ANGLE_RAD: f64 = 1e-3;
/// Largest error of a decoded corner that still belongs to the marker, pixels.
const FAR_OFF_PX: f64 = 5.0;
/// Largest growth of memory after the first views, megabytes.
const GROWTH_MB: f64 = 20.0;

type Record = (DetectionHeader, Vec<DetectedMarker>);

/// Ports and state of the test.
struct Script {
    views: Publisher<Views>,
    records: Subscriber<Detections>,
    dictionary: Dictionary,
    owned: BTreeSet<u32>,
    sent: u32,
    unanswered: u32,
}

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let ids = resolved.bodies.iter().flat_map(|body| body.markers.iter().map(|marker| marker.id));
    let mut script = Script {
        views: bench.ports.publisher_of_lane(0)?,
        records: bench.ports.subscriber()?,
        dictionary: Dictionary::of(&resolved.bodies)?,
        owned: ids.collect(),
        sent: 0,
        unanswered: 0,
    };
    script.pictures(bench)?;
    if script.unanswered == MOST_UNANSWERED {
        return Ok(());
    }
    script.several_at_once(bench, resolved.pipeline.rectification.window)?;
    script.askers(bench)?;
    script.malformed(bench)?;
    bench.pass(Duration::from_millis(800))?;
    Ok(())
}

impl Script {
    /// A valid header for the next view.
    fn header(&mut self) -> ViewHeader {
        self.sent += 1;
        let now_ns = clock::monotonic_ns();
        let number = f64::from(self.sent);
        let turn = UnitQuaternion::from_euler_angles(0.3 * number, 0.7 * number, 1.1 * number);
        ViewHeader {
            stamp: FrameStamp {
                sequence: u64::from(self.sent),
                exposure_ns: now_ns - 2_000_000,
                stream_ns: 3,
                published_ns: now_ns - 1_000_000,
                ..FrameStamp::default()
            },
            plan_id: u64::from(self.sent) + 1000,
            taken_ns: now_ns - 500_000,
            issued_ns: now_ns,
            camera_from_view: turn.coords.into(),
            focal_px: FOCAL_PX,
            view_index: self.sent % 7,
            attempt: self.sent % 2,
            size_px: SIZE_PX,
            stride: SIZE_PX,
            kind: ViewKind::Partition.code(),
            target: NONE,
            transfer: Transfer::Srgb.code(),
            generation: self.sent % 3,
            ..ViewHeader::default()
        }
    }

    fn send(&self, header: ViewHeader, pixels: &[u8]) -> anyhow::Result<()> {
        Ok(self.views.send(header, pixels)?)
    }

    /// The next record, checked by the contract.
    fn answer(&mut self, bench: &mut Bench, patience: Duration) -> anyhow::Result<Option<Record>> {
        bench.next(&mut self.records, "records pass the contract's check", patience)
    }

    /// Sends a view, and checks its answer.
    fn asked(
        &mut self,
        bench: &mut Bench,
        view: ViewHeader,
        pixels: &[u8],
    ) -> anyhow::Result<Option<Record>> {
        self.send(view, pixels)?;
        let record = self.answer(bench, PATIENCE)?;
        bench.report.holds("one record for each view", PAGE, record.is_some(), || {
            format!("view_index {} got none in {} s", view.view_index, PATIENCE.as_secs())
        });
        match &record {
            Some(record) => self.check_record(&mut bench.report, &view, record),
            None => self.unanswered += 1,
        }
        Ok(record)
    }

    fn check_record(
        &self,
        report: &mut ConformanceReport,
        view: &ViewHeader,
        (record, markers): &Record,
    ) {
        let mut copied = |field, found: u64, wanted: u64| {
            report.field("fields are copied from the view", PAGE, field, found, wanted);
        };
        copied("stamp.sequence", record.stamp.sequence, view.stamp.sequence);
        copied(
            "stamp.exposure_ns",
            record.stamp.exposure_ns.cast_unsigned(),
            view.stamp.exposure_ns.cast_unsigned(),
        );
        copied("plan_id", record.plan_id, view.plan_id);
        copied("taken_ns", record.taken_ns.cast_unsigned(), view.taken_ns.cast_unsigned());
        copied("issued_ns", record.issued_ns.cast_unsigned(), view.issued_ns.cast_unsigned());
        copied("view_index", record.view_index.into(), view.view_index.into());
        copied("attempt", record.attempt.into(), view.attempt.into());
        copied("view_generation", record.view_generation.into(), view.generation.into());
        report.field("records say whose they are", PAGE, "worker", record.worker, 0);
        report.field("records say whose they are", PAGE, "generation", record.generation, 0);
        let times = [view.issued_ns, record.received_ns, record.sent_ns, clock::monotonic_ns()];
        report.holds("times are of CLOCK_MONOTONIC and rise", PAGE, times.is_sorted(), || {
            format!("issued_ns, received_ns, sent_ns and now are {times:?}")
        });
        let hits = markers.iter().filter(|it| self.owned.contains(&it.id)).count();
        report.field("hits counts markers of bodies", PAGE, "hits", record.hits as usize, hits);
        for marker in markers {
            let wrong = disagreement(view, marker);
            report.holds("rays are those of the corners", PAGE, wrong <= LARGEST_ANGLE_RAD, || {
                format!(
                    "rays_in_camera of marker {} is {:.2} mrad from corners_in_view; 1 mrad may be",
                    marker.id,
                    wrong * 1e3
                )
            });
        }
    }

    /// Views with a marker of 24 to 72 pixels, and without one.
    fn pictures(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let ids: Vec<u32> = self.owned.iter().copied().collect();
        let (mut shown, mut found, mut errors_px, mut took_ms) = (0, 0, Vec::new(), Vec::new());
        let mut resident_mb = 0.0;
        for number in 0..VIEWS {
            if number == VIEWS / 3 {
                resident_mb = bench.resident_mb();
            }
            let view = ViewHeader {
                search: if number % 10 == 5 { Search::Nothing.code() } else { 0 },
                ..self.header()
            };
            let side_px = 24.0 + f64::from(number % 5) * 12.0;
            let id = ids[number as usize % ids.len()];
            let marker = ShownMarker::number(number, id, side_px, FOCAL_PX);
            let marker = (number % 10 != 9).then_some(marker);
            let pixels = pictures::view(&self.dictionary, marker.as_ref(), SIZE_PX, FOCAL_PX);
            let Some((record, markers)) = self.asked(bench, view, &pixels)? else {
                if !bench.runs() || self.unanswered == MOST_UNANSWERED {
                    return Ok(());
                }
                continue;
            };
            took_ms.push(record.sent_ns.saturating_sub(record.received_ns) as f64 * 1e-6);
            match marker {
                Some(marker) if view.search == 0 => {
                    shown += 1;
                    let error_px = error_px(&marker, &markers);
                    found += u32::from(error_px.is_some());
                    errors_px.extend(error_px);
                }
                _ => bench.report.holds(
                    "nothing is found where nothing is",
                    PAGE,
                    markers.is_empty() || view.search != 0,
                    || format!("marker {} in a grey picture", markers[0].id),
                ),
            }
            // The same view is sent a second time.
            if number % 40 == 1 {
                let again = ViewHeader { issued_ns: clock::monotonic_ns(), ..view };
                if let Some((_, others)) = self.asked(bench, again, &pixels)? {
                    bench.report.holds(
                        "a view's record depends on that view alone",
                        PAGE,
                        others == markers,
                        || {
                            format!(
                                "{} markers, and {} when it was sent again",
                                markers.len(),
                                others.len()
                            )
                        },
                    );
                }
            }
        }
        bench.report.holds("markers are found", PAGE, found > 0, || {
            format!("none of {shown} markers of 24 to 72 px was decoded")
        });
        bench.report.figure(
            "markers decoded",
            f64::from(found) / f64::from(shown.max(1)) * 100.0,
            "%",
        );
        bench.report.median("corner error, median", errors_px, "px");
        bench.report.median("time for a view, median", took_ms, "ms");
        let grown_mb = bench.resident_mb() - resident_mb;
        bench.report.holds("memory stays flat", PAGE, grown_mb < GROWTH_MB, || {
            format!("resident_bytes grew by {grown_mb:.0} MB over {} views", VIEWS * 2 / 3)
        });
        Ok(())
    }

    /// Sends as many views at once as rectification keeps in flight.
    fn several_at_once(&mut self, bench: &mut Bench, window: u32) -> anyhow::Result<()> {
        for _ in 0..5 {
            let views: Vec<ViewHeader> = (0..window).map(|_| self.header()).collect();
            let pixels = pictures::view(&self.dictionary, None, SIZE_PX, FOCAL_PX);
            for view in &views {
                self.send(*view, &pixels)?;
            }
            for view in &views {
                let record = self.answer(bench, PATIENCE)?;
                bench.report.holds("one record for each view", PAGE, record.is_some(), || {
                    format!("of {window} views at once one got none")
                });
                if let Some((record, _)) = record {
                    let (found, wanted) = (record.stamp.sequence, view.stamp.sequence);
                    bench.report.field(
                        "records come in the views' order",
                        PAGE,
                        "stamp.sequence",
                        found,
                        wanted,
                    );
                }
            }
        }
        Ok(())
    }

    /// Sends a view for another worker, which must not be answered.
    fn askers(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let others = ViewHeader { worker: 1, ..self.header() };
        let pixels = pictures::view(&self.dictionary, None, SIZE_PX, FOCAL_PX);
        self.send(others, &pixels)?;
        let record = self.answer(bench, QUIET)?;
        bench.report.holds(
            "views of another worker are left alone",
            PAGE,
            record.is_none(),
            || "a view whose worker is 1 was answered by worker 0".to_owned(),
        );
        Ok(())
    }

    /// Malformed messages must not affect later ones.
    fn malformed(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let id = self.owned.iter().next().copied().unwrap_or_default();
        let marker = ShownMarker::number(1, id, 60.0, FOCAL_PX);
        let pixels = pictures::view(&self.dictionary, Some(&marker), SIZE_PX, FOCAL_PX);
        let honest = self.header();
        for (what, view) in [
            ("size_px beyond the payload", ViewHeader { size_px: 4000, stride: 4000, ..honest }),
            ("size_px 0", ViewHeader { size_px: 0, stride: 0, ..honest }),
            ("stride below size_px", ViewHeader { stride: 10, ..honest }),
            ("focal_px that is no number", ViewHeader { focal_px: f64::NAN, ..honest }),
            ("a rotation of length 0", ViewHeader { camera_from_view: [0.0; 4], ..honest }),
            ("an unknown kind", ViewHeader { kind: 77, ..honest }),
            ("one pixel", ViewHeader { size_px: 1, stride: 1, ..honest }),
            ("three pixels a side", ViewHeader { size_px: 3, stride: 3, ..honest }),
        ] {
            self.send(view, &pixels)?;
            // The answer may be a record with `failed`, or none.
            self.answer(bench, QUIET)?;
            let view = self.header();
            self.send(view, &pixels)?;
            let sequence = view.stamp.sequence;
            let records = &mut self.records;
            let is_answered = bench.wait(PATIENCE, |_| {
                let record = records.receive_with_verdict()?;
                Ok(record
                    .filter(|(message, _)| message.header.stamp.sequence == sequence)
                    .map(|_| ()))
            })?;
            bench.report.holds(
                "malformed views cost nothing else",
                OWES,
                is_answered.is_some(),
                || format!("after a view with {what} the next one was not answered"),
            );
            if !bench.runs() {
                return Ok(());
            }
        }
        Ok(())
    }
}

/// Largest angle between a marker's rays and the rays of its corners, radians.
fn disagreement(view: &ViewHeader, marker: &DetectedMarker) -> f64 {
    let camera_from_view = rotation(view.camera_from_view);
    let middle = f64::from(view.size_px - 1) / 2.0;
    let angles = marker.corners_in_view.iter().zip(&marker.rays_in_camera).map(|(corner, ray)| {
        let [u, v] = corner.map(f64::from);
        let seen = Vector3::new((u - middle) / view.focal_px, (v - middle) / view.focal_px, 1.0);
        (camera_from_view * seen).angle(&Vector3::from(*ray))
    });
    angles.fold(0.0, f64::max)
}

/// Mean error of a marker's corners, pixels; `None` if the marker was not decoded.
fn error_px(shown: &ShownMarker, markers: &[DetectedMarker]) -> Option<f64> {
    let marker = markers.iter().find(|marker| marker.id == shown.id)?;
    let truth = shown.corners(SIZE_PX, FOCAL_PX);
    let errors = marker.corners_in_view.iter().zip(&truth).map(|(corner, truth)| {
        (Point2::new(f64::from(corner[0]), f64::from(corner[1])) - truth).norm()
    });
    let mean = errors.sum::<f64>() / 4.0;
    (mean < FAR_OFF_PX).then_some(mean)
}
