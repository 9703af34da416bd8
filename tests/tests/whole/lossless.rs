//! A lossless flight is the same flight every time, however many workers there are: nothing in it
//! is decided by time.

use std::collections::BTreeMap;
use std::path::Path;

use flockeye_contract::{FrameStamp, MeasuredBy, StageLatency, Track, TrackHeader};
use flockeye_tables::PoseRow;
use flockeye_tests::onlooker::Tape;
use flockeye_tests::{SMALL_FLIGHT, Scratch, VULKAN, absent, flockeye, succeeds, unique};
use nalgebra::{Matrix3, Vector3};

const FRAMES: u64 = 40;

/// The results of a flight, without times.
struct Flown {
    /// The messages of `track`, byte by byte.
    tracks: Vec<Vec<u8>>,
    /// The recorded poses, without their column of the latency.
    poses: Vec<String>,
}

fn fly(mode: &str, workers: u32) -> Flown {
    fly_with("cpu", mode, workers)
}

fn fly_with(backend: &str, mode: &str, workers: u32) -> Flown {
    fly_as(backend, mode, workers, &[])
}

fn fly_as(backend: &str, mode: &str, workers: u32, more: &[&str]) -> Flown {
    let scratch = Scratch::new("lossless");
    let poses = scratch.path("poses.csv");
    let frames = format!("simulator.frames={FRAMES}");
    let mode = format!("search.mode={mode}");
    let workers = format!("stages.detection.replicas={workers}");
    let backend = format!("rectification.backend={backend}");
    let own = [frames.as_str(), "simulator.neighbours=2", &mode, &workers, &backend];
    let set: Vec<&str> = SMALL_FLIGHT.iter().chain(&own).chain(more).copied().collect();
    let arguments = ["--profile", "repeat", "--poses", poses.to_str().expect("a plain path")];
    let tape = Tape::record("lossless", &arguments, &set);
    tape.assert_every_frame_ended_once(FRAMES);
    let summary = format!("{FRAMES} frames searched, 0 skipped");
    assert!(tape.output.contains(&summary), "{}", tape.output);
    // Two flights that saw nothing would be the same too. A search that stops at its first hit may
    // see one neighbour only.
    let measured = [0, 1].map(|target| {
        let is_measured = |track: &&Track| {
            track.target == target && track.measured_by != MeasuredBy::Nothing.code()
        };
        tape.tracks.iter().flat_map(|(_, tracks)| tracks).filter(is_measured).count() as u64
    });
    let sees_all = mode.ends_with("roi") || mode.ends_with("exhaustive");
    let least = if sees_all { FRAMES / 8 } else { 0 };
    assert!(
        measured.iter().all(|&count| count >= least) && measured.iter().sum::<u64>() > FRAMES / 2,
        "the neighbours were hardly seen:\n{}",
        tape.output
    );
    let tracks = tape.tracks.iter().map(|(header, tracks)| timeless(header, tracks)).collect();
    Flown { tracks, poses: without_latency(&poses) }
}

/// A message's bytes, with its latency fields zeroed.
fn timeless(header: &TrackHeader, tracks: &[Track]) -> Vec<u8> {
    let stamp = FrameStamp { published_ns: 0, ..header.stamp };
    let header = TrackHeader { stamp, ..*header };
    let mut bytes = bytemuck::bytes_of(&header).to_vec();
    for track in tracks {
        let track = Track { latency: StageLatency::default(), ..*track };
        bytes.extend_from_slice(bytemuck::bytes_of(&track));
    }
    bytes
}

fn without_latency(poses: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(poses).expect("poses were recorded");
    let header = text.lines().next().expect("there are columns");
    let latency = header.split(',').position(|name| name == "latency_ms").expect("a latency");
    let without = |line: &str| {
        let mut cells: Vec<&str> = line.split(',').collect();
        cells.remove(latency);
        cells.join(",")
    };
    text.lines().map(without).collect()
}

fn assert_same(left: &Flown, right: &Flown, what: &str) {
    for (number, (left, right)) in left.poses.iter().zip(&right.poses).enumerate() {
        assert_eq!(left, right, "{what}: row {number} of the poses");
    }
    assert_eq!(left.poses.len(), right.poses.len(), "{what}: rows of poses");
    for (number, (left, right)) in left.tracks.iter().zip(&right.tracks).enumerate() {
        let first = left.iter().zip(right).position(|(left, right)| left != right);
        assert!(
            left == right,
            "{what}: message {number} on track differs from byte {first:?} on ({} and {} bytes)",
            left.len(),
            right.len()
        );
    }
    assert_eq!(left.tracks.len(), right.tracks.len(), "{what}: messages on track");
}

#[test]
fn the_same_flight_gives_the_same_bytes_twice_and_with_any_number_of_workers() {
    let first = fly("roi", 1);
    assert_same(&first, &fly("roi", 1), "a second time");
    assert_same(&first, &fly("roi", 3), "with three workers");
}

#[test]
fn what_is_searched_beyond_the_first_hit_of_the_greedy_search_counts_for_nothing() {
    assert_same(&fly("greedy", 1), &fly("greedy", 3), "with three workers");
}

#[test]
fn what_is_searched_beyond_the_first_hit_of_the_optimized_search_counts_for_nothing() {
    assert_same(&fly("optimized", 1), &fly("optimized", 3), "with three workers");
}

#[test]
fn an_exhaustive_search_does_not_depend_on_who_answers_first() {
    assert_same(&fly("exhaustive", 1), &fly("exhaustive", 3), "with three workers");
}

/// Fusion sleeps for 80 of each 100 ms for some seconds: whoever is slow makes the others wait, and
/// loses nothing.
#[test]
fn who_sleeps_now_and_then_misses_nothing() {
    let fusion = flockeye().with_file_name("flockeye-fusion");
    let sleepy = format!(
        r#"stages.fusion.command=["sh","-c","(for _ in $(seq 30); do kill -STOP $$ || exit; sleep 0.08; kill -CONT $$; sleep 0.02; done) & exec '{}'"]"#,
        fusion.display()
    );
    let sleeping = fly_as("cpu", "exhaustive", 3, &[&sleepy]);
    assert_same(&fly("exhaustive", 3), &sleeping, "with a fusion that sleeps");
}

#[test]
fn views_cut_by_a_graphics_processor_give_the_same_bytes_twice() {
    let drivers = ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"];
    let has_driver =
        |folder: &str| std::fs::read_dir(folder).is_ok_and(|mut drivers| drivers.next().is_some());
    if !drivers.into_iter().any(has_driver) {
        absent(VULKAN, "a Vulkan driver");
        return;
    }
    let first = fly_with("gpu", "roi", 1);
    assert_same(&first, &fly_with("gpu", "roi", 3), "with three workers");
}

/// The measured positions of a flight by frame and target, with their covariances.
fn measured(profile: &str) -> BTreeMap<(u64, String), (Vector3<f64>, Matrix3<f64>)> {
    let scratch = Scratch::new("budget");
    let poses = scratch.path("poses.csv");
    let instance = format!("instance={}", unique("budget"));
    let frames = format!("simulator.frames={FRAMES}");
    let own = [instance.as_str(), &frames, "simulator.neighbours=2"];
    let mut arguments = vec!["up", "--profile", profile, "--poses", poses.to_str().expect("plain")];
    for set in SMALL_FLIGHT.iter().chain(&own) {
        arguments.extend(["--set", set]);
    }
    succeeds(&arguments);
    let rows: Vec<PoseRow> = flockeye_tables::read(&poses).expect("poses");
    let measured = rows.into_iter().filter_map(|row| {
        let measured = row.measured?;
        let covariance = measured.covariance.expect("what is measured has a covariance");
        let covariance = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        Some(((row.frame, row.target), (measured.position, covariance)))
    });
    measured.collect()
}

/// The profile decides which passes run, but not their results. Poses that two flights have
/// measured differ only by the start of alignment, and by the path of the blur that the track
/// expects. Bodies are as small here as at 2 m in frames of 3840x1920.
#[test]
fn flight_by_the_clock_by_stated_costs_and_without_limit_gives_the_same_poses() {
    let unlimited = measured("unlimited");
    for (profile, least_share) in [("repeat", 0.9), ("flight", 0.25)] {
        let limited = measured(profile);
        let mut squared: Vec<f64> = limited
            .iter()
            .filter_map(|(key, (position, covariance))| {
                let (other, of_other) = unlimited.get(key)?;
                let (apart, sum) = (other - position, covariance + of_other);
                Some(apart.dot(&sum.cholesky().expect("a covariance").solve(&apart)))
            })
            .collect();
        let share = squared.len() as f64 / unlimited.len() as f64;
        assert!(share > least_share, "{profile}: {share} of {} measurements", unlimited.len());
        squared.sort_by(f64::total_cmp);
        let count = squared.len();
        let (most, worst) = (squared[count * 95 / 100], squared[count - 1]);
        // Chi-squared with three degrees of freedom exceeds 7.8 in 5 %, and 26 in 1 of 100,000
        // independent measurements. These share their pixels, so that they differ less.
        let said = format!("{profile}: {most} squared deviations in 95 %, {worst} at worst");
        assert!(most < 7.8 && worst < 26.0, "{said}, of {count}");
    }
}
