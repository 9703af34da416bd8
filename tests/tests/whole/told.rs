//! What leaves a pipeline: reports for the swarm, messages of ROS 2, and the autopilot's
//! neighbours.

use std::collections::BTreeSet;
use std::net::{SocketAddr, UdpSocket};
use std::process::Command;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use flockeye_contract::wire::FrameReport;
use flockeye_require::loopback::{free_port, tcp};
use flockeye_tests::{Beside, Flight, WATCHDOG, flockeye, told, unique};
use mavlink::dialects::development::{MavFrame, MavMessage, ODOMETRY_DATA};
use mavlink::{MavHeader, write_v2_msg};
use rustix::process::{Signal, kill_process};
use zenoh::Wait;

/// A pipeline whose fusion says that `kite` is a metre ahead.
fn fly(name: &str, more: &[&str]) -> Flight {
    let told = told::settings(50, &["kite"]);
    let own = ["observer.name=wren", "gateway.listen=[tcp/127.0.0.1:0]"];
    let set: Vec<&str> =
        told.iter().map(String::as_str).chain(own).chain(more.iter().copied()).collect();
    Flight::start(name, &[], &set)
}

fn end(mut flight: Flight) {
    flight.signal(Signal::TERM);
    flight.wait();
    flight.assert_nothing_left();
}

/// Looks until there is something to see.
fn until<T>(flight: &Flight, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(seen) = look() {
            return seen;
        }
        assert!(start.elapsed() < WATCHDOG, "in vain:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A session that is linked with the router or gateway at an endpoint.
fn client_of(endpoint: &str) -> zenoh::Session {
    let config = serde_json::json!({
        "mode": "client",
        "connect": { "endpoints": [endpoint], "timeout_ms": 20_000 },
        "scouting": { "multicast": { "enabled": false } },
    });
    let config = zenoh::Config::from_json5(&config.to_string()).expect("it is a configuration");
    zenoh::open(config).wait().expect("somebody is there")
}

/// The frames that a drone reports to its swarm.
fn reports_of_wren(session: &zenoh::Session) -> Receiver<FrameReport> {
    let (tell, reports) = channel();
    let subscriber = session.declare_subscriber("flockeye/*/wren/sees");
    let callback = move |sample: zenoh::sample::Sample| {
        let payload = sample.payload().to_bytes();
        let report = FrameReport::from_json(&payload).expect("it is a report");
        // A test that has enough listens no more.
        drop(tell.send(report));
    };
    subscriber.callback(callback).background().wait().expect("it is a key");
    reports
}

#[test]
fn nodes_of_ros_2_hear_where_neighbours_are() {
    let router = tcp(free_port());
    let mut command = Command::new(flockeye().with_file_name("zenoh-router"));
    command.arg(&router);
    let _router = Beside::start(command);
    let flight = fly(&unique("ros"), &[&format!("ros2={{connect: [{router}], domain: 7}}")]);
    let session = client_of(&router);
    let (tell, heard) = channel();
    let _subscriber = session
        .declare_subscriber("7/wren/neighbours/kite/pose/**")
        .callback(move |sample| {
            let payload = sample.payload().to_bytes().into_owned();
            // An error is ignored: the receiver ends after one message.
            tell.send((payload, sample.attachment().is_some())).ok();
        })
        .wait()
        .expect("it is a key");
    let (cdr, has_attachment) = until(&flight, || heard.try_recv().ok());
    assert_eq!(cdr[..4], [0, 1, 0, 0], "CDR, little-endian");
    assert!(has_attachment, "sequence, time and identity of the publisher");
    assert!(cdr.windows(4).any(|bytes| bytes == b"wren"), "the frame is the observer's");
    assert!(cdr.windows(8).any(|bytes| bytes == 1.0_f64.to_le_bytes()), "a metre ahead");
    drop(session);
    end(flight);
}

#[test]
fn the_autopilot_is_told_of_its_target_and_of_obstacles() {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port is free");
    socket.set_read_timeout(Some(Duration::from_millis(200))).expect("a time above zero");
    let port = socket.local_addr().expect("it is bound").port();
    let autopilot =
        format!("autopilot={{link: \"udpout:127.0.0.1:{port}\", target: kite, system_id: 9}}");
    let flight = fly(&unique("mav"), &[&autopilot]);
    // HEARTBEAT, TIMESYNC, TARGET_RELATIVE, OBSTACLE_DISTANCE_3D
    let wanted = BTreeSet::from([0, 111, 511, 11037]);
    let mut seen = BTreeSet::new();
    until(&flight, || {
        let mut datagram = [0; 2048];
        let length = socket.recv(&mut datagram).ok()?;
        // MAVLink 2: magic, length, two flags, sequence, system, component, then the message's
        // number.
        if let [0xfd, _, _, _, _, system, component, a, b, c, ..] = datagram[..length] {
            assert_eq!((system, component), (9, 191));
            seen.insert(u32::from_le_bytes([a, b, c, 0]));
        }
        wanted.is_subset(&seen).then_some(())
    });
    end(flight);
}

/// The report of a frame contains the drone's pose by its autopilot.
#[test]
fn the_swarm_hears_the_autopilots_odometry() {
    let (listen, theirs) = (tcp(free_port()), free_udp());
    let link = format!("autopilot.link=udpin:{theirs}");
    let flight = fly(&unique("odom"), &[&link, &format!("gateway.listen=[{listen}]")]);
    let session = client_of(&listen);
    let reports = reports_of_wren(&session);
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port is free");
    let odometry = until(&flight, || {
        let message = MavMessage::ODOMETRY(ODOMETRY_DATA {
            x: 3.0,
            y: 1.0,
            z: -2.0,
            q: [1.0, 0.0, 0.0, 0.0],
            frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
            child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
            ..ODOMETRY_DATA::DEFAULT
        });
        let header = MavHeader { system_id: 1, component_id: 1, sequence: 0 };
        let mut bytes = Vec::new();
        write_v2_msg(&mut bytes, header, &message).expect("it is a message");
        // Nobody is there before the stage has started.
        socket.send_to(&bytes, theirs).ok();
        reports.try_iter().find_map(|report| report.odometry)
    });
    let wanted = [1.0, 3.0, 2.0];
    let off = odometry.position.iter().zip(wanted).map(|(found, wanted)| (found - wanted).abs());
    assert!(off.fold(0.0, f64::max) < 1e-5, "east, north, up: {odometry:?}");
    drop(session);
    end(flight);
}

/// An address of loopback that nobody has.
fn free_udp() -> SocketAddr {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port is free");
    socket.local_addr().expect("it is bound")
}

/// ROS 2 and the autopilot are stages of their own: whoever kills one takes nothing from the swarm.
#[test]
fn the_swarm_does_not_notice_when_ros_2_or_the_autopilot_dies() {
    let listen = tcp(free_port());
    let set = [
        format!("gateway.listen=[{listen}]"),
        format!("ros2.connect=[{}]", tcp(free_port())),
        format!("autopilot.link=udpin:{}", free_udp()),
    ];
    let set: Vec<&str> = set.iter().map(String::as_str).collect();
    let flight = fly(&unique("apart"), &set);
    let session = client_of(&listen);
    let (tell, tokens) = channel();
    let alive = session.liveliness().declare_subscriber("flockeye/*/wren/alive").history(true);
    let callback = move |token: zenoh::sample::Sample| {
        tell.send(token.kind()).ok();
    };
    alive.callback(callback).background().wait().expect("it is a key");
    let reports = reports_of_wren(&session);
    let mut frames = Vec::new();
    let hear = |frames: &mut Vec<u64>| frames.extend(reports.try_iter().map(|one| one.frame));
    until(&flight, || {
        hear(&mut frames);
        (frames.len() > 10).then_some(())
    });
    let gateways = flight.stages("flockeye-gateway");
    for program in ["flockeye-ros2", "flockeye-autopilot"] {
        let old = until(&flight, || flight.stages(program).first().copied());
        kill_process(old, Signal::KILL).expect("it runs");
        until(&flight, || {
            hear(&mut frames);
            flight.stages(program).iter().any(|new| *new != old).then_some(())
        });
        let so_far = frames.len();
        until(&flight, || {
            hear(&mut frames);
            (frames.len() > so_far + 20).then_some(())
        });
    }
    assert_eq!(flight.stages("flockeye-gateway"), gateways, "the gateway flies on");
    let tokens: Vec<_> = tokens.try_iter().collect();
    assert_eq!(tokens, [zenoh::sample::SampleKind::Put], "the link stands");
    frames.dedup();
    assert!(frames.is_sorted());
    // Fusion says 20 frames a second. A busy machine may hold a report up; none is missing.
    let missing: Vec<_> = frames.windows(2).filter(|pair| pair[1] > pair[0] + 1).collect();
    assert!(missing.len() <= 2, "{missing:?}");
    drop(session);
    end(flight);
}

#[test]
fn the_swarm_is_told_of_as_many_frames_as_asked() {
    let listen = tcp(free_port());
    let flight =
        fly(&unique("pace"), &["gateway.report_hz=5", &format!("gateway.listen=[{listen}]")]);
    let session = client_of(&listen);
    let reports = reports_of_wren(&session);
    let mut frames = Vec::new();
    until(&flight, || {
        frames.extend(reports.try_iter().map(|report| report.frame));
        (frames.len() > 20).then_some(())
    });
    frames.dedup();
    // Fusion says 20 frames a second: every fourth is reported, whatever the machine leaves out.
    let span = frames.last().expect("there are some") - frames[0];
    let share = (frames.len() - 1) as f64 / span as f64;
    assert!((0.15..0.3).contains(&share), "{share} of {frames:?}");
    drop(session);
    end(flight);
}
