//! `flockeye calibrate mount`: the camera's pose on the drone, from a body at measured places.

mod bench;

use std::path::PathBuf;

use crate::calibration::mount::{Agreement, MountCalibration, StillPose, fit};
use anyhow::{Context, ensure};
use clap::Args;
use flockeye_cli::Configuration;
use flockeye_cli::text_table::TextTable;
use flockeye_config::{isometry, read_document};
use flockeye_tables::{PoseRow, read};
use nalgebra::Isometry3;
use serde_json::{Value, json};

use self::bench::MeasuringBench;
use super::{STATED_AT_M, frame_by_frame, mount_of, show, written};

/// Arguments of `calibrate mount`.
#[derive(Debug, Args)]
pub(crate) struct CalibrateMountArguments {
    /// Which configuration: the camera, the bodies, and the pictures as its source (a folder of
    /// images, or a video).
    #[command(flatten)]
    pub configuration: Configuration,
    /// Where the body was: a YAML or JSON file of places in the drone's frame (docs/CAMERAS.md).
    #[arg(long, value_name = "FILE")]
    pub places: PathBuf,
    /// Poses that `flockeye up --poses` recorded of the pictures with this configuration; the
    /// pictures are not looked at then.
    #[arg(long, value_name = "FILE.csv")]
    pub poses: Option<PathBuf>,
    /// For a program.
    #[arg(long)]
    pub json: bool,
}

/// Measures the body's pose at each place, and prints the camera's pose on the drone.
///
/// # Errors
/// The file of places is wrong, `flockeye up` fails, or the places do not determine the mount.
pub(crate) fn run(arguments: &CalibrateMountArguments) -> anyhow::Result<()> {
    let bench: MeasuringBench = read_document(&arguments.places)?;
    let configuration = frame_by_frame(&arguments.configuration);
    let pipeline = configuration.load()?;
    bench.check().with_context(|| format!("{}", arguments.places.display()))?;
    let rows = match &arguments.poses {
        Some(file) => read(file)?,
        None => written(&configuration, "--poses", "the pictures", arguments.json)?,
    };
    let configured = isometry(&pipeline.observer.observer_from_camera);
    let report = MountReport::of(&bench, &rows, configured)?;
    show(arguments.json, || report.as_json(), || report.text())
}

/// The calibrated mount, the configured one, and the places.
struct MountReport {
    found: MountCalibration,
    configured: Isometry3<f64>,
    /// Places with a pose, each with its number in the file, from 1. The mount's residuals have
    /// this order.
    seen: Vec<(usize, StillPose)>,
    /// Numbers of the places without a pose, from 1.
    unseen: Vec<usize>,
}

impl MountReport {
    fn of(
        bench: &MeasuringBench,
        rows: &[PoseRow],
        configured: Isometry3<f64>,
    ) -> anyhow::Result<Self> {
        let body = bench.body(rows)?;
        let places = bench.see(rows, &body, &configured)?;
        let (mut measured, mut seen, mut unseen) = (Vec::new(), Vec::new(), Vec::new());
        for (number, place) in (1..).zip(places) {
            match place {
                Some(place) => {
                    seen.push((number, place.seen.clone()));
                    measured.push(place);
                }
                None => unseen.push(number),
            }
        }
        let found = fit(&measured).map_err(|error| {
            let missing = match unseen.as_slice() {
                [] => String::new(),
                unseen => {
                    format!(" (body '{body}' is not seen at places {unseen:?}, counted from 1)")
                }
            };
            // The error counts places in the same way as the file.
            anyhow::anyhow!("{error}{missing}")
        })?;
        ensure!(found.freedom > 0, "the places leave nothing to check the mount by");
        Ok(Self { found, configured, seen, unseen })
    }

    fn as_json(&self) -> Value {
        let Self { found, .. } = self;
        let deviations = found.deviations();
        let places = self.seen.iter().zip(&found.places).map(|((number, seen), residual)| {
            json!({
                "place": number,
                "frames": seen.frames,
                "odd_frames": seen.odd,
                "residual_mm": residual.residual_m.map(|x| x * 1e3).as_slice(),
                "expected_mm": residual.deviation_m * 1e3,
                "deviations": residual.deviations,
                "kept": residual.is_kept,
            })
        });
        json!({
            "observer_from_camera": mount_of(&found.observer_from_camera),
            "position_deviation_m": deviations[..3],
            "rotation_deviation_rad": deviations[3..],
            "chi_square": found.chi_square,
            "freedom": found.freedom,
            "agreement": match found.agreement {
                Agreement::AsStated => "as stated",
                Agreement::Better => "better",
                Agreement::Worse => "worse",
            },
            "error_mm_at_1.5_m": found.error_at_m(STATED_AT_M) * 1e3,
            "configured_error_mm_at_1.5_m": found.error_of_m(&self.configured, STATED_AT_M) * 1e3,
            "places": places.collect::<Vec<_>>(),
            "unseen": self.unseen,
        })
    }

    fn text(&self) -> String {
        let Self { found, .. } = self;
        let mut text = self.table();
        for place in &self.unseen {
            text += &format!("\nplace {place}: the body has no pose there; it does not count");
        }
        for (number, seen) in self.seen.iter().filter(|(_, seen)| seen.odd > 0) {
            text += &format!(
                "\nplace {number}: {} frames have another pose and do not count. Cure: nothing may move",
                seen.odd
            );
        }
        let mount = mount_of(&found.observer_from_camera);
        let position = found.observer_from_camera.translation.vector * 1e3;
        let (roll, pitch, yaw) = found.observer_from_camera.rotation.euler_angles();
        let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
        let deviations = found.deviations();
        let [dx, dy, dz] = [0, 1, 2].map(|k| deviations[k] * 1e3);
        let [da, db, dc] = [3, 4, 5].map(|k| deviations[k].to_degrees());
        text += &format!(
            "\nchi-square   {:.1} where {} are expected: {}\n\
             position     {:.1}, {:.1}, {:.1} mm, +- {dx:.1}, {dy:.1}, {dz:.1}\n\
             orientation  roll {roll:.2}, pitch {pitch:.2}, yaw {yaw:.2} degrees, +- {da:.2}, {db:.2}, {dc:.2} about x, y, z\n\
             it leaves    {:.1} mm at {STATED_AT_M} m in the worst direction; as configured, a neighbour is off by up to {:.1} mm\n\
             for pipeline.yaml:\n\
             observer:\n  observer_from_camera:\n    position: {:?}\n    orientation: {:?}",
            found.chi_square,
            found.freedom,
            self.verdict(),
            position.x,
            position.y,
            position.z,
            found.error_at_m(STATED_AT_M) * 1e3,
            found.error_of_m(&self.configured, STATED_AT_M) * 1e3,
            mount.position,
            mount.orientation,
        );
        text
    }

    fn verdict(&self) -> String {
        match self.found.agreement {
            Agreement::AsStated => "the places agree as stated".into(),
            Agreement::Better => {
                "the places agree better than stated; deviations may be smaller".into()
            }
            Agreement::Worse => format!(
                "the places disagree by more than stated; deviations are enlarged {:.1} times. Cure: measure \
                 the places anew, or give them the deviations that they have",
                (self.found.chi_square / self.found.freedom as f64).sqrt()
            ),
        }
    }

    fn table(&self) -> String {
        let titles = ["place", "frames", "x mm", "y mm", "z mm", "expected mm", "deviations", ""];
        let mut table = TextTable::new(0, &titles);
        for ((number, seen), residual) in self.seen.iter().zip(&self.found.places) {
            let [x, y, z]: [f64; 3] = (residual.residual_m * 1e3).into();
            let note = if residual.is_kept { "" } else { "contradicts the others: left out" };
            table.row([
                number.to_string(),
                seen.frames.to_string(),
                format!("{x:.1}"),
                format!("{y:.1}"),
                format!("{z:.1}"),
                format!("{:.1}", residual.deviation_m * 1e3),
                format!("{:.1}", residual.deviations),
                note.to_owned(),
            ]);
        }
        table.text()
    }
}

#[cfg(test)]
mod tests;
