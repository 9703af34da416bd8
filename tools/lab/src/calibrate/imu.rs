//! `flockeye calibrate imu`: the inertial sensor's rotation and time offset relative to the camera.

use std::ffi::OsString;
use std::path::Path;
use std::time::Duration;

use crate::calibration::sensor::{SensorCalibration, TurnSeen, calibrate};
use anyhow::{Context, ensure};
use clap::Args;
use flockeye_cli::{Configuration, duration, signals};
use flockeye_config::{InertialSource, Pipeline};
use flockeye_tables::{RotationRow, rate_record, read};
use serde_json::{Value, json};

use super::show;
use crate::up_process;

/// Duration of the flight if the source does not end by itself.
const USUAL_FLIGHT: Duration = Duration::from_secs(30);

/// Arguments of `calibrate imu`.
#[derive(Debug, Args)]
pub(crate) struct CalibrateImuArguments {
    /// Which configuration: the camera, the source, and the inertial sensor.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Compare for this long: 30s, 2m. A recording is compared to its end; all else for 30 s.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
    /// For a program.
    #[arg(long)]
    pub json: bool,
}

/// Runs the pipeline with the sensor, compares its rates with the picture's, and prints mounting
/// and time offset.
///
/// # Errors
/// No sensor is configured, `flockeye up` fails, or the flight does not determine the result.
pub(crate) fn run(arguments: &CalibrateImuArguments) -> anyhow::Result<()> {
    let found = fly(arguments, &[])?;
    show(arguments.json, || as_json(&found), || text(&found))
}

/// Runs the flight with `more` settings, and calibrates sensor and camera from it.
pub(super) fn fly(
    arguments: &CalibrateImuArguments,
    more: &[&str],
) -> anyhow::Result<SensorCalibration> {
    let pipeline = arguments.configuration.load()?;
    ensure!(
        pipeline.has_inertial_sensor(),
        "there is no inertial sensor to calibrate. Cure: --set inertial.source=..., as in pipeline.yaml"
    );
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let [rotations, samples] = ["rotations.csv", "imu.csv"].map(|name| folder.path().join(name));
    let mut command: Vec<OsString> =
        vec!["--rotations".into(), (&rotations).into(), "--imu".into(), (&samples).into()];
    let (own, flight) = settings(&pipeline, arguments.duration);
    if let Some(flight) = flight {
        command.extend(["--for".into(), format!("{}ms", flight.as_millis()).into()]);
    }
    let mut configuration = match is_timeless(&pipeline) {
        true => arguments.configuration.clone().with_every_frame(&[])?,
        false => arguments.configuration.clone(),
    };
    configuration.set.extend(own);
    configuration.set.extend(more.iter().map(|&set| set.to_owned()));
    command.extend(configuration.to_arguments(&[], &[]));
    let stopping = signals::stop_flag()?;
    match arguments.json {
        true => drop(up_process::run_quietly("the flight with the sensor", &command, &stopping)?),
        false => up_process::run_visibly(&command, &stopping)?,
    }
    of_files(&rotations, &samples)
}

/// Whether the run may differ from real time: a recording or a simulated flight without an
/// autopilot.
fn is_timeless(pipeline: &Pipeline) -> bool {
    // An autopilot always sends in real time.
    let lives = matches!(pipeline.inertial.parsed_source(), Ok(InertialSource::Mavlink(_)));
    let input = &pipeline.source.input;
    !lives && (input == "sim" || Path::new(input).exists())
}

/// Settings of the run, and its time limit. A recording or a finite simulated flight runs to its
/// end. Other sources run for a limited time.
fn settings(pipeline: &Pipeline, wanted: Option<Duration>) -> (Vec<String>, Option<Duration>) {
    let is_recording = Path::new(&pipeline.source.input).exists();
    let is_simulated = pipeline.source.input == "sim";
    let ends = is_recording || (is_simulated && pipeline.simulator.frames > 0);
    let own = vec![
        "gateway.enabled=false".to_owned(),
        "inertial.used=false".to_owned(),
        format!("instance=calibrate-{}", std::process::id()),
    ];
    (own, wanted.or((!ends).then_some(USUAL_FLIGHT)))
}

/// The calibration from the two recordings.
fn of_files(rotations: &Path, samples: &Path) -> anyhow::Result<SensorCalibration> {
    let rotations: Vec<RotationRow> = read(rotations)?;
    let record = rate_record(read(samples)?);
    let seen = rotations.iter().filter_map(|row| {
        let turn = row.turn.as_ref()?;
        // Samples have times of the frames' clock, so the exposures are taken from the same clock.
        let step_s = row.exposure_s - turn.earlier_exposure_s;
        let turned = turn.later_from_earlier.inverse().scaled_axis();
        (step_s > 0.0).then(|| TurnSeen {
            earlier_s: turn.earlier_exposure_s,
            later_s: row.exposure_s,
            rate: turned / step_s,
        })
    });
    Ok(calibrate(&seen.collect::<Vec<_>>(), &record)?)
}

fn as_json(found: &SensorCalibration) -> Value {
    let degrees =
        |radians: &nalgebra::Vector3<f64>| radians.map(f64::to_degrees).as_slice().to_vec();
    json!({
        "camera_from_sensor": found.camera_from_sensor.coords.as_slice(),
        "time_offset_ms": found.time_offset_s * 1e3,
        "bias_deg_s": degrees(&found.bias),
        "mounting_deviation_deg": degrees(&found.mounting_deviation),
        "offset_deviation_ms": found.offset_deviation_s * 1e3,
        "residual_deg_s": found.residual.to_degrees(),
        "comparisons": found.comparisons,
    })
}

fn text(found: &SensorCalibration) -> String {
    let [x, y, z, w] = found.camera_from_sensor.coords.into();
    let (roll, pitch, yaw) = found.camera_from_sensor.euler_angles();
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
    let deviation = found.mounting_deviation.map(f64::to_degrees);
    let bias = found.bias.map(f64::to_degrees);
    format!(
        "{} comparisons of sensor and picture; {:.2} degrees/s are left between them\n\
         mounting     roll {roll:.2}, pitch {pitch:.2}, yaw {yaw:.2} degrees, +- {:.2}, {:.2}, {:.2} about \
         x, y, z\n\
         time offset  {:.2} ms, +- {:.2}\n\
         bias         {:.2}, {:.2}, {:.2} degrees/s; it is found anew in each flight\n\
         for pipeline.yaml:\n\
         inertial:\n  camera_from_sensor: [{x:.6}, {y:.6}, {z:.6}, {w:.6}]\n  time_offset_ms: {:.2}",
        found.comparisons,
        found.residual.to_degrees(),
        deviation.x,
        deviation.y,
        deviation.z,
        found.time_offset_s * 1e3,
        found.offset_deviation_s * 1e3,
        bias.x,
        bias.y,
        bias.z,
        found.time_offset_s * 1e3,
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn pipeline(overrides: &[&str]) -> Pipeline {
        let overrides: Vec<String> = overrides.iter().map(|&text| text.into()).collect();
        Pipeline::parse("", &overrides, "x").unwrap()
    }

    #[test]
    fn a_recording_is_played_to_its_end_and_all_else_for_a_while() {
        let flight = |overrides: &[&str], wanted: Option<u64>| {
            settings(&pipeline(overrides), wanted.map(Duration::from_secs)).1
        };
        assert_eq!(flight(&[], None), Some(USUAL_FLIGHT));
        assert_eq!(flight(&[], Some(5)), Some(Duration::from_secs(5)));
        assert_eq!(flight(&["simulator.frames=90"], None), None);
        assert_eq!(flight(&["source.input=v4l2:/dev/no-such-camera"], None), Some(USUAL_FLIGHT));
        let recording = pipeline(&["source.input=/dev/null"]);
        assert!(is_timeless(&recording) && settings(&recording, None).1.is_none());
        assert!(!is_timeless(&pipeline(&["source.input=v4l2:/dev/no-such-camera"])));
    }

    #[test]
    fn what_is_printed_can_be_pasted() {
        let found = SensorCalibration {
            camera_from_sensor: nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, 1.5),
            time_offset_s: 0.0123,
            bias: nalgebra::Vector3::new(0.01, 0.0, -0.01),
            mounting_deviation: nalgebra::Vector3::repeat(0.002),
            offset_deviation_s: 0.0004,
            residual: 0.01,
            comparisons: 800,
        };
        let printed = text(&found);
        let yaml = printed.split_once("for pipeline.yaml:\n").unwrap().1;
        let inertial = Pipeline::parse(yaml, &[], "x").unwrap().inertial;
        assert_eq!(inertial.time_offset_ms, 12.3);
        let pasted = nalgebra::Quaternion::from(inertial.camera_from_sensor);
        assert!((pasted - found.camera_from_sensor.into_inner()).norm() < 1e-6);
        assert_eq!(as_json(&found)["comparisons"], 800);
    }
}
