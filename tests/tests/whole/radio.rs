//! Drones over a radio that loses, delays and cuts ([`flockeye_tests::drone`]).

use std::time::{Duration, Instant};

use flockeye_tests::air::{Air, Weather};
use flockeye_tests::drone::{
    Drone, Links, PERIOD_MS, cut, end, endpoint, name, pair, start, wait_until,
};
use flockeye_tests::{Beside, Flight, flockeye, succeeds, unique};

/// A machine that does other things takes longer than what a drone may take. It is printed how long
/// it took.
const SLOW: u32 = 3;

/// Eight drones hear each other soon, notice who leaves, and hear it soon when it is back.
fn eight_find_each_other(air: &Air, links: Links) {
    let (swarm, count) = (unique("air"), 8);
    let drones: Vec<Drone> =
        (0..count).map(|station| start(air, station, count, &swarm, links)).collect();
    let limit = Duration::from_secs(3) * SLOW;
    let since = Instant::now();
    let took = wait_until("all are heard by all", &drones, || {
        drones.iter().all(|drone| drone.ear.heard_since(since) == count - 1)
    });
    assert!(took < limit, "{took:?}");
    let gone = name(3);
    let mut look_on = air.at(0, &flockeye());
    look_on.args(["peers", "--connect", &links.hub()]);
    look_on.args(["--set", &format!("observer.swarm={swarm}")]);
    let mut look_on = Flight::launch(&unique("look"), look_on);
    look_on.wait_for(&gone);
    air.set_away(3, true);
    let left = Instant::now();
    look_on.wait_for("gone");
    // Two leases, and a second until it is printed.
    assert!(left.elapsed() < Duration::from_secs(7) * SLOW, "{:?}", left.elapsed());
    println!("it is known to be gone: {:.2} s", left.elapsed().as_secs_f64());
    air.set_away(3, false);
    let back = Instant::now();
    let others = || drones.iter().enumerate().filter(|(station, _)| *station != 3);
    let took = wait_until("it is heard by all again", &drones, || {
        others().all(|(_, drone)| drone.ear.last_of(&gone).is_some_and(|at| at >= back))
            && drones[3].ear.heard_since(back) == count - 1
    });
    assert!(took < limit, "{took:?}");
    drop(look_on);
    end(drones);
}

#[test]
fn eight_drones_find_each_other_directly() {
    let Some(air) = Air::between(8) else { return };
    eight_find_each_other(&air, Links::Direct);
}

#[test]
fn eight_drones_find_each_other_through_a_router() {
    let Some(air) = Air::between(9) else { return };
    let mut router = air.at(8, &flockeye().with_file_name("zenoh-router"));
    router.arg(endpoint(8));
    let _router = Beside::start(router);
    eight_find_each_other(&air, Links::Router(8));
}

/// The drones have said where their neighbours are, and say no more: what is heard is the last
/// pose.
#[test]
fn who_joins_late_has_the_last_pose_soon() {
    let Some(air) = Air::between(3) else { return };
    let swarm = unique("late");
    let drones = pair(&air, &swarm);
    for drone in &drones {
        succeeds(&["stop", "fusion", "--instance", drone.flight.instance.name()]);
    }
    let mut join = air.at(2, &flockeye());
    join.args(["peers", "--json", "--connect", &endpoint(0)]);
    join.args(["--set", &format!("observer.swarm={swarm}")]);
    let joined = Instant::now();
    let mut join = Flight::launch(&unique("join"), join);
    join.wait_for("\"target\":\"d1\"");
    let took = joined.elapsed();
    println!("the last pose is there: {:.2} s after the start of the program", took.as_secs_f64());
    assert!(took < Duration::from_secs(1) * SLOW, "{took:?}");
    drop(join);
    end(drones);
}

/// `radio-cuts` counts more of them, and longer ones.
#[test]
fn a_bad_radio_and_a_cut_one_hold_nobody_up_and_poses_flow_again() {
    let Some(air) = Air::between(2) else { return };
    let drones = pair(&air, &unique("cut"));
    for after in [Weather::CLEAR, Weather::BAD] {
        let recovery = cut(&air, &drones, Duration::from_secs(8), after);
        let longest = recovery.fusion_pause;
        assert!(recovery.heard_after < Duration::from_secs(8) * SLOW, "{recovery:?}");
        assert!(longest < Duration::from_millis(20 * PERIOD_MS), "fusion was held up: {longest:?}");
    }
    end(drones);
}
