#![allow(clippy::unwrap_used, clippy::expect_used)]

use mavlink::dialects::development::{HEARTBEAT_DATA, TARGET_RELATIVE_DATA};

use super::*;
use crate::neighbour::tests::neighbour;

const MS: i64 = 1_000_000;
const UTC: i64 = 1_700_000_000_000_000_000;
const OURS: MavHeader = MavHeader { system_id: 7, component_id: 1, sequence: 0 };

fn core(change: impl FnOnce(&mut Autopilot)) -> Core {
    let mut settings =
        Autopilot { system_id: 7, target: Some("kite".into()), ..Default::default() };
    change(&mut settings);
    Core::new(settings, UTC)
}

/// What is sent in a time, at steps of a millisecond, and what `step` does before each.
fn run(
    core: &mut Core,
    from_ms: i64,
    to_ms: i64,
    mut step: impl FnMut(&mut Core, i64),
) -> Vec<Outgoing> {
    let mut sent = Vec::new();
    for now_ms in from_ms..to_ms {
        step(core, now_ms);
        if core.next_due_ns(now_ms * MS) <= now_ms * MS {
            let due = core.due(now_ms * MS);
            assert!(!due.is_empty(), "woken for nothing at {now_ms} ms");
            sent.extend(due);
        } else {
            assert!(core.due(now_ms * MS).is_empty(), "something was due at {now_ms} ms");
        }
    }
    sent
}

fn targets(sent: &[Outgoing]) -> Vec<TARGET_RELATIVE_DATA> {
    let of_target = |message: &Outgoing| match message {
        Outgoing::Target(target) => Some(target.clone()),
        _ => None,
    };
    sent.iter().filter_map(of_target).collect()
}

fn obstacles(sent: &[Outgoing]) -> Vec<(u32, u16)> {
    let of_obstacle = |message: &Outgoing| match message {
        Outgoing::Obstacle(obstacle) => Some((obstacle.time_boot_ms, obstacle.obstacle_id)),
        _ => None,
    };
    sent.iter().filter_map(of_obstacle).collect()
}

fn see(core: &mut Core, name: &str, now_ms: i64) {
    core.on_neighbour(&neighbour(name, now_ms * MS), now_ms * MS).unwrap();
}

/// Answers our question for the time as an autopilot does that started `started_ms` after this
/// machine.
fn answer(core: &mut Core, sent: &[Outgoing], now_ms: i64, started_ms: i64) {
    for message in sent {
        if let Outgoing::Timesync(time) = message
            && time.tc1 == 0
        {
            let tc1 = (now_ms - started_ms) * MS;
            let answer = TIMESYNC_DATA { tc1, target_component: 191, ..time.clone() };
            assert!(core.on_message(OURS, &MavMessage::TIMESYNC(answer), now_ms * MS));
        }
    }
}

#[test]
fn rates_are_kept_and_nothing_is_sent_twice() {
    let mut core = core(|settings| {
        (settings.target_hz, settings.obstacles_hz, settings.odometry_hz) = (20.0, 10.0, 0.0);
    });
    // Two neighbours, 50 frames a second for 20 s.
    let sent = run(&mut core, 1000, 21_000, |core, now_ms| {
        if now_ms % 20 == 0 {
            see(core, "kite", now_ms);
            see(core, "swift", now_ms);
        }
    });
    let found = targets(&sent);
    assert!((395..=402).contains(&found.len()), "{}", found.len());
    let mut times: Vec<u64> = found.iter().map(|target| target.timestamp).collect();
    times.dedup();
    assert_eq!(times.len(), found.len(), "each once");
    let found = obstacles(&sent);
    assert!((390..=404).contains(&found.len()), "two each: {}", found.len());
    let heartbeats = sent.iter().filter(|sent| matches!(sent, Outgoing::Heartbeat(_))).count();
    assert!((20..=21).contains(&heartbeats), "{heartbeats}");
}

#[test]
fn frames_that_come_seldom_are_not_repeated_and_rates_of_zero_send_nothing() {
    let seldom = |core: &mut Core, now_ms: i64| {
        if now_ms % 500 == 0 {
            see(core, "kite", now_ms);
        }
    };
    let sent = run(&mut core(|_| {}), 0, 5000, seldom);
    assert_eq!((targets(&sent).len(), obstacles(&sent).len()), (10, 10));
    let mut silent = core(|s| (s.target_hz, s.obstacles_hz, s.odometry_hz) = (0.0, 0.0, 0.0));
    let sent = run(&mut silent, 0, 5000, seldom);
    assert_eq!((targets(&sent).len(), obstacles(&sent).len()), (0, 0));
    let mut no_target = core(|settings| settings.target = None);
    assert!(targets(&run(&mut no_target, 0, 5000, seldom)).is_empty());
}

#[test]
fn who_is_gone_is_no_obstacle_any_more() {
    let mut core = core(|_| {});
    let sent = run(&mut core, 0, 2000, |core, now_ms| {
        if now_ms % 40 == 0 {
            see(core, "kite", now_ms);
            // It is lost at one second, and the third is seen no more since 0.6 s.
            if now_ms < 1000 {
                see(core, "swift", now_ms);
            } else {
                let lost = NeighbourState { is_lost: true, ..neighbour("swift", now_ms * MS) };
                core.on_neighbour(&lost, now_ms * MS).unwrap();
            }
            if now_ms < 600 {
                see(core, "robin", now_ms);
            }
        }
    });
    let last_of = |id: u16| {
        obstacles(&sent).iter().filter(|(_, found)| *found == id).map(|(ms, _)| *ms).max().unwrap()
    };
    assert!(last_of(0) > 1900 && last_of(1) < 1000);
    // Known for half a second more.
    assert!((1000..1100).contains(&last_of(2)), "{}", last_of(2));
}

#[test]
fn those_that_are_seen_together_have_one_time_and_each_set_another() {
    let mut core = core(|_| {});
    let sent = run(&mut core, 0, 1000, |core, now_ms| {
        if now_ms % 100 == 0 {
            see(core, "kite", now_ms);
        }
        // Another frame's, known late: the newest exposure is the same as before.
        if now_ms % 100 == 70 {
            see(core, "swift", now_ms - 90);
        }
    });
    let found = obstacles(&sent);
    let mut sets = found.clone();
    sets.dedup_by_key(|(ms, _)| *ms);
    for set in sets.iter().map(|(ms, _)| ms) {
        let ids: Vec<_> = found.iter().filter(|(ms, _)| ms == set).map(|(_, id)| *id).collect();
        assert!(ids == [0] || ids == [0, 1] || ids == [1, 0], "{set}: {ids:?}");
    }
    assert!(sets.len() >= 10 && found.len() > sets.len());
}

#[test]
fn who_is_out_of_range_is_no_obstacle() {
    let mut core = core(|settings| settings.obstacle_range_m = [1.0, 10.0]);
    for (name, x) in [("near", 0.1), ("far", 11.0), ("kite", 5.0)] {
        let mut state = neighbour(name, 0);
        state.observer_from_target.translation.vector = [x, 0.0, 0.0].into();
        core.on_neighbour(&state, 0).unwrap();
    }
    assert_eq!(obstacles(&core.due(0)), [(0, 2)]);
}

#[test]
fn times_are_the_autopilots_once_its_clock_is_known_and_ours_before() {
    let mut core = core(|_| {});
    see(&mut core, "kite", 60_000);
    let sent = core.due(60_000 * MS);
    assert_eq!(obstacles(&sent), [(60_000, 0)]);
    let mut last = sent;
    for step in 1..10 {
        let now_ms = 60_000 + step * 200;
        answer(&mut core, &last, now_ms - 199, 50_000);
        last = core.due(now_ms * MS);
    }
    let offset = core.time_offset(62_000 * MS).unwrap();
    assert!((offset.autopilot_less_monotonic_ns + 50_000 * MS).abs() <= offset.bound_ns);
    see(&mut core, "kite", 62_000);
    let sent = core.due(62_000 * MS);
    let [(found_ms, 0)] = obstacles(&sent)[..] else { panic!("{sent:?}") };
    assert!(found_ms.abs_diff(12_000) <= 1, "{found_ms}");
    // The target's time stays that of our clock: the autopilot turns it into its own.
    assert_eq!(targets(&sent)[0].timestamp, ((UTC + 62_000 * MS) / 1000) as u64);
}

#[test]
fn questions_for_our_time_are_answered_and_others_questions_are_not() {
    let mut core = core(|settings| settings.odometry_hz = 0.0);
    core.due(0);
    let question = |target_system, target_component| {
        let question = TIMESYNC_DATA { tc1: 0, ts1: 1234, target_system, target_component };
        MavMessage::TIMESYNC(question)
    };
    core.on_message(OURS, &question(0, 0), MS);
    core.on_message(OURS, &question(7, 191), MS);
    core.on_message(OURS, &question(7, 190), MS);
    core.on_message(MavHeader { component_id: 190, ..OURS }, &question(0, 0), MS);
    core.on_message(MavHeader { system_id: 8, ..OURS }, &question(0, 0), MS);
    assert_eq!(core.next_due_ns(2 * MS), 2 * MS);
    let wanted = Outgoing::Timesync(TIMESYNC_DATA {
        tc1: UTC + 2 * MS,
        ts1: 1234,
        target_system: 7,
        target_component: 1,
    });
    assert_eq!(core.due(2 * MS), [wanted.clone(), wanted]);
    // They do not pile up.
    for _ in 0..1000 {
        core.on_message(OURS, &question(0, 0), 3 * MS);
    }
    assert_eq!(core.due(3 * MS).len(), MAX_QUESTIONS);
}

#[test]
fn motion_is_asked_for_where_it_does_not_come() {
    let mut core = core(|_| {});
    let asked = |sent: &[Outgoing]| -> Vec<f32> {
        let of_command = |message: &Outgoing| match message {
            Outgoing::Command(command) => Some(command.param1),
            _ => None,
        };
        sent.iter().filter_map(of_command).collect()
    };
    assert!(asked(&run(&mut core, 0, 3000, |_, _| {})).is_empty(), "nobody is there");
    let beat = MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT);
    let sent = run(&mut core, 3000, 4000, |core, now_ms| {
        core.on_message(OURS, &beat, now_ms * MS);
    });
    assert_eq!(asked(&sent), [331.0, 32.0, 31.0]);
    // Somebody else has asked for the attitude; then odometry comes, which says all.
    let attitude = MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA::DEFAULT);
    let sent = run(&mut core, 4000, 6000, |core, now_ms| {
        core.on_message(OURS, &attitude, now_ms * MS);
    });
    assert_eq!(asked(&sent), [331.0, 32.0]);
    let odometry = MavMessage::ODOMETRY(ODOMETRY_DATA::DEFAULT);
    let sent = run(&mut core, 6000, 12_000, |core, now_ms| {
        core.on_message(OURS, &odometry, now_ms * MS);
    });
    assert!(asked(&sent).is_empty());
}

#[test]
fn another_systems_autopilot_is_named_until_ours_is_heard() {
    let mut core = core(|_| {});
    let beat = MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT);
    assert!(!core.on_message(MavHeader { component_id: 154, ..OURS }, &beat, 0), "a gimbal");
    assert_eq!(core.other_system(), None);
    assert!(!core.on_message(MavHeader { system_id: 1, ..OURS }, &beat, 0));
    assert_eq!(core.other_system(), Some(1));
    assert!(core.on_message(OURS, &beat, 0));
    assert_eq!(core.other_system(), None);
    assert!(core.is_heard(MS) && !core.is_heard(4000 * MS));
}
