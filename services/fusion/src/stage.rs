//! The ports around fusion.

use std::collections::BTreeMap;

use anyhow::Context as _;
use flockeye_contract::{
    DetectionHeader, Detections, FrameEnds, FrameStamp, PlanHeader, Plans, Track, TrackHeader,
    Tracks, ViewHeader, Views,
};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::search::{Planner, Purpose, StopRule};
use flockeye_runtime::bodies::isometry;
use flockeye_runtime::config::{Flow, Mode};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::memory::{self, MAX_TRACKS};
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};
use flockeye_viewing::{Lights, view_of};
use nalgebra::Isometry3;

use crate::alignment::{Aligner, Pace};
use crate::assembly::{Assembly, Frame, Leave, Record};
use crate::gallery::{FrameOrder, Gallery};
use crate::message::{self, Cause, purpose_stated, search_stated, seconds};
use crate::parallax::Parallax;
use crate::pictures::{best_views, glimpses};
use crate::settings::{filter_choice, mode_code, search_mode};
use crate::sighting::agrees_with_view;
use crate::swarm::{FilterChoice, Glimpse, Purposes, Seen, Swarm, Update};

/// How often it is looked, while its frame is open, whether a second look is over, nanoseconds.
const LOOKING_AGAIN_NS: i64 = 4_000_000;

/// How often it is looked whether rectification has joined, nanoseconds.
const JOINING_NS: i64 = 5_000_000;

/// A frame is behind when so many newer ones have come.
const BEHIND_FRAMES: u64 = 2;

/// Plans that are remembered, for frames that still follow them.
const REMEMBERED_PLANS: usize = 16;

/// Takes views, detections and frame ends; gives tracks and plans.
pub struct FusionStage {
    views: Vec<Subscriber<Views>>,
    detections: Subscriber<Detections>,
    frame_ends: Subscriber<FrameEnds>,
    tracks: Publisher<Tracks>,
    plans: Publisher<Plans>,
    assembly: Assembly,
    gallery: Gallery<Message<Views>>,
    lights: Lights,
    swarm: Swarm,
    remembered: BTreeMap<u64, (Purposes, StopRule)>,
    plan_id: u64,
    generation: u32,
    flow: Flow,
    /// Whether views' pixels are looked into.
    aligns: bool,
    observer_from_camera: Isometry3<f64>,
    mode: Mode,
    /// Gaze views that came and were not peeked into yet.
    arrived: Vec<(FrameOrder, u32)>,
    /// Records of a lossless run that came before their views.
    early: Vec<Record>,
    /// Until when a lossless run waits for rectification to join.
    alone_until_ns: i64,
    /// The newest frame of which a view has come.
    newest: Option<FrameStamp>,
    counters: SharedCounters,
    disagreements: Throttle,
    strangers: Throttle,
    incomplete: Throttle,
}

impl Stage for FusionStage {
    const NAME: &'static str = "fusion";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let pipeline = &context.pipeline;
        let bodies = pipeline.bodies()?;
        let views = pipeline.partition_views(bodies.largest_side())?;
        let planner = Planner::new(
            search_mode(pipeline),
            pipeline.sphere_partition()?,
            views,
            pipeline.gaze_options()?,
        )?
        .with_high_resolution_tiles(pipeline.far_views()?)
        .with_alternating_windows(pipeline.sweeps_by_turns())
        .with_mask(pipeline.mask()?);
        if planner.hidden_partitions() > 0 {
            tracing::info!(
                "{} of {} partitions are never searched: the camera sees nothing of them",
                planner.hidden_partitions(),
                planner.partition().len()
            );
        }
        let camera = pipeline.camera_model()?;
        let observer_from_camera = isometry(&pipeline.observer.observer_from_camera);
        let dictionary = Dictionary::load(&bodies.dictionary)?;
        let aligner = Aligner::new(&bodies, |id| dictionary.print(id), camera.pixels_per_radian())?
            .with_covariance_scale(pipeline.fusion.covariance_scale)
            .with_level(&bodies, &observer_from_camera, pipeline.fusion.level_deg.to_radians());
        let threads = pipeline.fusion.threads as usize;
        let filter = filter_choice(pipeline);
        let mut swarm = Swarm::new(&bodies, filter, planner, aligner, threads)
            .with_parallax(Parallax::of(&camera, pipeline.camera.assumed_distance_m));
        // What comes when it comes depends on time, and nothing may in a lossless run.
        let is_tracked = matches!(filter, FilterChoice::Tracks(_));
        if pipeline.flow == Flow::Latest && pipeline.fusion.align && is_tracked {
            swarm = swarm.with_second_looks().context("a thread for second looks")?;
        }
        Ok(Self {
            views: ports.subscribers_of_all_lanes()?,
            detections: ports.subscriber()?,
            frame_ends: ports.subscriber()?,
            tracks: ports.publisher()?,
            plans: ports.publisher()?,
            assembly: Assembly::new(pipeline.frame_deadline().as_nanos() as i64),
            gallery: Gallery::new(
                memory::held_views_waiting(pipeline),
                memory::held_views_best(pipeline),
            ),
            lights: Lights::new(pipeline.measured_response()?)?,
            swarm,
            remembered: BTreeMap::new(),
            plan_id: 0,
            generation: context.identity.generation,
            flow: pipeline.flow,
            aligns: pipeline.fusion.align,
            observer_from_camera,
            mode: pipeline.search.mode,
            arrived: Vec::new(),
            early: Vec::new(),
            alone_until_ns: clock::monotonic_ns() + pipeline.frame_deadline().as_nanos() as i64,
            newest: None,
            counters: context.counters.clone(),
            disagreements: Throttle::default(),
            strangers: Throttle::default(),
            incomplete: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let is_live = self.flow == Flow::Latest;
        let is_alone = !is_live && !self.connect()?;
        if self.plan_id == 0 {
            let now_ns = clock::monotonic_ns();
            if is_alone && now_ns < self.alone_until_ns {
                return Ok(Step::WaitUntil(now_ns + JOINING_NS));
            }
            // The first plan opens the flow: rectification has something to follow, and a lossless
            // source its first credit.
            self.send_plan(None)?;
        }
        self.plans.greet_newcomers()?;
        let now_ns = clock::monotonic_ns();
        // In a lossless run nothing may depend on who is faster: there each view is taken when its record
        // comes, and what is not searched yet is left where it waits.
        if is_live {
            self.take_all_views(now_ns)?;
            self.peek()?;
        }
        let mut records = std::mem::take(&mut self.early);
        while let Some(message) = self.detections.receive()? {
            records.push(Record { header: message.header, markers: message.items().to_vec() });
        }
        let mut taken = Vec::new();
        for record in records {
            self.take_view_of(&record.header, now_ns)?;
            if is_live || !self.is_early(&record.header) {
                taken.extend(self.take_record(record, now_ns));
            } else {
                self.early.push(record);
            }
        }
        if is_live {
            self.take_all_views(now_ns)?;
        }
        self.glance(&taken)?;
        self.take_second_look()?;
        while let Some(message) = self.frame_ends.receive()? {
            self.assembly.add_end(message.header, now_ns);
        }
        while let Some((frame, leave)) = self.assembly.take(clock::monotonic_ns()) {
            if leave == Leave::Overdue {
                self.counters.add_failed(1);
                if let Some(more) = self.incomplete.admit() {
                    tracing::warn!(
                        frame = frame.stamp.sequence,
                        more_since = more,
                        "a frame was not ended in time: rectification or detection does not answer"
                    );
                }
            }
            self.finish(&frame)?;
        }
        self.counters.set_queued(self.assembly.open_frames());
        if self.swarm.awaited().is_some_and(|order| self.assembly.of_order(order).is_some()) {
            return Ok(Step::WaitUntil(clock::monotonic_ns() + LOOKING_AGAIN_NS));
        }
        Ok(self.assembly.next_deadline_ns().map_or(Step::Wait, Step::WaitUntil))
    }
}

impl FusionStage {
    /// Lets rectification know that it has to wait for this stage where a lane is full; false while it is
    /// not there.
    fn connect(&self) -> anyhow::Result<bool> {
        let lanes: Result<Vec<bool>, _> = self.views.iter().map(Subscriber::connect).collect();
        Ok(lanes?.iter().all(|is_published| *is_published))
    }

    /// Takes the views that have come, as many as can be held.
    fn take_all_views(&mut self, now_ns: i64) -> anyhow::Result<()> {
        (0..self.views.len()).try_for_each(|lane| self.take_views(lane, now_ns, Gallery::is_full))
    }

    /// Takes the view that a record answers, which passed before it in its worker's lane.
    fn take_view_of(&mut self, record: &DetectionHeader, now_ns: i64) -> anyhow::Result<()> {
        let (order, index) = (record.stamp.order(), record.view_index);
        let lane = record.worker as usize;
        if self.knows_view_of(record) || lane >= self.views.len() {
            return Ok(());
        }
        self.take_views(lane, now_ns, |gallery| gallery.is_waiting(order, index))
    }

    /// Takes the views that have come in a lane until `is_enough`, and holds them if their pixels will
    /// be looked into.
    fn take_views(
        &mut self,
        lane: usize,
        now_ns: i64,
        is_enough: impl Fn(&Gallery<Message<Views>>) -> bool,
    ) -> anyhow::Result<()> {
        while !is_enough(&self.gallery)
            && let Some(message) = self.views[lane].receive()?
        {
            let header = message.header;
            if !self.assembly.add_view(header, now_ns) {
                continue;
            }
            if self.newest.is_none_or(|newest| !header.stamp.is_late_beside(&newest)) {
                self.newest = Some(header.stamp);
            }
            let purpose = purpose_stated(&header);
            if let Some(purpose) = purpose {
                self.swarm.note_cut(purpose, search_stated(&header));
            }
            if self.aligns {
                self.gallery.add(header, message);
                if self.flow == Flow::Latest && matches!(purpose, Some(Purpose::Gaze(_))) {
                    self.arrived.push((header.stamp.order(), header.view_index));
                }
            }
        }
        Ok(())
    }

    /// Whether a record's view is still on its way here: rectification, which had to wait for room in this
    /// stage's lane, had handed it to the worker before.
    fn is_early(&self, record: &DetectionHeader) -> bool {
        !self.knows_view_of(record) && !self.assembly.has_left(&record.stamp)
    }

    fn knows_view_of(&self, record: &DetectionHeader) -> bool {
        let frame = self.assembly.open_frame(&record.stamp);
        frame.is_some_and(|frame| frame.views.contains_key(&record.view_index))
    }

    /// Notes a record; `None` if nobody waits for it.
    fn take_record(&mut self, record: Record, now_ns: i64) -> Option<Record> {
        let Record { header, mut markers } = record;
        let of_frame = self.assembly.open_frame(&header.stamp);
        let of_view = of_frame.and_then(|frame| frame.views.get(&header.view_index)).copied();
        if let Some(view) = &of_view {
            let view = view_of(view);
            if let Some(marker) = markers.iter().find(|marker| !agrees_with_view(marker, &view)) {
                self.counters.add_failed(1);
                if let Some(more) = self.disagreements.admit() {
                    tracing::warn!(
                        worker = header.worker,
                        marker = marker.id,
                        more_since = more,
                        "a worker's rays are not those of its corners in the view; its markers are left out. \
                         Cure: mend the detector; docs/CONTRACT.md has the conventions"
                    );
                }
                markers.clear();
            }
        }
        self.note_strangers(&markers);
        let record = Record { header, markers };
        if !self.assembly.add_record(record.clone(), now_ns) {
            self.counters.add_dropped(1);
            return None;
        }
        let purpose = self.purpose_of(&header, of_view.as_ref());
        let stop_rule =
            self.remembered.get(&header.plan_id).map_or(StopRule::All, |(_, stop_rule)| *stop_rule);
        let shows = self.swarm.shown(&record, purpose, of_view.as_ref(), stop_rule);
        self.gallery.answered(header.stamp.order(), header.view_index, &shows);
        Some(record)
    }

    /// Publishes what gaze views that have come show of confirmed neighbours, before they are searched.
    fn peek(&mut self) -> anyhow::Result<()> {
        let arrived = std::mem::take(&mut self.arrived);
        // One after the other, or as many at once as there are threads.
        for of_frame in arrived.chunk_by(|(one, _), (other, _)| one == other) {
            for views in of_frame.chunks(self.swarm.threads()) {
                self.peek_at(views)?;
            }
        }
        Ok(())
    }

    /// The same for some views of one frame.
    fn peek_at(&mut self, views: &[(FrameOrder, u32)]) -> anyhow::Result<()> {
        let glimpses = glimpses(&self.gallery, &mut self.lights, &self.swarm, views);
        let Some(stamp) = glimpses.first().map(|(header, _)| header.stamp) else { return Ok(()) };
        let headers: BTreeMap<usize, ViewHeader> =
            glimpses.iter().map(|(header, glimpse)| (glimpse.target, *header)).collect();
        let glimpses: Vec<Glimpse<'_>> = glimpses.into_iter().map(|(_, glimpse)| glimpse).collect();
        let updates = self.swarm.peek(stamp.order(), seconds(&stamp), &glimpses);
        for update in updates {
            if let Some(header) = headers.get(&update.0) {
                self.send_tracks(&stamp, &[update], Cause::View(header), false)?;
            }
        }
        Ok(())
    }

    /// How much time there is for a frame; in a lossless run time decides nothing.
    fn pace(&self, stamp: &FrameStamp) -> Pace {
        let waits = |newest: &FrameStamp| {
            stamp.is_late_beside(newest)
                && newest.sequence.wrapping_sub(stamp.sequence) >= BEHIND_FRAMES
        };
        match self.flow {
            Flow::Lossless => Pace::Unhurried,
            Flow::Latest if self.newest.as_ref().is_some_and(waits) => Pace::Behind,
            Flow::Latest => Pace::Live,
        }
    }

    /// Publishes what gaze views say, without waiting for the rest of their frames.
    fn glance(&mut self, taken: &[Record]) -> anyhow::Result<()> {
        // In a lossless run nothing may depend on which worker answers first.
        if self.flow == Flow::Lossless {
            return Ok(());
        }
        let mut stamps: Vec<FrameStamp> = taken.iter().map(|record| record.header.stamp).collect();
        stamps.sort_by_key(FrameStamp::order);
        stamps.dedup_by_key(|stamp| stamp.order());
        for stamp in stamps {
            let Some(frame) = self.assembly.open_frame(&stamp) else { continue };
            let of_frame: Vec<&Record> =
                taken.iter().filter(|record| record.header.stamp.is_same_frame(&stamp)).collect();
            let seen: Vec<Seen<'_>> = of_frame
                .iter()
                .map(|record| {
                    let view = frame.views.get(&record.header.view_index);
                    Seen { record, purpose: self.purpose_of(&record.header, view), view }
                })
                .collect();
            let order = stamp.order();
            self.swarm.hurry(self.pace(&stamp));
            let best_views = best_views(&self.gallery, &mut self.lights, &self.swarm, order);
            let updates = self.swarm.glance(order, seconds(&stamp), &seen, &best_views);
            drop(best_views);
            if !updates.is_empty() {
                self.send_tracks(&stamp, &updates, Cause::Records(&of_frame), false)?;
            }
            for (target, _) in updates {
                self.gallery.release(order, target);
            }
        }
        Ok(())
    }

    /// Publishes what a second look found, if its frame is still open; else the next one is the better for
    /// it.
    fn take_second_look(&mut self) -> anyhow::Result<()> {
        if let Some((order, update)) = self.swarm.take_second_look()?
            && let Some(frame) = self.assembly.of_order(order)
        {
            let records: Vec<&Record> = frame.records.values().collect();
            let target = update.0;
            self.send_tracks(&frame.stamp, &[update], Cause::Records(&records), false)?;
            self.gallery.release(order, target);
        }
        Ok(())
    }

    fn note_strangers(&mut self, markers: &[flockeye_contract::DetectedMarker]) {
        let is_owned = |id| {
            self.swarm.neighbours().iter().any(|neighbour| neighbour.body.marker(id).is_some())
        };
        if let Some(stranger) = markers.iter().find(|marker| !is_owned(marker.id))
            && let Some(more) = self.strangers.admit()
        {
            tracing::info!(
                marker = stranger.id,
                more_since = more,
                "a marker was seen that no configured body carries; it is ignored"
            );
        }
    }

    /// What a view was cut for: as planned, or, where rectification swept on its own, as it says.
    fn purpose_of(&self, header: &DetectionHeader, view: Option<&ViewHeader>) -> Option<Purpose> {
        match self.remembered.get(&header.plan_id) {
            Some((purposes, _)) => purposes.get(&header.view_index).copied(),
            None => view.and_then(purpose_stated),
        }
    }

    fn finish(&mut self, frame: &Frame) -> anyhow::Result<()> {
        let swept = || {
            let stated = frame
                .views
                .iter()
                .filter_map(|(index, view)| Some((*index, purpose_stated(view)?)));
            (stated.collect(), StopRule::All)
        };
        let (purposes, stop_rule) =
            self.remembered.get(&frame.plan_id).cloned().unwrap_or_else(swept);
        let order = frame.stamp.order();
        self.swarm.hurry(self.pace(&frame.stamp));
        let best_views = best_views(&self.gallery, &mut self.lights, &self.swarm, order);
        let updates =
            self.swarm.finish(seconds(&frame.stamp), frame, &purposes, stop_rule, &best_views);
        drop(best_views);
        self.gallery.forget(order);
        let records: Vec<&Record> = frame.records.values().collect();
        for part in updates.chunks(MAX_TRACKS) {
            self.send_tracks(&frame.stamp, part, Cause::Records(&records), false)?;
        }
        self.send_tracks(&frame.stamp, &[], Cause::Records(&[]), true)?;
        self.send_plan(Some(frame.stamp))?;
        if let Some(end) = frame.end {
            self.counters.add_latency_ns(clock::monotonic_ns() - end.taken_ns);
        }
        Ok(())
    }

    fn send_tracks(
        &self,
        stamp: &FrameStamp,
        updates: &[Update],
        cause: Cause<'_>,
        is_last: bool,
    ) -> anyhow::Result<()> {
        let now_ns = clock::monotonic_ns();
        let tracks: Vec<Track> = updates
            .iter()
            .map(|(target, known)| {
                let body = &self.swarm.neighbours()[*target].body;
                let track = message::track(*target, known, body, &self.observer_from_camera);
                let latency = message::latency(self.flow, stamp, cause, body, now_ns);
                Track { latency, ..track }
            })
            .collect();
        let header =
            TrackHeader { stamp: *stamp, generation: self.generation, is_last: u32::from(is_last) };
        Ok(self.tracks.send(header, &tracks)?)
    }

    fn send_plan(&mut self, after: Option<FrameStamp>) -> anyhow::Result<()> {
        let (plan, predictions) = self.swarm.plan();
        let reference_ns = predictions
            .values()
            .next()
            .map_or(0, |prediction| (prediction.stamp_s * 1e9).round() as i64);
        let views = message::planned_views(&plan, &predictions, reference_ns, |target| {
            self.swarm.needs_no_markers(target)
        });
        self.plan_id += 1;
        self.assembly.planned(self.plan_id);
        let purposes =
            plan.views.iter().zip(0..).map(|(view, index)| (index, view.purpose)).collect();
        self.remembered.insert(self.plan_id, (purposes, plan.stop_rule));
        while self.remembered.len() > REMEMBERED_PLANS {
            self.remembered.pop_first();
        }
        let header = PlanHeader {
            after: after.unwrap_or_default(),
            plan_id: self.plan_id,
            made_ns: clock::monotonic_ns(),
            has_after: u32::from(after.is_some()),
            generation: self.generation,
            stop_rule: message::stop_rule(plan.stop_rule).code(),
            mode: mode_code(self.mode).code(),
            view_budget: plan.view_budget as u32,
            reserved: 0,
        };
        self.plans.send(header, &views).context("the plan for the next frame")
    }
}
