//! A simulated autopilot for the inertial stage.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use mavlink::dialects::common::{
    HEARTBEAT_DATA, HIGHRES_IMU_DATA, HighresImuUpdatedFlags, MavMessage,
};
use mavlink::{Connectable, Connection, MavConnection, MavHeader, UdpConfig, UdpMode};

/// An autopilot that sends `HIGHRES_IMU` 200 times a second until it is dropped. Its yaw rate is
/// that of the simulated drone, times a variable factor in percent.
pub struct SimulatedAutopilot {
    percent: Arc<AtomicU32>,
    thread: Option<std::thread::JoinHandle<()>>,
}

/// Yaw of one picture column per frame, degrees/s. In calm air the simulated background turns by
/// whole columns.
pub const YAW_DEG_S: f32 = 360.0 / 1024.0 * 30.0;

/// Ends the thread.
const STOP: u32 = u32::MAX;

impl SimulatedAutopilot {
    /// Starts an autopilot that sends to this UDP address.
    pub fn start(address: String) -> Self {
        let percent = Arc::new(AtomicU32::new(100));
        let factor = percent.clone();
        let thread = std::thread::spawn(move || {
            let line: Connection<MavMessage> =
                UdpConfig::new(address, UdpMode::Udpout).connect().expect("a socket");
            let header = MavHeader { system_id: 1, component_id: 1, sequence: 0 };
            let began = Instant::now();
            for sample in 0u64.. {
                let percent = factor.load(Ordering::Relaxed);
                if percent == STOP {
                    return;
                }
                if sample % 200 == 0 {
                    // Errors are ignored: the receiver may not exist yet, or any more.
                    let _ = line.send(&header, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT));
                }
                let yaw = YAW_DEG_S.to_radians() * percent as f32 / 100.0;
                let imu = HIGHRES_IMU_DATA {
                    time_usec: began.elapsed().as_micros() as u64,
                    // Down is MAVLink's third axis.
                    zgyro: -yaw,
                    zacc: -9.81,
                    fields_updated: HighresImuUpdatedFlags::all(),
                    ..HIGHRES_IMU_DATA::DEFAULT
                };
                let _ = line.send(&header, &MavMessage::HIGHRES_IMU(imu));
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        Self { percent, thread: Some(thread) }
    }

    /// Changes the factor of its rates.
    pub fn set_percent(&self, percent: u32) {
        self.percent.store(percent, Ordering::Relaxed);
    }
}

impl Drop for SimulatedAutopilot {
    fn drop(&mut self) {
        self.set_percent(STOP);
        if let Some(thread) = self.thread.take() {
            thread.join().expect("the autopilot has not panicked");
        }
    }
}
