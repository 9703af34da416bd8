//! Keys and combinations of the release before.

use super::*;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter;
use flockeye_geometry::pose::PoseEstimate;
use nalgebra::{Isometry3, Matrix6};

/// Every combination of the keys that `profile` replaced, with what it means today.
#[test]
fn every_former_combination_is_translated_or_refused() {
    let values = [
        ("flow", [None, Some("latest"), Some("lossless")]),
        ("search.budget", [None, Some("flight"), Some("unlimited")]),
        ("fusion.filter", [None, Some("constant_velocity"), Some("none")]),
    ];
    for number in 0..27 {
        let chosen = [number % 3, number / 3 % 3, number / 9];
        let written = || values.iter().zip(chosen);
        let set = written().filter_map(|((key, values), choice)| Some((*key, values[choice]?)));
        let set: Vec<String> = set.map(|(key, value)| format!("{key}={value}")).collect();
        let means = chosen.map(|choice| choice == 2);
        let profile = match means {
            [false, _, false] => Some(Profile::Flight),
            [true, false, false] => Some(Profile::Repeat),
            [true, true, false] => Some(Profile::Unlimited),
            [true, false, true] => Some(Profile::Stills),
            [false, _, true] | [true, true, true] => None,
        };
        // In the file, and as settings of the command line.
        let section = |path: &str| -> String {
            let of_path = written().find(|((key, _), _)| *key == path);
            let value = of_path.and_then(|((_, values), choice)| values[choice]);
            value.map(str::to_owned).unwrap_or_default()
        };
        let yaml = format!(
            "flow: {}\nsearch:\n  budget: {}\nfusion:\n  filter: {}\n",
            section("flow"),
            section("search.budget"),
            section("fusion.filter")
        );
        let lines: Vec<&str> = yaml.lines().filter(|line| !line.ends_with(": ")).collect();
        for read in [Pipeline::parse("", &set, "x"), parse(&lines.join("\n"))] {
            match (read, profile) {
                (Ok(read), Some(profile)) => {
                    assert_eq!(read, Pipeline { profile, ..Pipeline::default() }, "{set:?}");
                }
                (Err(error), None) => {
                    let message = error.to_string();
                    assert!(message.contains("Cure: profile: stills"), "{set:?}: {message}");
                }
                (read, profile) => panic!("{set:?}: {read:?}, where {profile:?} was meant"),
            }
        }
    }
}

#[test]
fn a_profile_of_the_command_line_replaces_former_keys_of_the_file() {
    let yaml = "flow: lossless\nfusion: {filter: none}";
    let set = |set: &str| Pipeline::parse(yaml, &[set.to_owned()], "x");
    assert_eq!(set("profile=unlimited").unwrap().profile, Profile::Unlimited);
    // A former key of the command line changes what the file says with the others.
    assert_eq!(set("fusion.filter=constant_velocity").unwrap().profile, Profile::Repeat);
    let both = ["flow=latest".to_owned(), "profile=stills".to_owned()];
    let refused = Pipeline::parse("", &both, "x").unwrap_err().to_string();
    assert!(refused.contains("--set flow=latest: flow: profile says it now"), "{refused}");
}

#[test]
fn configurations_of_recordings_are_read_whatever_release_wrote_them() {
    let today = Pipeline { profile: Profile::Unlimited, ..Pipeline::default() };
    let mut written = serde_json::to_value(&today).unwrap();
    written[FLOW] = today.flow().name().into();
    written[RESOLVED] = serde_json::json!({"workers": 2});
    let read = |json: &serde_json::Value| Pipeline::from_json(json.to_string().as_bytes());
    assert_eq!(read(&written).unwrap(), today);
    written.as_object_mut().unwrap().remove("profile");
    written["search"]["budget"] = "unlimited".into();
    written["fusion"]["filter"] = "constant_velocity".into();
    assert_eq!(read(&written).unwrap(), today);
    written["warp"] = 9.into();
    assert!(read(&written).unwrap_err().to_string().contains("warp"));
}

/// A file with every key of the last release at its default, as that release shipped it.
#[test]
fn keys_that_are_constants_now_are_read_with_their_values_and_refused_with_others() {
    let yaml = "\
        partition: {count: auto, weights: [0.2, 0.02, 0.78], seed: 1, margin_deg:, magnification:}\n\
        search: {lossless_partitions: 4, costs: {processors: 1.3, source_ms: 20, egomotion_ms: 2.2, \
        proposals_ms: 4.5, cut_ms_per_megapixel: 2.5, window_ms_per_megapixel: 4, direct_pass_ms: 3.5, \
        corner_pass_ms: 4, initiation_ms: 8, background_pass_ms: 45}}\n\
        fusion: {confirm_hits: 2, confirm_window: 5, history_s: 0.5, gate_probability: 0.999}\n\
        simulator: {lens_blur_px: 0.8}\nrecording: {split_mb: 1000}";
    assert_eq!(parse(yaml).unwrap(), Pipeline::default());
    assert_eq!(parse("fusion: {angular_acceleration: 3}").unwrap(), Pipeline::default());
    for autopilot in ["autopilot: {max_age_ms: 500}", "gateway: {autopilot: {max_age_ms: 500}}"] {
        assert_eq!(parse(autopilot).unwrap(), parse("autopilot: {}").unwrap());
    }
    assert_eq!(parse("search:\n  costs:\n").unwrap(), Pipeline::default());
    assert_eq!(parse("search: {costs: {processors: 4}}").unwrap().search.processors, 4.0);
    let set = ["search.costs.processors=4".to_owned(), "fusion.restart_after_gated=3".to_owned()];
    assert_eq!(Pipeline::parse("", &set, "x").unwrap().search.processors, 4.0);
    assert_eq!(parse("search: {mode: gaze}").unwrap(), parse("search: {mode: roi}").unwrap());
    let other = ["fusion.history_s=0.6".to_owned()];
    let refused = Pipeline::parse("", &other, "x").unwrap_err().to_string();
    assert!(
        refused.contains("--set fusion.history_s=0.6: fusion.history_s: is fixed"),
        "{refused}"
    );
}

/// Number of measurements in a row that replace a track which they contradict.
fn contradictions_until_restart() -> f64 {
    let found = |x_m: f64| filter::FrameMeasurement {
        pose: PoseEstimate {
            camera_from_markers: Isometry3::translation(x_m, 0.0, 0.0),
            covariance: Matrix6::identity() * 1e-4,
        },
        rival: None,
        is_proven: false,
        jump: None,
    };
    let ego = EgoRotation::new(2.0);
    let mut life = filter::LifeCycle::new(filter::TrackPolicy::default());
    let mut tell =
        |frame: i32, x_m: f64| life.measured(f64::from(frame) / 30.0, &found(x_m), &ego).unwrap();
    for frame in 0..5 {
        tell(frame, 1.0);
    }
    let restart = (5..15).position(|frame| tell(frame, -1.0) == filter::Happened::Restarted);
    restart.unwrap() as f64 + 1.0
}

#[test]
fn what_constants_a_former_key_names_is_what_the_code_has() {
    let costs = Costs::default();
    let policy = filter::TrackPolicy::default();
    let said: Vec<f64> = crate::former_keys::fixed_numbers().collect();
    let is = [
        costs.source_ms,
        costs.egomotion_ms,
        costs.proposals_ms,
        costs.cut_ms_per_megapixel,
        costs.window_ms_per_megapixel,
        costs.direct_pass_ms,
        costs.corner_pass_ms,
        costs.initiation_ms,
        costs.background_pass_ms,
        resolved(&Pipeline::default()).roi_options.partitions_per_frame as f64,
        f64::from(policy.confirm_hits),
        f64::from(filter::CONFIRM_WINDOW),
        filter::HISTORY_S,
        filter::GATE_PROBABILITY,
        contradictions_until_restart(),
        flockeye_geometry::partition::STORED_SEED as f64,
        0.8,
        policy.motion.angular_acceleration,
        // autopilot.max_age_ms and recording.split_mb, whose constants belong to other crates.
        500.0,
        1000.0,
    ];
    assert_eq!(said, is);
    let weights = flockeye_geometry::partition::Criterion::default().weights();
    assert_eq!(weights, [0.2, 0.02, 0.78]);
}

fn parsed(yaml: &str, overrides: &[&str]) -> Result<Pipeline, String> {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    Pipeline::parse(yaml, &overrides, "pipeline.yaml").map_err(|error| error.to_string())
}

#[test]
fn a_section_is_found_at_its_former_place() {
    let yaml = "gateway: {listen: [tcp/127.0.0.1:7448], ros2: {domain: 7}, autopilot: {system_id: 9}}\nros2:";
    let pipeline = parsed(yaml, &[]).unwrap();
    assert_eq!(pipeline.ros2.unwrap().domain, 7);
    assert_eq!(pipeline.autopilot.unwrap().system_id, 9);
    let listen = "gateway: {listen: [tcp/127.0.0.1:7448]}";
    let pipeline = parsed(listen, &["gateway.ros2.domain=8"]).unwrap();
    assert_eq!(pipeline.ros2.unwrap().domain, 8);
    assert_eq!(parsed("gateway: {ros2: , autopilot: }", &[]).unwrap().ros2, None);
}

#[test]
fn a_section_in_both_places_is_refused_and_its_values_are_checked() {
    let both = parsed("ros2: {domain: 1}\ngateway: {ros2: {domain: 2}}", &[]).unwrap_err();
    assert!(both.contains("line 2") && both.contains("leave gateway.ros2 out"), "{both}");
    let wrong = parsed("gateway: {autopilot: {system_id: 0}}", &[]).unwrap_err();
    assert!(wrong.contains("autopilot.system_id"), "{wrong}");
}
