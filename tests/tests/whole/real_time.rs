//! A flight in real time at the camera's full size. `FLOCKEYE_SOAK_S` makes it longer than its 20
//! seconds.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use flockeye_contract::{Healths, TrackState, Tracks};
use flockeye_tables::{PoseRow, read};
use flockeye_tests::onlooker::{join, subscribe};
use flockeye_tests::{Flight, Scratch, WATCHDOG, small_flight};
use rustix::process::Signal;

/// The longest time without a word on a neighbour who was found. It is a second on a machine of
/// its own; a loaded one gets more.
const LONGEST_SILENCE_NS: i64 = 3_000_000_000;

#[test]
fn poses_flow_the_whole_time_and_memory_does_not_grow() {
    let seconds = std::env::var("FLOCKEYE_SOAK_S")
        .map_or(20, |text| text.parse::<u64>().expect("FLOCKEYE_SOAK_S is a number of seconds"));
    let mut flight = Flight::with_poses("soak", &[], &["gateway.enabled=false"]);
    let mut ports = join(&mut flight);
    let mut tracks = subscribe::<Tracks>(&mut flight, &mut ports);
    let mut healths = subscribe::<Healths>(&mut flight, &mut ports);

    // Exposures of which there was a pose, and what each stage's memory was, at what share of the
    // flight.
    let mut exposures_ns = Vec::new();
    let mut measured = 0;
    let mut memory: BTreeMap<String, Vec<(f64, u64)>> = BTreeMap::new();
    let start = Instant::now();
    ports
        .attend(|| {
            assert!(!flight.has_ended(), "it ended by itself:\n{}", flight.output());
            let share = start.elapsed().as_secs_f64() / seconds as f64;
            while let Some(message) = tracks.receive()? {
                for track in message.items() {
                    exposures_ns.push(message.header.stamp.exposure_ns);
                    measured += u64::from(track.state == TrackState::Confirmed.code());
                }
            }
            while let Some(message) = healths.receive()? {
                let stage = message.header.stage.to_string();
                memory.entry(stage).or_default().push((share, message.header.resident_bytes));
            }
            Ok((share < 1.0).then_some(Duration::from_millis(100)))
        })
        .expect("messages can be waited for");
    drop((tracks, healths, ports));
    flight.signal(Signal::INT);
    assert!(flight.wait_for_end(WATCHDOG).success(), "{}", flight.output());
    println!("{}", flight.output().lines().rev().take(2).collect::<Vec<_>>().join("\n"));

    let first_ns = *exposures_ns.first().expect("a neighbour was found");
    let last_ns = *exposures_ns.last().expect("a neighbour was found");
    let silences = exposures_ns.windows(2).map(|pair| pair[1] - pair[0]);
    let longest_ns = silences.max().unwrap_or(0);
    println!(
        "{measured} poses measured, {} predicted, over {:.1} s; {:.2} s the longest without one",
        exposures_ns.len() as u64 - measured,
        (last_ns - first_ns) as f64 * 1e-9,
        longest_ns as f64 * 1e-9
    );
    assert!(longest_ns < LONGEST_SILENCE_NS, "no pose for a while:\n{}", flight.output());
    let flown_ns = seconds as i64 * 1_000_000_000;
    assert!(
        last_ns - first_ns > flown_ns - 2 * LONGEST_SILENCE_NS,
        "no pose at the end:\n{}",
        flight.output()
    );

    for stage in ["simulator", "rectification", "detection", "fusion"] {
        let reports = memory.get(stage).unwrap_or_else(|| panic!("{stage} did not report"));
        let most = |from: f64, to: f64| {
            let inside = reports.iter().filter(|(share, _)| (from..to).contains(share));
            inside.map(|&(_, bytes)| bytes).max()
        };
        let middle = most(0.3, 0.6).unwrap_or_else(|| panic!("{stage} was silent"));
        let end = most(0.8, 2.0).unwrap_or_else(|| panic!("{stage} was silent"));
        println!("{stage:<14} {:>6.1} MB, then {:>6.1} MB", middle as f64 / 1e6, end as f64 / 1e6);
        let allowed = middle + middle / 10 + 5_000_000;
        assert!(end <= allowed, "{stage} grew from {middle} to {end} bytes");
    }
    flight.assert_nothing_left();
}

/// The camera sends two frames at once, then none for a sixth of a second. Its clock jumps back by
/// three seconds, and ahead by forty. Each fault costs its own frames at most.
#[test]
fn a_camera_that_keeps_no_time_is_followed() {
    let scratch = Scratch::new("erratic");
    let poses = scratch.path("poses.csv");
    let command =
        format!(r#"stages.simulator.command=["{}"]"#, env!("CARGO_BIN_EXE_erratic-camera"));
    let set = small_flight(&[command.as_str()]);
    let arguments = ["--poses", poses.to_str().expect("a plain path")];
    let mut flight = Flight::start("erratic", &arguments, &set);
    assert!(flight.wait_for_end(WATCHDOG).success(), "{}", flight.output());
    let output = flight.output();
    assert!(!output.contains("started again"), "a stage did not survive it:\n{output}");
    let rows: Vec<PoseRow> = read(&poses).expect("poses");
    // A clock that jumped makes a new track; some frames may be skipped where processors are few.
    for phase in [0..40, 40..60, 60..100, 100..150] {
        let measured = rows.iter().filter(|row| row.is_measured() && phase.contains(&row.frame));
        let wanted = (phase.end - phase.start) as usize / 4;
        let found = measured.count();
        assert!(found >= wanted, "{found} poses of frames {phase:?}:\n{output}");
    }
    for row in rows.iter().filter(|row| row.is_measured()) {
        let range_m = row.position.norm();
        assert!((0.4..0.7).contains(&range_m), "frame {}: {range_m} m", row.frame);
    }
    flight.assert_nothing_left();
}
