//! The parameters of the line, and their check.

use flockeye_config::MavlinkAddress;
use flockeye_contract::wire::{MAX_NAME_CHARS, is_name};
use mavlink::dialects::development::MavComponent;
use serde::{Deserialize, Serialize};

use crate::error::AutopilotError;

/// How the autopilot gets its neighbours. By default nothing leaves the machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AutopilotParameters {
    /// Where the autopilot is: `udpin:ADDRESS:PORT` to listen, `udpout:HOST:PORT` to send to, or
    /// `serial:DEVICE:BAUD`.
    pub link: String,
    /// The vehicle's MAVLink system, 1 to 255: the autopilot's `MAV_SYS_ID` or `SYSID_THISMAV`.
    pub system_id: u8,
    /// Our component in that system, 2 to 255 (191 is an onboard computer).
    pub component_id: u8,
    /// The neighbour that is sent as the target (`TARGET_RELATIVE`); none: no target is sent.
    pub target: Option<String>,
    /// How often each message is sent at most.
    pub rates: Rates,
    /// A neighbour that was last seen longer ago is left out, milliseconds.
    pub max_age_ms: u32,
    /// Nearer and farther neighbours are no obstacles, metres: the range that is sent as the sensor's.
    pub obstacle_range_m: [f64; 2],
}

/// How often messages are sent at most, each second; 0: never.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rates {
    /// `TARGET_RELATIVE`.
    pub target_hz: f64,
    /// Sets of `OBSTACLE_DISTANCE_3D`, one message for each neighbour.
    pub obstacles_hz: f64,
    /// How often the autopilot is asked to send its odometry; 0: it is not asked.
    pub odometry_hz: f64,
}

impl Default for Rates {
    fn default() -> Self {
        Self { target_hz: 20.0, obstacles_hz: 15.0, odometry_hz: 30.0 }
    }
}

impl Default for AutopilotParameters {
    fn default() -> Self {
        Self {
            link: "udpin:127.0.0.1:14540".into(),
            system_id: 1,
            component_id: MavComponent::MAV_COMP_ID_ONBOARD_COMPUTER as u8,
            target: None,
            rates: Rates::default(),
            max_age_ms: 500,
            obstacle_range_m: [0.0, 50.0],
        }
    }
}

impl AutopilotParameters {
    /// Refuses what cannot work.
    ///
    /// # Errors
    /// [`AutopilotError::Parameter`] names the field and the cure.
    pub fn check(&self) -> Result<(), AutopilotError> {
        self.address()?;
        if self.system_id == 0 {
            let reason = "addresses everybody. Cure: the autopilot's MAV_SYS_ID or SYSID_THISMAV";
            return Err(wrong("system_id", self.system_id, reason));
        }
        if self.component_id < 2 {
            let reason = "is everybody's or the autopilot's own. Cure: 191, an onboard computer";
            return Err(wrong("component_id", self.component_id, reason));
        }
        if let Some(target) = self.target.as_ref().filter(|target| !is_name(target)) {
            let reason =
                format!("is no name: 1 to {MAX_NAME_CHARS} letters, digits, '-', '_' or '.'");
            return Err(wrong("target", target, reason));
        }
        let Rates { target_hz, obstacles_hz, odometry_hz } = self.rates;
        for (field, hz) in [
            ("rates.target_hz", target_hz),
            ("rates.obstacles_hz", obstacles_hz),
            ("rates.odometry_hz", odometry_hz),
        ] {
            if hz != 0.0 && !(0.5..=100.0).contains(&hz) {
                return Err(wrong(field, hz, "must be 0.5 to 100, or 0 for never"));
            }
        }
        if !(50..=5000).contains(&self.max_age_ms) {
            return Err(wrong("max_age_ms", self.max_age_ms, "must be 50 to 5000"));
        }
        let [near, far] = self.obstacle_range_m;
        // The test also fails where one of them is no number.
        if !(near >= 0.0 && near < far && far <= 1000.0) {
            let found = format!("[{near}, {far}]");
            return Err(wrong("obstacle_range_m", found, "must rise and lie within 0 to 1000"));
        }
        Ok(())
    }

    pub(crate) fn address(&self) -> Result<MavlinkAddress, AutopilotError> {
        MavlinkAddress::parse(&self.link).map_err(|reason| wrong("link", &self.link, reason))
    }
}

fn wrong(field: &'static str, found: impl ToString, reason: impl Into<String>) -> AutopilotError {
    AutopilotError::Parameter { field, found: found.to_string(), reason: reason.into() }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn errors_name_the_field_and_the_cure() {
        AutopilotParameters::default().check().unwrap();
        let refused = |change: fn(&mut AutopilotParameters)| {
            let mut parameters = AutopilotParameters::default();
            change(&mut parameters);
            parameters.check().expect_err("refused").to_string()
        };
        let message = refused(|p| p.link = "udpin:14540".into());
        assert!(message.starts_with("link: 'udpin:14540'") && message.contains("udpin:0.0.0.0"));
        assert!(refused(|p| p.system_id = 0).contains("SYSID_THISMAV"));
        assert!(refused(|p| p.component_id = 1).contains("191"));
        assert!(refused(|p| p.target = Some("a b".into())).starts_with("target: 'a b' is no name"));
        assert!(refused(|p| p.rates.target_hz = 1e6).starts_with("rates.target_hz: '1000000'"));
        assert!(refused(|p| p.rates.odometry_hz = f64::NAN).starts_with("rates.odometry_hz"));
        assert!(refused(|p| p.max_age_ms = 0).starts_with("max_age_ms: '0' must be 50"));
        let message = refused(|p| p.obstacle_range_m = [5.0, f64::NAN]);
        assert!(message.starts_with("obstacle_range_m: '[5, NaN]'"), "{message}");
    }
}
