//! What a gateway in a pipeline tells those who are no drones: ROS 2 nodes and the autopilot.

use std::collections::BTreeSet;
use std::net::UdpSocket;
use std::process::Command;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use flockeye_contract::wire::FrameReport;
use flockeye_require::loopback::{free_port, tcp};
use flockeye_tests::{Beside, Flight, WATCHDOG, flockeye, told, unique};
use rustix::process::Signal;
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

#[test]
fn nodes_of_ros_2_hear_where_neighbours_are() {
    let router = tcp(free_port());
    let mut command = Command::new(flockeye().with_file_name("zenoh-router"));
    command.arg(&router);
    let _router = Beside::start(command);
    let flight =
        fly(&unique("ros"), &[&format!("gateway.ros2={{connect: [{router}], domain: 7}}")]);
    let session = client_of(&router);
    let (tell, heard) = channel();
    let _subscriber = session
        .declare_subscriber("7/wren/neighbours/kite/pose/**")
        .callback(move |sample| {
            let payload = sample.payload().to_bytes().into_owned();
            // Whoever has heard one listens no more.
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
    let autopilot = format!(
        "gateway.autopilot={{link: \"udpout:127.0.0.1:{port}\", target: kite, system_id: 9}}"
    );
    let flight = fly(&unique("mav"), &[&autopilot]);
    // HEARTBEAT, TIMESYNC, TARGET_RELATIVE, OBSTACLE_DISTANCE_3D
    let wanted = BTreeSet::from([0, 111, 511, 11037]);
    let mut seen = BTreeSet::new();
    until(&flight, || {
        let mut datagram = [0; 2048];
        let length = socket.recv(&mut datagram).ok()?;
        // MAVLink 2: magic, length, two flags, sequence, system, component, then the message's number.
        if let [0xfd, _, _, _, _, system, component, a, b, c, ..] = datagram[..length] {
            assert_eq!((system, component), (9, 191));
            seen.insert(u32::from_le_bytes([a, b, c, 0]));
        }
        wanted.is_subset(&seen).then_some(())
    });
    end(flight);
}

#[test]
fn the_swarm_is_told_of_as_many_frames_as_asked() {
    let listen = tcp(free_port());
    let flight =
        fly(&unique("pace"), &["gateway.report_hz=5", &format!("gateway.listen=[{listen}]")]);
    let session = client_of(&listen);
    let (tell, heard) = channel();
    let _subscriber = session
        .declare_subscriber("flockeye/*/wren/sees")
        // Whoever has heard enough listens no more.
        .callback(move |sample| drop(tell.send(sample.payload().to_bytes().into_owned())))
        .wait()
        .expect("it is a key");
    let mut frames = Vec::new();
    until(&flight, || {
        frames.extend(heard.try_iter().map(|payload| {
            let report: FrameReport = serde_json::from_slice(&payload).expect("it is a report");
            report.frame
        }));
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
