//! `flockeye calibrate`: measures real positions, curves and times from flights or recordings.
//!
//! | module | what it finds |
//! | --- | --- |
//! | [`body`] | the real poses of a body's markers |
//! | [`mount`] | the camera's pose on the drone |
//! | [`lenses`] | the relative pose of the camera's two lenses |
//! | [`response`] | the curve between light and code values |
//! | [`latency`] | the latency of a camera's frames |
//! | [`imu`] | the inertial sensor's rotation and time offset relative to the camera |

use std::ffi::OsString;

use anyhow::Context;
use flockeye_cli::{Configuration, Screen, signals};
use flockeye_config::{Mount, Profile};
use flockeye_tables::{TableRow, read};
use nalgebra::Isometry3;
use serde_json::Value;

use crate::up_process;

pub(crate) mod body;
pub(crate) mod imu;
pub(crate) mod latency;
pub(crate) mod lenses;
pub(crate) mod mount;
pub(crate) mod response;

pub(crate) use imu::CalibrateImuArguments;
pub(crate) use mount::CalibrateMountArguments;
pub(crate) use response::CalibrateResponseArguments;

/// Distance for which the remaining error of a calibration is stated, metres.
const STATED_AT_M: f64 = 1.5;

/// The configuration of a run that searches every frame and sends nothing over the network.
fn lossless(configuration: &Configuration) -> anyhow::Result<Configuration> {
    let mut configuration = configuration.clone().with_every_frame(&[])?;
    configuration.set.extend(apart());
    Ok(configuration)
}

/// The configuration of a run that searches each frame completely and independently of others.
fn frame_by_frame(configuration: &Configuration) -> Configuration {
    let mut configuration = configuration.clone().in_profile(Profile::Stills);
    configuration.set.extend(apart());
    configuration.set.push("search.mode=exhaustive".to_owned());
    configuration
}

/// Settings that separate a run from all others.
fn apart() -> [String; 2] {
    ["gateway.enabled=false".to_owned(), format!("instance=calibrate-{}", std::process::id())]
}

/// Runs `flockeye up`, and returns the rows that it writes to the file of its option `option`.
/// `what` describes the run in error messages of a quiet run.
fn written<R: TableRow>(
    configuration: &Configuration,
    option: &str,
    what: &str,
    is_quiet: bool,
) -> anyhow::Result<Vec<R>> {
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let file = folder.path().join("written.csv");
    let mut command: Vec<OsString> = vec![option.into(), (&file).into()];
    command.extend(configuration.to_arguments(&[], &[]));
    let stopping = signals::stop_flag()?;
    match is_quiet {
        true => drop(up_process::run_quietly(what, &command, &stopping)?),
        false => up_process::run_visibly(&command, &stopping)?,
    }
    Ok(read(&file)?)
}

/// Prints the result as JSON or as text.
fn show(
    json: bool,
    as_json: impl FnOnce() -> Value,
    text: impl FnOnce() -> String,
) -> anyhow::Result<()> {
    let shown = if json { serde_json::to_string_pretty(&as_json())? } else { text() };
    Screen::new().line(&shown);
    Ok(())
}

/// A transform as a mount in `pipeline.yaml`.
fn mount_of(transform: &Isometry3<f64>) -> Mount {
    // The division gives a number with the shortest text. Adding 0 turns -0 into 0.
    let rounded = |number: f64, steps: f64| (number * steps).round() / steps + 0.0;
    // The quaternion has length 1 up to rounding. If w is negative, its negative is printed, which
    // is the same rotation.
    let sign = if transform.rotation.w < 0.0 { -1.0 } else { 1.0 };
    let orientation = transform.rotation.coords * sign;
    Mount {
        position: transform.translation.vector.map(|x| rounded(x, 1e6)).into(),
        orientation: orientation.map(|x| rounded(x, 1e8)).into(),
    }
}
