//! Timing of sent messages, and the state from received ones. It has no line, no thread and no
//! clock.

use std::collections::VecDeque;

use flockeye_config::Autopilot;
use mavlink::dialects::development::{
    ATTITUDE_QUATERNION_DATA, LOCAL_POSITION_NED_DATA, MavMessage, ODOMETRY_DATA, TIMESYNC_DATA,
};
use mavlink::{MavHeader, MessageData};

use crate::error::AutopilotError;
use crate::messages::{
    AUTOPILOT, Outgoing, ask_for, heartbeat, obstacle, target, time_answer, time_request,
};
use crate::neighbour::NeighbourState;
use crate::neighbours::Neighbours;
use crate::odometry::{OdometryHistory, OdometryState};
use crate::pace::Pace;
use crate::timesync::{TimeOffset, Timesync};

/// Maximum age of a neighbour's pose, nanoseconds: an older pose is too inaccurate for an obstacle.
const MAX_AGE_NS: i64 = 500_000_000;
/// Time without a message after which the autopilot is requested to send it, nanoseconds.
const MISSED_NS: i64 = 2_000_000_000;
/// Maximum time requests of the autopilot that wait for their answer.
const MAX_QUESTIONS: usize = 8;

/// The messages with the drone's motion; the first contains all of it.
const MOTION: [u32; 3] =
    [ODOMETRY_DATA::ID, LOCAL_POSITION_NED_DATA::ID, ATTITUDE_QUATERNION_DATA::ID];

/// The state of the line: it takes neighbours and received messages, and returns the messages to
/// send.
#[derive(Debug)]
pub struct Core {
    settings: Autopilot,
    utc_less_monotonic_ns: i64,
    neighbours: Neighbours,
    timesync: Timesync,
    odometry: OdometryHistory,
    /// Time requests of the autopilot that are not answered yet.
    questions: VecDeque<TIMESYNC_DATA>,
    time_due_ns: i64,
    heartbeats: Pace,
    targets: Pace,
    obstacles: Pace,
    asking: Pace,
    /// The time of the obstacles that were sent last, on the autopilot's clock, milliseconds.
    obstacles_ms: i64,
    heard_ns: Option<i64>,
    /// Time of the last message of each of [`MOTION`].
    moved_ns: [Option<i64>; 3],
    other_system: Option<u32>,
}

impl Core {
    /// A core with settings that the caller has checked. Messages have UTC by this fixed offset from
    /// CLOCK_MONOTONIC. Such a clock never jumps, even if the system's clock is set. So a receiver
    /// that has synchronised with it need not do so again.
    pub fn new(settings: Autopilot, utc_less_monotonic_ns: i64) -> Self {
        Self {
            utc_less_monotonic_ns,
            neighbours: Neighbours::new(MAX_AGE_NS),
            timesync: Timesync::default(),
            odometry: OdometryHistory::default(),
            questions: VecDeque::new(),
            time_due_ns: i64::MIN,
            heartbeats: Pace::from_hz(1.0),
            targets: Pace::from_hz(if settings.target.is_some() {
                settings.target_hz
            } else {
                0.0
            }),
            obstacles: Pace::from_hz(settings.obstacles_hz),
            asking: Pace::from_hz(if settings.odometry_hz > 0.0 { 0.5 } else { 0.0 }),
            obstacles_ms: i64::MIN,
            heard_ns: None,
            moved_ns: [None; 3],
            other_system: None,
            settings,
        }
    }

    /// Takes the state of a neighbour.
    ///
    /// # Errors
    /// The state is invalid, or there are too many neighbours.
    pub fn on_neighbour(
        &mut self,
        state: &NeighbourState,
        now_ns: i64,
    ) -> Result<(), AutopilotError> {
        self.neighbours.update(state, now_ns)
    }

    /// Takes a message that arrived at `arrived_ns`. Returns whether this vehicle's autopilot sent
    /// it; all others change nothing.
    pub fn on_message(&mut self, sender: MavHeader, message: &MavMessage, arrived_ns: i64) -> bool {
        if sender.component_id != AUTOPILOT {
            return false;
        }
        if sender.system_id != u32::from(self.settings.system_id) {
            self.other_system = Some(sender.system_id);
            return false;
        }
        self.heard_ns = Some(arrived_ns);
        match message {
            MavMessage::TIMESYNC(time) => self.on_time(time, arrived_ns),
            MavMessage::ODOMETRY(_) => self.moved_ns[0] = Some(arrived_ns),
            MavMessage::LOCAL_POSITION_NED(_) => self.moved_ns[1] = Some(arrived_ns),
            MavMessage::ATTITUDE_QUATERNION(_) => self.moved_ns[2] = Some(arrived_ns),
            _ => {}
        }
        let clock = self.timesync.offset(arrived_ns);
        self.odometry.on_message(message, arrived_ns, clock.as_ref());
        true
    }

    fn on_time(&mut self, time: &TIMESYNC_DATA, arrived_ns: i64) {
        let is_for = |wanted: u8, ours: u8| wanted == 0 || wanted == ours;
        let Autopilot { system_id, component_id, .. } = self.settings;
        if !is_for(time.target_system, system_id) || !is_for(time.target_component, component_id) {
            return;
        }
        if time.tc1 == 0 {
            if self.questions.len() == MAX_QUESTIONS {
                self.questions.pop_front();
            }
            self.questions.push_back(time.clone());
        } else if self.timesync.on_answer(time.tc1, time.ts1, arrived_ns) {
            // The autopilot was restarted, so its origin is another.
            self.odometry.restart();
        }
    }

    /// Resets the state after the line was opened again, because another autopilot may be at its
    /// end.
    pub fn on_line(&mut self) {
        self.timesync = Timesync::default();
        self.odometry.restart();
        self.questions.clear();
        self.time_due_ns = i64::MIN;
        self.heard_ns = None;
        self.moved_ns = [None; 3];
    }

    /// Messages to send at `now_ns`, in this order: those that depend on the time come first.
    pub fn due(&mut self, now_ns: i64) -> Vec<Outgoing> {
        let mut due = Vec::new();
        let Autopilot { system_id, obstacle_range_m, .. } = self.settings;
        let time_ns = now_ns.saturating_add(self.utc_less_monotonic_ns);
        due.extend(self.questions.drain(..).map(|question| {
            Outgoing::Timesync(time_answer(&question, system_id, AUTOPILOT, time_ns))
        }));
        if now_ns >= self.time_due_ns {
            self.time_due_ns = now_ns.saturating_add(self.timesync.period_ns());
            self.timesync.on_request(time_ns, now_ns);
            due.push(Outgoing::Timesync(time_request(system_id, time_ns)));
        }
        if self.targets.is_due(now_ns)
            && let Some(name) = &self.settings.target
            && let Some((id, state)) = self.neighbours.take_target(name, now_ns)
        {
            self.targets.sent(now_ns);
            let attitude = self.odometry.enu_from_base_at(state.exposure_monotonic_ns);
            let exposure_utc_ns =
                state.exposure_monotonic_ns.saturating_add(self.utc_less_monotonic_ns);
            due.push(Outgoing::Target(target(id, state, exposure_utc_ns, attitude.as_ref())));
        }
        if self.obstacles.is_due(now_ns) {
            let offset = self.timesync.offset(now_ns);
            let obstacles = self.neighbours.take_obstacles(now_ns);
            let seen_ns = obstacles.iter().map(|(_, state)| state.exposure_monotonic_ns).max();
            if let Some(seen_ns) = seen_ns {
                self.obstacles.sent(now_ns);
                let boot_ns =
                    offset.map_or(seen_ns, |offset| offset.autopilot_from_monotonic(seen_ns));
                let boot_ms = boot_ns.div_euclid(1_000_000);
                // Each message needs another time, or the autopilot would keep obstacles that are
                // gone.
                let is_same = boot_ms == self.obstacles_ms;
                self.obstacles_ms = boot_ms.saturating_add(i64::from(is_same));
                let time_boot_ms = low_bits(self.obstacles_ms);
                let [near_m, far_m] = obstacle_range_m;
                due.extend(
                    obstacles
                        .into_iter()
                        .filter(|(_, state)| (near_m..=far_m).contains(&state.distance_m()))
                        .map(|(id, state)| obstacle(id, state, time_boot_ms, obstacle_range_m))
                        .map(Outgoing::Obstacle),
                );
            }
        }
        if self.heartbeats.is_due(now_ns) {
            self.heartbeats.sent(now_ns);
            due.push(Outgoing::Heartbeat(heartbeat()));
        }
        if self.asking.is_due(now_ns) && self.is_heard(now_ns) {
            self.asking.sent(now_ns);
            let hz = self.settings.odometry_hz;
            let missed = self.missed(now_ns);
            due.extend(missed.map(|id| Outgoing::Command(ask_for(system_id, id, hz))));
        }
        due
    }

    /// The messages of [`MOTION`] that do not arrive. Others are not requested, because another
    /// program may have requested them at a higher rate.
    fn missed(&self, now_ns: i64) -> impl Iterator<Item = u32> {
        let comes = self
            .moved_ns
            .map(|last| last.is_some_and(|last_ns| now_ns.saturating_sub(last_ns) < MISSED_NS));
        MOTION
            .into_iter()
            .zip(comes)
            .filter(move |(_, is_here)| !is_here && !comes[0])
            .map(|(id, _)| id)
    }

    /// Time of the next due message, if nothing arrives before.
    pub fn next_due_ns(&self, now_ns: i64) -> i64 {
        if !self.questions.is_empty() {
            return now_ns;
        }
        let target = self.settings.target.as_ref();
        let has_target = target.is_some_and(|name| self.neighbours.has_target(name, now_ns));
        let paces = [
            (true, self.heartbeats),
            (has_target, self.targets),
            (self.neighbours.has_obstacles(now_ns), self.obstacles),
            (self.is_heard(now_ns), self.asking),
        ];
        let due_ns =
            paces.iter().filter(|(has_any, _)| *has_any).filter_map(|(_, pace)| pace.due_ns());
        due_ns.fold(self.time_due_ns, i64::min)
    }

    /// Whether a message of the autopilot arrived within the last seconds.
    pub fn is_heard(&self, now_ns: i64) -> bool {
        let silent_ns = crate::link::SILENT.as_nanos() as i64;
        self.heard_ns.is_some_and(|heard_ns| now_ns.saturating_sub(heard_ns) < silent_ns)
    }

    /// System of another autopilot on the line, where messages of ours are missing.
    pub fn other_system(&self) -> Option<u32> {
        self.other_system.filter(|_| self.heard_ns.is_none())
    }

    /// Offset of the autopilot's clock, where it is known.
    pub fn time_offset(&self, now_ns: i64) -> Option<TimeOffset> {
        self.timesync.offset(now_ns)
    }

    /// The newest estimate of the drone's motion; each is returned once.
    pub fn take_odometry(&mut self) -> Option<OdometryState> {
        self.odometry.take_newest()
    }
}

/// Milliseconds in the message's 32 bits, which start again from 0 after 49 days.
fn low_bits(ms: i64) -> u32 {
    (ms & i64::from(u32::MAX)) as u32
}

#[cfg(test)]
mod tests;
