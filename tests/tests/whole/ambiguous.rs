//! Neighbours whose pose one picture does not tell: one marker is in sight, and its mirror pose
//! looks the same.

use bytemuck::pod_read_unaligned;
use flockeye_contract::{BodyTruth, MeasuredBy, Pose, Track, TrackHeader, TruthHeader};
use flockeye_convert::isometry;
use flockeye_geometry::pose::is_false;
use flockeye_tests::{Flight, Scratch, small_flight};

use crate::recording::{read, text};

/// A cube shows one marker alone from time to time.
#[test]
fn where_two_poses_are_possible_the_track_has_both_and_one_of_them_is_right() {
    let (mut ambiguous, mut measured) = (0, 0);
    for seed in [2, 6, 9, 10] {
        let counted = fly(seed);
        println!("seed {seed}: {counted:?}");
        (ambiguous, measured) = (ambiguous + counted.0, measured + counted.1);
    }
    assert!(measured > 200 && ambiguous > 20, "{measured} measured, {ambiguous} ambiguous");
}

/// Flies a cube, and returns the numbers of ambiguous frames with one right pose, and of measured
/// poses.
fn fly(seed: u32) -> (u32, u32) {
    let scratch = Scratch::new("ambiguous");
    let folder = scratch.path("recordings");
    let recording = format!("recording.folder={}", text(&folder));
    let seed = format!("simulator.seed={seed}");
    let set = small_flight(&[
        "bodies.list=[{name: alpha, preset: cube}]",
        "simulator.distance_m=[0.45, 0.7]",
        "simulator.frames=150",
        &seed,
        &recording,
    ]);
    let mut flight = Flight::start("ambiguous", &["--profile", "repeat"], &set);
    flight.assert_ends_well();
    let file = std::fs::read_dir(&folder).expect("it was made").next().expect("one file");
    let file = file.expect("it can be read").path();
    let (tracks, _) = read(&file, "flockeye/track");
    let (truths, _) = read(&file, "flockeye/truth");
    let true_poses: Vec<(u64, Pose)> = truths
        .iter()
        .map(|message| {
            let header: TruthHeader = pod_read_unaligned(&message.header);
            let body: BodyTruth = pod_read_unaligned(&message.items[..size_of::<BodyTruth>()]);
            (header.stamp.sequence, body.observer_from_target)
        })
        .collect();
    let (mut ambiguous, mut measured) = (0, 0);
    for message in &tracks {
        let header: TrackHeader = pod_read_unaligned(&message.header);
        let frame = header.stamp.sequence;
        let truth = true_poses.iter().find(|(of, _)| *of == frame).expect("it is simulated");
        let truth = isometry(&truth.1);
        let is_right = |pose: &Pose| !is_false(&isometry(pose), &truth);
        for track in message.items.chunks_exact(size_of::<Track>()) {
            let track: Track = pod_read_unaligned(track);
            if track.measured_by != MeasuredBy::Nothing.code() {
                assert_eq!(track.is_ambiguous, 0, "frame {frame}");
                assert!(is_right(&track.measured_observer_from_target), "frame {frame}: {track:?}");
                measured += 1;
            } else if track.is_ambiguous == 1 {
                let poses = [&track.observer_from_target, &track.rival_observer_from_target];
                let [right, other] = poses.map(is_right);
                assert!(right || other, "frame {frame}: {track:?}");
                // Rivals exclude each other. Where they are hardly far enough apart for that, the
                // truth may lie between them. Such a frame does not count.
                let [one, two] = poses.map(isometry);
                assert!(is_false(&one, &two), "frame {frame}: {track:?}");
                ambiguous += u32::from(right != other);
            }
        }
    }
    (ambiguous, measured)
}
