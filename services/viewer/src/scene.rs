//! The scene: messages of the contract in, messages to the page out.
//!
//! The messages of a frame are kept until fusion ends the frame. Then they all go to the page at
//! once.

use std::collections::{BTreeMap, VecDeque};

use flockeye_contract::{
    BodyTruth, DetectedMarker, DetectionHeader, FrameEnd, FrameOrder, FrameStamp, Health,
    MeasuredBy, PeerSighting, PlanHeader, PlannedView, Rotation, RotationSource, StageLatency,
    SwarmHeader, SwarmPose, SwarmWay, Track, TrackHeader, TrackState, TruthHeader, ViewKind,
};
use flockeye_convert::at_exposure;
use flockeye_runtime::health_rates::HealthRates;
use nalgebra::Vector3;

use crate::setting::{pose, tile};
use crate::wire;

/// Maximum open frames; older ones never ended.
const OPEN_FRAMES: usize = 16;
/// Maximum plans that are kept: frames in flight refer to them.
const PLANS: usize = 16;
/// Maximum markers of a frame that are shown.
const MOST_MARKERS: usize = 128;
/// Time after which a sighting or the swarm's poses are dropped, nanoseconds.
const FORGOTTEN_NS: i64 = 5_000_000_000;
/// Maximum sightings that are kept.
const MOST_SIGHTINGS: usize = 256;
/// Time without a report after which a process is dropped, nanoseconds.
const GONE_NS: i64 = 10_000_000_000;
/// Maximum processes that are kept, because any process of the user may report anything.
const MOST_PROCESSES: usize = 64;

/// The stages' messages of the frames, the swarm and the processes.
#[derive(Debug)]
pub(crate) struct PageScene {
    is_real_time: bool,
    open: BTreeMap<FrameOrder, PartialFrame>,
    plans: VecDeque<(u64, u32, Vec<PlannedView>)>,
    last_ended: Option<FrameStamp>,
    skipped: u64,
    drones: Option<(SwarmHeader, Vec<SwarmPose>)>,
    sightings: BTreeMap<(String, String), PeerSighting>,
    /// The newest report of each process, as rates.
    processes: BTreeMap<(String, u32), HealthRates>,
}

/// A frame that has not ended.
#[derive(Debug, Default)]
struct PartialFrame {
    searched: Vec<(u64, u32)>,
    markers: Vec<DetectedMarker>,
    end: Option<FrameEnd>,
    tracks: BTreeMap<u32, Track>,
    turn: Option<Rotation>,
    truth: Vec<BodyTruth>,
}

#[derive(Debug, Clone)]
pub(crate) struct EndedFrame {
    pub stamp: FrameStamp,
    /// Tracks of its neighbours, as in the contract.
    pub tracks: Vec<Track>,
    /// Time in a recording at which it ended, UTC nanoseconds; 0 for a running pipeline.
    pub utc_ns: u64,
    pub message: wire::FrameMessage,
}

impl PageScene {
    /// An empty scene. `is_real_time`: whether exposures are on this machine's clock.
    pub(crate) fn new(is_real_time: bool) -> Self {
        Self {
            is_real_time,
            open: BTreeMap::new(),
            plans: VecDeque::new(),
            last_ended: None,
            skipped: 0,
            drones: None,
            sightings: BTreeMap::new(),
            processes: BTreeMap::new(),
        }
    }

    pub(crate) fn health(&mut self, health: &Health) {
        let process = (health.stage.to_string(), health.replica);
        if self.processes.len() < MOST_PROCESSES || self.processes.contains_key(&process) {
            self.processes.entry(process).or_insert_with(|| HealthRates::new(health)).take(health);
        }
    }

    pub(crate) fn plan(&mut self, header: &PlanHeader, views: &[PlannedView]) {
        if self.plans.len() == PLANS {
            self.plans.pop_front();
        }
        self.plans.push_back((header.plan_id, header.generation, views.to_vec()));
    }

    pub(crate) fn detection(&mut self, header: &DetectionHeader, markers: &[DetectedMarker]) {
        let frame = self.frame(&header.stamp);
        if frame.searched.len() < flockeye_contract::MAX_PLANNED_VIEWS {
            frame.searched.push((header.plan_id, header.view_index));
        }
        let room = MOST_MARKERS.saturating_sub(frame.markers.len());
        frame.markers.extend(markers.iter().take(room));
    }

    /// Takes the end of a frame's views.
    pub(crate) fn frame_end(&mut self, end: &FrameEnd) {
        self.frame(&end.stamp).end = Some(*end);
    }

    pub(crate) fn rotation(&mut self, rotation: &Rotation) {
        self.frame(&rotation.stamp).turn = Some(*rotation);
    }

    /// Takes the truth of a simulated frame.
    pub(crate) fn truth(&mut self, header: &TruthHeader, bodies: &[BodyTruth]) {
        self.frame(&header.stamp).truth = bodies.to_vec();
    }

    pub(crate) fn sightings(&mut self, sightings: &[PeerSighting]) {
        for sighting in sightings {
            let pair = (sighting.observer.to_string(), sighting.target.to_string());
            if self.sightings.len() < MOST_SIGHTINGS || self.sightings.contains_key(&pair) {
                self.sightings.insert(pair, *sighting);
            }
        }
    }

    /// Takes the poses of all drones.
    pub(crate) fn drones(&mut self, header: &SwarmHeader, poses: &[SwarmPose]) {
        self.drones = Some((*header, poses.to_vec()));
    }

    /// Takes tracks; returns the frame if these tracks end it.
    pub(crate) fn tracks(
        &mut self,
        header: &TrackHeader,
        tracks: &[Track],
        now_ns: i64,
    ) -> Option<EndedFrame> {
        let frame = self.frame(&header.stamp);
        frame.tracks.extend(tracks.iter().map(|track| (track.target, *track)));
        if header.is_last == 0 {
            return None;
        }
        let frame = self.open.remove(&header.stamp.order())?;
        // Older frames that have not ended by now never will: frames end in order.
        self.open = self.open.split_off(&header.stamp.order());
        self.count_skipped(&header.stamp);
        Some(self.ended(header.stamp, frame, now_ns))
    }

    /// Poses of the swarm's drones and their sightings of each other, if any is known.
    pub(crate) fn swarm(
        &mut self,
        now_ns: i64,
    ) -> Option<(Vec<wire::DroneSummary>, Vec<wire::SightingSummary>)> {
        let age_s = |then_ns: i64| (now_ns.saturating_sub(then_ns) as f64 * 1e-9) as f32;
        self.sightings
            .retain(|_, sighting| now_ns.saturating_sub(sighting.exposure_ns) < FORGOTTEN_NS);
        if self
            .drones
            .as_ref()
            .is_some_and(|(header, _)| now_ns.saturating_sub(header.sent_ns) > FORGOTTEN_NS)
        {
            self.drones = None;
        }
        if self.sightings.is_empty() && self.drones.is_none() {
            return None;
        }
        let drones =
            self.drones.iter().flat_map(|(_, poses)| poses).map(|drone| wire::DroneSummary {
                name: drone.name.to_string(),
                pose: pose(&drone.own_from_drone),
                covariance: position_covariance(&drone.covariance),
                way: SwarmWay::try_from(drone.way).map_or("unknown", SwarmWay::name),
                through: drone.through.to_string(),
                age_s: age_s(drone.seen_ns),
            });
        let sightings = self.sightings.values().map(|sighting| wire::SightingSummary {
            observer: sighting.observer.to_string(),
            target: sighting.target.to_string(),
            state: state(sighting.state),
            range_m: Vector3::from(sighting.observer_from_target.position).norm() as f32,
            age_s: age_s(sighting.exposure_ns),
        });
        Some((drones.collect(), sightings.collect()))
    }

    /// The reports of the stages.
    pub(crate) fn stages(&mut self, now_ns: i64) -> Vec<wire::ProcessReport> {
        self.processes.retain(|_, rates| rates.silent_ns(now_ns) < GONE_NS);
        let stages = self.processes.iter().map(|((stage, replica), rates)| {
            let last = &rates.last;
            wire::ProcessReport {
                stage: stage.clone(),
                replica: *replica,
                generation: last.generation,
                state: rates.state(now_ns),
                detail: last.detail.to_string(),
                taken_per_s: rates.taken_per_s as f32,
                published_per_s: rates.published_per_s as f32,
                dropped: last.dropped,
                failed: last.failed,
                queued: last.queued,
                processor: rates.processor_share as f32,
                resident_mb: last.resident_bytes as f32 * 1e-6,
                latency_ms: rates.latency_ms.map(|latency| latency.map(|ms| ms as f32)),
            }
        });
        stages.collect()
    }

    fn frame(&mut self, stamp: &FrameStamp) -> &mut PartialFrame {
        while self.open.len() >= OPEN_FRAMES && !self.open.contains_key(&stamp.order()) {
            self.open.pop_first();
        }
        self.open.entry(stamp.order()).or_default()
    }

    fn count_skipped(&mut self, stamp: &FrameStamp) {
        if let Some(last) = self.last_ended.replace(*stamp) {
            self.skipped += stamp.skipped_since(&last);
        }
    }

    fn ended(&self, stamp: FrameStamp, frame: PartialFrame, now_ns: i64) -> EndedFrame {
        let PartialFrame { searched, markers, end, tracks, turn, truth } = frame;
        let mut shown = wire::FrameMessage {
            key: wire::key(&stamp),
            sequence: stamp.sequence,
            exposure_s: stamp.exposure_s(),
            age_ms: self
                .is_real_time
                .then(|| (now_ns.saturating_sub(stamp.exposure_ns) as f64 * 1e-6) as f32),
            skipped: self.skipped,
            partitions: Vec::new(),
            high_resolution: Vec::new(),
            regions: Vec::new(),
            views: end.map_or([0; 2], |end| [end.views_issued, end.views_abandoned]),
            markers: markers.iter().map(detected).collect(),
            tracks: tracks.values().map(track).collect(),
            turn: turn.as_ref().and_then(turned),
            truth: truth.iter().map(true_pose).collect(),
            at_s: None,
        };
        self.add_views(&mut shown, &searched, end.as_ref(), &stamp);
        let tracks = tracks.into_values().collect();
        EndedFrame { stamp, tracks, utc_ns: 0, message: shown }
    }

    /// Adds the views of a frame: those that were searched, and the regions that were cut.
    fn add_views(
        &self,
        shown: &mut wire::FrameMessage,
        searched: &[(u64, u32)],
        end: Option<&FrameEnd>,
        stamp: &FrameStamp,
    ) {
        let Some(plan_id) = end.map(|end| end.plan_id).or(searched.first().map(|(plan, _)| *plan))
        else {
            return;
        };
        // If several plans have this number, the newest fusion's plan counts.
        let Some((_, _, views)) = self.plans.iter().rev().find(|(id, ..)| *id == plan_id) else {
            return;
        };
        let issued = end.map_or(views.len(), |end| end.views_issued as usize);
        for (index, view) in (0u32..).zip(views).take(issued) {
            let is_searched = searched.contains(&(plan_id, index));
            match ViewKind::try_from(view.kind) {
                Ok(ViewKind::Partition) if is_searched => shown.partitions.push(view.tile),
                Ok(ViewKind::HighResolution) if is_searched => {
                    shown.high_resolution.push(view.tile);
                }
                Ok(ViewKind::Roi) => shown.regions.push(region(view, stamp)),
                // The plan does not contain the direction of a proposal; rectification chooses it.
                _ => {}
            }
        }
    }
}

/// A region of interest, as it was cut from a frame.
fn region(view: &PlannedView, stamp: &FrameStamp) -> wire::RegionView {
    wire::RegionView { target: view.target, view: tile(&at_exposure(view, stamp.exposure_ns)) }
}

fn detected(marker: &DetectedMarker) -> wire::Detected {
    wire::Detected { id: marker.id, rays: marker.rays_in_camera.map(|ray| ray.map(|x| x as f32)) }
}

fn track(track: &Track) -> wire::TrackSummary {
    let turns = track.covariance[21] + track.covariance[28] + track.covariance[35];
    wire::TrackSummary {
        target: track.target,
        name: track.name.to_string(),
        track: track.track_id,
        state: track.state_name(),
        by: MeasuredBy::try_from(track.measured_by).unwrap_or(MeasuredBy::Nothing).name(),
        markers: track.markers,
        pose: pose(&track.observer_from_target),
        rival: (track.is_ambiguous != 0).then(|| pose(&track.rival_observer_from_target)),
        covariance: position_covariance(&track.covariance),
        attitude_deg: turns.max(0.0).sqrt().to_degrees() as f32,
        velocity: track.linear_velocity.map(|x| x as f32),
        unseen_s: (track.unseen_ns as f64 * 1e-9) as f32,
        age_s: (track.age_ns as f64 * 1e-9) as f32,
        latency_ms: latency_ms(&track.latency),
    }
}

/// Milliseconds of capture, rectification, detection, fusion, and in total; none where unknown.
pub(crate) fn latency_ms(latency: &StageLatency) -> [Option<f32>; 5] {
    let parts = [
        latency.capture_ns,
        latency.rectification_ns,
        latency.detection_ns,
        latency.fusion_ns,
        latency.total_ns,
    ];
    parts.map(|ns| (ns >= 0).then_some((ns as f64 * 1e-6) as f32))
}

fn true_pose(body: &BodyTruth) -> wire::Truth {
    wire::Truth { target: body.target, pose: pose(&body.observer_from_target) }
}

fn turned(rotation: &Rotation) -> Option<[f32; 4]> {
    let is_known = rotation.source != RotationSource::Nothing.code();
    is_known.then(|| rotation.later_from_earlier.map(|x| x as f32))
}

/// The upper triangle of the position's part of a 6x6 covariance, row by row.
fn position_covariance(covariance: &[f64; 36]) -> [f32; 6] {
    [0, 1, 2, 7, 8, 14].map(|place| covariance[place] as f32)
}

/// The name of a track's state.
pub(crate) fn state(code: u32) -> &'static str {
    TrackState::try_from(code).map_or("unknown", TrackState::name)
}

#[cfg(test)]
mod tests;
