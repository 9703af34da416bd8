//! Simulated flights that are drawn as videos, and flown from them.

use std::path::Path;

use flockeye_tables::{ImuRow, PoseRow, TruthRow, read};
use flockeye_tests::{SMALL_FLIGHT, Scratch, run, succeeds, unique};

const FRAMES: u64 = 12;

/// `flockeye film` of the small flight, with more settings.
fn film(out: &str, more: &[&str], options: &[&str]) -> (bool, String) {
    let frames = format!("simulator.frames={FRAMES}");
    let mut arguments = vec!["film", "--out", out];
    arguments.extend(options);
    for set in SMALL_FLIGHT.iter().chain([&frames.as_str()]).chain(more) {
        arguments.extend(["--set", set]);
    }
    run(&arguments)
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

#[test]
fn a_filmed_flight_is_flown_as_a_recording_with_its_truth() {
    let scratch = Scratch::new("film");
    let [video, truth, imu, poses] =
        ["flight.mp4", "truth.csv", "imu.csv", "poses.csv"].map(|name| scratch.path(name));
    let tables = ["--truth", text(&truth), "--imu", text(&imu), "--bitrate", "8"];
    let (is_well, said) = film(text(&video), &[], &tables);
    assert!(is_well && said.contains("12 frames in "), "{said}");
    let truth: Vec<TruthRow> = read(&truth).expect("a truth");
    assert_eq!(
        truth.iter().map(|row| row.frame).collect::<Vec<_>>(),
        (0..FRAMES).collect::<Vec<_>>()
    );
    let samples: Vec<ImuRow> = read(&imu).expect("samples");
    assert!(samples.last().is_some_and(|last| last.t_s > truth[11].t_s - 0.01));
    let instance = format!("instance={}", unique("film"));
    let inertial = format!("inertial.source={}", text(&imu));
    let mut arguments = vec!["up", "--source", text(&video), "--profile", "repeat"];
    arguments.extend(["--poses", text(&poses)]);
    let settings = ["camera.width=1024", "camera.height=512", "gateway.enabled=false"];
    for set in settings.iter().chain([&instance.as_str(), &inertial.as_str()]) {
        arguments.extend(["--set", set]);
    }
    succeeds(&arguments);
    let poses: Vec<PoseRow> = read(&poses).expect("poses");
    let errors_m = poses.iter().filter_map(|row| {
        let of_frame = truth.iter().find(|truth| truth.frame == row.frame)?;
        assert!((row.stamp_s - of_frame.t_s).abs() < 1e-3, "frame {}", row.frame);
        Some((row.measured.as_ref()?.position - of_frame.position()).norm())
    });
    let mut errors_m: Vec<f64> = errors_m.collect();
    errors_m.sort_by(f64::total_cmp);
    assert!(errors_m.len() >= 9, "{} of {FRAMES} frames measured", errors_m.len());
    assert!(errors_m[errors_m.len() / 2] < 5e-3, "{errors_m:?} m");
}

#[test]
fn what_cannot_be_filmed_is_refused_with_a_cure() {
    let scratch = Scratch::new("film");
    let video = scratch.path("flight.mp4");
    let (absent, truth) = (scratch.path("absent/flight.mp4"), scratch.path("truth.csv"));
    let odd = ["camera.width=1020", "camera.height=510"];
    let large = ["camera.width=8192", "camera.height=4096"];
    for (out, set, wanted) in [
        (&video, &["simulator.frames=0"][..], "has no end. Cure: --set simulator.frames=300"),
        (&video, &large, "are too large for the encoder. Cure: at most 9437184 pixels"),
        (&video, &odd, "Cure: a camera.width that is a multiple of 8"),
        (&video, &["simulator.neighbours=7"], "simulator.neighbours: 7 neighbours"),
        (&absent, &["simulator.seed=2"], "absent/flight.mp4"),
    ] {
        let (is_well, said) = film(text(out), set, &["--truth", text(&truth)]);
        assert!(!is_well && said.contains(wanted), "{wanted:?} is missing in:\n{said}");
        assert!(!out.exists() && !truth.exists(), "{wanted:?} leaves no file");
    }
    // The encoder fails while frames still come.
    let (is_well, said) = film("/dev/full", &["simulator.frames=60"], &["--bitrate", "100"]);
    assert!(!is_well && said.contains("flockeye: "), "{said}");
}
