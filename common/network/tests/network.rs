//! Two and more real sessions on the loopback interface.
//!
//! Nothing here waits for a fixed time: a test waits for what must happen, and its watchdog fails
//! it when that does not.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::{
    collections::BTreeSet,
    net::TcpListener,
    sync::atomic::Ordering::SeqCst,
    thread,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use flockeye_contract::{
    MeasuredBy, TrackState,
    wire::{
        FRAME_SCHEMA, FrameReport, MAX_FRAME_REPORT_BYTES, Sighting, TargetReport, alive_key,
        frame_key,
    },
};
use flockeye_network::{
    LatestSighting, Listener, Network, NetworkError, NetworkMode, NetworkParameters,
};
use flockeye_require::loopback::{Relay, WATCHDOG, free_port, tcp, until, watched};
use zenoh::{
    Wait,
    qos::{CongestionControl, Priority, Reliability},
};

const SWARM: &str = "test";
fn parameters(observer: &str, listen: &[u16], connect: &[u16]) -> NetworkParameters {
    NetworkParameters {
        swarm: SWARM.into(),
        observer: observer.into(),
        listen: listen.iter().copied().map(tcp).collect(),
        connect: connect.iter().copied().map(tcp).collect(),
        ..Default::default()
    }
}

fn open(observer: &str, listen: &[u16], connect: &[u16]) -> Network {
    Network::open(&parameters(observer, listen, connect)).unwrap()
}

/// A session that is not ours.
fn foreign(connect: u16) -> zenoh::Session {
    let config = format!(
        r#"{{ mode: "peer", listen: {{ endpoints: [] }}, connect: {{ endpoints: ["{}"] }},
             scouting: {{ multicast: {{ enabled: false }} }} }}"#,
        tcp(connect)
    );
    zenoh::open(zenoh::Config::from_json5(&config).unwrap()).wait().unwrap()
}

fn now_utc_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    i64::try_from(since.as_nanos()).unwrap()
}

fn target(name: &str) -> TargetReport {
    TargetReport {
        name: name.into(),
        state: TrackState::Confirmed,
        measured_by: MeasuredBy::Decoded,
        markers: 3,
        unseen_s: 0.0,
        position: [1.0, -2.0, 0.5],
        orientation: [0.0, 0.0, 0.0, 1.0],
        covariance: std::array::from_fn(|k| k as f64 / 1e3),
        linear_velocity: [0.1, 0.0, 0.0],
        angular_velocity: [0.0, 0.0, 0.2],
        measured: None,
        predicted: None,
        rival: None,
        degenerate: None,
    }
}

/// A frame in which one target is seen.
fn report(observer: &str, name: &str, frame: u64) -> FrameReport {
    FrameReport {
        schema: FRAME_SCHEMA.into(),
        observer: observer.into(),
        frame,
        epoch: 1,
        stamp_utc_ns: now_utc_ns(),
        clock_synchronised: false,
        stream_s: 0.5,
        latency_ms: 20.0,
        odometry: None,
        clocks: Default::default(),
        targets: vec![target(name)],
    }
}

fn sighting(report: FrameReport) -> Sighting {
    report.sightings().next().expect("it has a target")
}

fn received(listener: &Listener, observer: &str, target: &str) -> Option<LatestSighting> {
    listener.snapshot().observers.get(observer)?.targets.get(target).cloned()
}

fn is_alive(listener: &Listener, observer: &str) -> bool {
    listener.snapshot().observers.get(observer).is_some_and(|peer| peer.alive)
}

/// The report as it was put in: the time it waited to be sent belongs to its latency.
fn as_put_in(mut arrived: Sighting, latency_ms: f64) -> Sighting {
    assert!(arrived.latency_ms >= latency_ms, "{} ms", arrived.latency_ms);
    arrived.latency_ms = latency_ms;
    arrived
}

#[test]
fn a_report_arrives_as_it_was_sent() {
    watched(|| {
        let port = free_port();
        let (wren, robin) = (open("wren", &[port], &[]), open("robin", &[], &[port]));
        let (reporter, listener) = (wren.reporter().unwrap(), robin.listener().unwrap());
        let stream = listener.stream(8);
        until(|| is_alive(&listener, "wren").then_some(()));

        let sent = report("wren", "kite", 7);
        reporter.report(sent.clone()).unwrap();
        let kite = until(|| received(&listener, "wren", "kite"));
        assert_eq!(as_put_in(kite.report.clone(), sent.latency_ms), sighting(sent));
        assert!(kite.age(kite.arrived) >= Duration::from_millis(20));
        let heard = stream.recv_timeout(WATCHDOG).expect("streamed too");
        assert_eq!(heard.arrived_monotonic_ns, kite.arrived_monotonic_ns);
        assert_eq!(heard.report, kite.report);
        assert_eq!(
            until(|| Some(reporter.counters()).filter(|counters| counters.sent == 1)).failed,
            0
        );
        drop(listener);
        assert!(stream.recv_timeout(WATCHDOG).is_none() && stream.is_over());
    });
}

#[test]
fn reports_go_out_first_and_may_be_dropped() {
    watched(|| {
        let port = free_port();
        let wren = open("wren", &[port], &[]);
        let session = foreign(port);
        let samples = session.declare_subscriber(frame_key(SWARM, "*")).wait().unwrap();
        let reporter = wren.reporter().unwrap();
        // The subscription takes its time to reach the reporter: say it until it is heard.
        let sample = until(|| {
            reporter.report(report("wren", "kite", 1)).unwrap();
            samples.try_recv().unwrap()
        });
        assert_eq!(sample.key_expr().as_str(), "flockeye/test/wren/sees");
        assert_eq!(sample.encoding().to_string(), "application/json");
        assert_eq!(sample.priority(), Priority::RealTime);
        assert_eq!(sample.congestion_control(), CongestionControl::Drop);
        assert_eq!(sample.reliability(), Reliability::BestEffort);
        assert!(sample.express());
        FrameReport::from_json(&sample.payload().to_bytes()).unwrap();
    });
}

#[test]
fn a_late_peer_sees_the_last_pose_and_its_true_age() {
    watched(|| {
        let port = free_port();
        let wren = open("wren", &[port], &[]);
        let reporter = wren.reporter().unwrap();
        reporter.report(report("wren", "kite", 1)).unwrap();
        let mut last = report("wren", "kite", 2);
        last.targets.push(TargetReport { state: TrackState::Lost, ..target("swift") });
        reporter.report(last).unwrap();
        // Neither of the two is on its way any more.
        until(|| {
            let counters = reporter.counters();
            (counters.sent + counters.overwritten == 2).then_some(())
        });

        let robin = open("robin", &[], &[port]);
        let listener = robin.listener().unwrap();
        let kite = until(|| received(&listener, "wren", "kite"));
        assert_eq!((kite.report.frame, kite.count), (2, 1));
        assert!(kite.report.latency_ms > 20.0, "the time it lay there belongs to its age");
        let targets: BTreeSet<_> =
            listener.snapshot().observers["wren"].targets.keys().cloned().collect();
        assert_eq!(targets, BTreeSet::from(["kite".to_owned()]), "a lost track is no last pose");
    });
}

#[test]
fn a_reporter_that_comes_later_is_asked_for_its_last_pose() {
    watched(|| {
        let port = free_port();
        let robin = open("robin", &[], &[port]);
        let listener = robin.listener().unwrap();
        let wren = open("wren", &[port], &[]);
        let reporter = wren.reporter().unwrap();
        reporter.report(report("wren", "kite", 1)).unwrap();
        assert_eq!(until(|| received(&listener, "wren", "kite")).report.frame, 1);
    });
}

#[test]
fn liveliness_follows_the_reporter() {
    watched(|| {
        let port = free_port();
        let (wren, robin) = (open("wren", &[port], &[]), open("robin", &[], &[port]));
        let listener = robin.listener().unwrap();
        for _ in 0..2 {
            let reporter = wren.reporter().unwrap();
            until(|| is_alive(&listener, "wren").then_some(()));
            drop(reporter);
            until(|| (!is_alive(&listener, "wren")).then_some(()));
        }
        // A session that ends takes its reporter's token with it.
        let reporter = wren.reporter().unwrap();
        until(|| is_alive(&listener, "wren").then_some(()));
        drop((reporter, wren));
        until(|| (!is_alive(&listener, "wren")).then_some(()));
    });
}

#[test]
fn hostile_messages_are_counted_and_survived() {
    watched(|| {
        let port = free_port();
        let robin = open("robin", &[port], &[]);
        let listener = robin.listener().unwrap();
        let session = foreign(port);
        let alive = |observer: &str| {
            session.liveliness().declare_token(alive_key(SWARM, observer)).wait().unwrap()
        };
        let _tokens = ["wren", "crow"].map(alive);
        for observer in ["wren", "crow"] {
            until(|| listener.snapshot().observers.get(observer)?.is_heard.then_some(()));
        }
        let good = report("wren", "kite", 5);
        let other_schema = FrameReport { schema: "flockeye.pose/1".into(), ..good.clone() };
        let twice = FrameReport { targets: vec![target("kite"), target("kite")], ..good.clone() };
        let key = |observer| frame_key(SWARM, observer);
        let bad = [
            (key("wren"), b"\xff\xfe{".to_vec()),
            (key("wren"), vec![b' '; MAX_FRAME_REPORT_BYTES + 1]),
            (key("wren"), vec![b'['; 50_000]),
            (key("wren"), Vec::new()),
            (key("wren"), other_schema.to_json().unwrap()),
            (key("wren"), twice.to_json().unwrap()),
            (key("crow"), good.to_json().unwrap()),
            (key("no name"), good.to_json().unwrap()),
        ];
        for (key, payload) in bad {
            session.put(key, payload).wait().unwrap();
        }
        let _no_name = alive("no name");
        session.put(key("wren"), good.to_json().unwrap()).wait().unwrap();

        let kite = until(|| received(&listener, "wren", "kite"));
        assert_eq!((kite.report, kite.count), (sighting(good), 1));
        let peers = until(|| Some(listener.snapshot()).filter(|peers| peers.refused == 2));
        assert_eq!(peers.observers["wren"].refused.malformed, 6);
        assert_eq!(peers.observers["crow"].refused.malformed, 1);
        assert!(peers.observers["crow"].targets.is_empty());
        assert_eq!(peers.observers["wren"].targets.len(), 1);
    });
}

#[test]
fn what_nobody_could_read_is_not_sent() {
    watched(|| {
        let wren = open("wren", &[0], &[]);
        let reporter = wren.reporter().unwrap();
        let refused = |report: FrameReport| reporter.report(report).expect_err("refused");
        assert!(matches!(refused(report("crow", "kite", 1)), NetworkError::Name { .. }));
        assert!(matches!(refused(report("wren", "a/b", 1)), NetworkError::Report(_)));
        let mut nowhere = report("wren", "kite", 1);
        nowhere.targets[0].position[1] = f64::NAN;
        assert!(matches!(refused(nowhere), NetworkError::Report(_)));
        assert_eq!((reporter.counters().failed, reporter.counters().sent), (3, 0));
    });
}

#[test]
fn a_port_that_is_taken_is_an_error_that_names_it() {
    watched(|| {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = taken.local_addr().unwrap().port();
        let error = Network::open(&parameters("wren", &[port], &[])).expect_err("taken");
        assert!(error.to_string().contains(&tcp(port)), "{error}");
    });
}

/// Neither a port where nobody listens nor one where somebody accepts and then says nothing keeps
/// a drone from starting, reporting and ending.
#[test]
fn neighbours_out_of_reach_hold_nothing_up() {
    watched(|| {
        let mute = TcpListener::bind("127.0.0.1:0").unwrap();
        let mute_port = mute.local_addr().unwrap().port();
        for mode in [NetworkMode::Peer, NetworkMode::Client, NetworkMode::Router] {
            let parameters =
                NetworkParameters { mode, ..parameters("wren", &[0], &[free_port(), mute_port]) };
            let wren = Network::open(&parameters).unwrap();
            assert_eq!(wren.is_open(), mode != NetworkMode::Client);
            let (reporter, _listener) = (wren.reporter().unwrap(), wren.listener().unwrap());
            for frame in 1..=100 {
                reporter.report(report("wren", "kite", frame)).unwrap();
            }
            let counters = until(|| {
                let counters = reporter.counters();
                let expected = if wren.is_open() { 100 } else { 99 };
                (counters.sent + counters.overwritten == expected).then_some(counters)
            });
            assert_eq!(counters.failed, 0);
        }
    });
}

#[test]
fn a_client_finds_its_router_when_it_comes_up() {
    watched(|| {
        let nobody = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = nobody.local_addr().unwrap().port();
        let client = |name| {
            let parameters =
                NetworkParameters { mode: NetworkMode::Client, ..parameters(name, &[], &[port]) };
            Network::open(&parameters).unwrap()
        };
        let (wren, robin) = (client("wren"), client("robin"));
        let (reporter, listener) = (wren.reporter().unwrap(), robin.listener().unwrap());
        reporter.report(report("wren", "kite", 1)).unwrap();
        assert!(!wren.is_open() && !robin.is_open());
        // Both have tried by now, or one of them twice.
        (0..2).for_each(|_| drop(nobody.accept().unwrap()));
        drop(nobody);

        let parameters =
            NetworkParameters { mode: NetworkMode::Router, ..parameters("mast", &[port], &[]) };
        let _router = Network::open(&parameters).unwrap();
        assert_eq!(until(|| received(&listener, "wren", "kite")).report.frame, 1);
        until(|| is_alive(&listener, "wren").then_some(()));
        assert!(wren.is_open() && robin.is_open());
    });
}

#[test]
fn a_stalled_neighbour_costs_neither_the_reporter_nor_the_others() {
    watched(|| {
        let port = free_port();
        // A link that is silent for long, and not given up: the worst for who writes to it.
        let patient = |name, listen: &[u16], connect: &[u16]| {
            let parameters =
                NetworkParameters { lease_ms: 60_000, ..parameters(name, listen, connect) };
            Network::open(&parameters).unwrap()
        };
        let wren = patient("wren", &[port], &[]);
        let relay = Relay::start(port);
        let (far, near) = (patient("far", &[], &[relay.port]), patient("near", &[], &[port]));
        let (far_ear, near_ear) = (far.listener().unwrap(), near.listener().unwrap());
        let reporter = wren.reporter().unwrap();
        until(|| (is_alive(&far_ear, "wren") && is_alive(&near_ear, "wren")).then_some(()));

        let mut number = 0;
        let mut say = || {
            number += 1;
            reporter.report(report("wren", "kite", number)).unwrap();
            number
        };
        relay.stalled.store(true, SeqCst);
        // More than a megabyte: more than all the buffers on the way to the stalled one hold.
        let mut put_in = 0;
        while reporter.counters().sent < 2_000 {
            put_in = say();
            // Leaves the lock to the other side.
            thread::sleep(Duration::from_micros(100));
        }
        let counters = until(|| {
            let counters = reporter.counters();
            (counters.sent + counters.overwritten == put_in).then_some(counters)
        });
        assert_eq!(counters.failed, 0);
        // The other link works while this one stands still.
        let mut reaches = |ear: &Listener| {
            let mark = say();
            until(|| {
                say();
                received(ear, "wren", "kite").filter(|kite| kite.report.frame > mark)
            })
        };
        let near_kite = reaches(&near_ear);
        assert!(received(&far_ear, "wren", "kite").is_none_or(|kite| kite.report.frame < put_in));

        relay.stalled.store(false, SeqCst);
        let far_kite = reaches(&far_ear);
        // What could not go out was dropped, not kept for later.
        assert!(far_kite.count < near_kite.count / 2, "{} {}", far_kite.count, near_kite.count);
    });
}
