//! An autopilot over a real UDP socket on loopback, and over a real (pseudo) serial line.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs::File;
use std::io::Write;
use std::net::UdpSocket;
use std::time::{Duration, Instant};

use flockeye_config::MavlinkAddress;
use flockeye_inertial::autopilot::{News, SampleReceiver};
use mavlink::dialects::common::{
    HEARTBEAT_DATA, HIGHRES_IMU_DATA, HighresImuUpdatedFlags, MavCmd, MavMessage,
};
use mavlink::error::MessageReadError;
use mavlink::{
    Connectable, Connection, MavConnection, MavHeader, UdpConfig, UdpMode, write_v2_msg,
};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

/// No test waits longer.
const PATIENCE: Duration = Duration::from_secs(20);

const AUTOPILOT: MavHeader = MavHeader { system_id: 7, component_id: 1, sequence: 0 };

fn imu(time_us: u64) -> MavMessage {
    MavMessage::HIGHRES_IMU(HIGHRES_IMU_DATA {
        time_usec: time_us,
        zgyro: -0.5,
        fields_updated: HighresImuUpdatedFlags::all(),
        ..HIGHRES_IMU_DATA::DEFAULT
    })
}

/// The next sample, or what was said instead.
fn next(autopilot: &SampleReceiver) -> News {
    let began = Instant::now();
    while began.elapsed() < PATIENCE {
        if let Some(news) = autopilot.next(Duration::from_millis(50)).unwrap() {
            return news;
        }
    }
    panic!("nothing was heard for {PATIENCE:?}");
}

fn assert_sample(news: &News, wanted_us: u64) {
    let News::Sample { sender, sample, arrived_ns } = news else { panic!("{news:?}") };
    assert_eq!((*sender, sample.time_us, sample.rate), ((7, 1), wanted_us, [0.0, 0.0, 0.5]));
    let age_ns = flockeye_runtime::clock::monotonic_ns() - arrived_ns;
    assert!((0..PATIENCE.as_nanos() as i64).contains(&age_ns), "{age_ns}");
}

#[test]
fn an_autopilot_over_udp_is_heard_and_asked_for_samples() {
    let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let ours = SampleReceiver::listen(MavlinkAddress::UdpIn(port)).unwrap();
    assert!(matches!(next(&ours), News::Opened));
    let theirs: Connection<MavMessage> = UdpConfig::new(port.to_string(), UdpMode::Udpout)
        .read_timeout(Duration::from_millis(100))
        .connect()
        .unwrap();
    theirs.send(&AUTOPILOT, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT)).unwrap();
    // It is asked for both messages at 200 a second.
    let (mut asked, mut greeted) = (Vec::new(), false);
    let began = Instant::now();
    while (asked.len() < 2 || !greeted) && began.elapsed() < PATIENCE {
        match theirs.recv() {
            Ok((_, MavMessage::COMMAND_LONG(command))) => {
                assert_eq!(command.command, MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL);
                assert_eq!((command.target_system, command.param2), (7, 5000.0));
                asked.push(command.param1);
            }
            Ok((_, MavMessage::HEARTBEAT(_))) => greeted = true,
            Ok(_) | Err(MessageReadError::Parse(_)) => {}
            Err(MessageReadError::Io(error)) => {
                assert_eq!(error.kind(), std::io::ErrorKind::WouldBlock, "{error}");
                theirs.send(&AUTOPILOT, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT)).unwrap();
            }
        }
    }
    assert_eq!((asked.as_slice(), greeted), ([105.0, 31.0].as_slice(), true));
    theirs.send(&AUTOPILOT, &imu(1000)).unwrap();
    assert_sample(&next(&ours), 1000);
    // Bytes that are no message, and half of one.
    let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
    stranger.send_to(&[0xfd; 300], port).unwrap();
    let mut half = Vec::new();
    write_v2_msg(&mut half, AUTOPILOT, &imu(1500)).unwrap();
    stranger.send_to(&half[..20], port).unwrap();
    // The rest of that message is what the reader takes the next bytes for; the one after is whole
    // again.
    let began = Instant::now();
    for time_us in (2000..).step_by(1000) {
        theirs.send(&AUTOPILOT, &imu(time_us)).unwrap();
        if let Some(news) = ours.next(Duration::from_millis(50)).unwrap() {
            assert!(matches!(news, News::Sample { .. }), "{news:?}");
            break;
        }
        assert!(began.elapsed() < PATIENCE);
    }
}

#[test]
fn a_port_that_is_taken_is_said() {
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let ours = SampleReceiver::listen(MavlinkAddress::UdpIn(address)).unwrap();
    let news = next(&ours);
    assert!(matches!(&news, News::Lost { reason } if reason.contains("in use")), "{news:?}");
    // It is opened once it is free.
    drop(taken);
    while !matches!(next(&ours), News::Opened) {}
}

#[test]
fn an_autopilot_on_a_serial_line_is_heard_and_its_loss_is_said() {
    let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&controller).unwrap();
    unlockpt(&controller).unwrap();
    let device = ptsname(&controller, Vec::new()).unwrap().into_string().unwrap();
    let ours = SampleReceiver::listen(MavlinkAddress::Serial { device, baud: 115_200 }).unwrap();
    assert!(matches!(next(&ours), News::Opened));
    let mut theirs = File::from(controller);
    for time_us in [1000, 6000] {
        // Noise on the line before each message.
        theirs.write_all(&[0x00, 0x42, 0x13]).unwrap();
        write_v2_msg(&mut theirs, AUTOPILOT, &imu(time_us)).unwrap();
        assert_sample(&next(&ours), time_us);
    }
    // The cable is pulled.
    drop(theirs);
    let news = next(&ours);
    assert!(matches!(news, News::Lost { .. }), "{news:?}");
}

#[test]
fn a_device_that_does_not_exist_is_said() {
    let address = MavlinkAddress::Serial { device: "/dev/no-such-line".into(), baud: 57_600 };
    let ours = SampleReceiver::listen(address).unwrap();
    let news = next(&ours);
    assert!(matches!(&news, News::Lost { reason } if reason.contains("No such file")), "{news:?}");
}
