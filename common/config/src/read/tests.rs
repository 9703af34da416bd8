#![allow(clippy::unwrap_used, clippy::expect_used)]
use std::path::Path;

use super::*;
use crate::resolve::Resolved;
use crate::types::*;
use flockeye_contract::{Projection, SearchMode};

fn parse(yaml: &str) -> Result<Pipeline, ConfigError> {
    Pipeline::parse(yaml, &[], "pipeline.yaml")
}

#[test]
fn an_empty_file_is_the_default() {
    assert_eq!(parse("").unwrap(), Pipeline::default());
    assert_eq!(parse("search:\n").unwrap(), Pipeline::default());
}

#[test]
fn pictures_are_coded_as_video_unless_the_source_has_none() {
    let is_video = |input: &str, coding: &str| {
        let text = format!("source: {{input: {input}}}\nfusion: {{coding: {coding}}}");
        parse(&text).unwrap().is_coded_as_video()
    };
    assert!(!is_video("sim", "auto") && !is_video("picture.JPG", "auto"));
    assert!(!is_video(env!("CARGO_MANIFEST_DIR"), "auto"), "a folder of images");
    assert!(is_video("flight.mp4", "auto") && is_video("theta", "auto"));
    assert!(!is_video("v4l2:/dev/video0", "images") && is_video("sim", "video"));
}

#[test]
fn lenses_that_nobody_knows_are_off_by_default() {
    let error_px = |input: &str, projection: Projection, stated: Option<f64>| {
        let mut pipeline = parse(&format!("source: {{input: {input}}}")).unwrap();
        (pipeline.camera.projection, pipeline.camera.lens_error_px) = (projection, stated);
        pipeline.lens_error_px()
    };
    assert_eq!(error_px("flight.mp4", Projection::DualFisheye, None), 0.3);
    assert_eq!(error_px("sim", Projection::DualFisheye, None), 0.0);
    assert_eq!(error_px("flight.mp4", Projection::Equirectangular, None), 0.15);
    assert_eq!(error_px("flight.mp4", Projection::Stereographic, None), 0.0);
    assert_eq!(error_px("sim", Projection::Equirectangular, None), 0.0);
    assert_eq!(error_px("sim", Projection::Equirectangular, Some(2.0)), 2.0);
}

#[test]
fn lenses_are_learned_where_nobody_states_one_centre() {
    let learns = |text: &str| {
        let pipeline = parse(text).unwrap();
        (pipeline.learns_lenses(), pipeline.learns_response())
    };
    let of_video = |camera: &str| learns(&format!("source: {{input: f.mp4}}\ncamera: {camera}"));
    assert_eq!(of_video("{}"), (true, true));
    assert_eq!(of_video("{lens_distance_m: 0.016, response: srgb}"), (true, false));
    assert_eq!(of_video("{lens_distance_m: 0}"), (false, true));
    assert_eq!(of_video("{projection: stereographic}"), (false, true));
    assert_eq!(learns("{}"), (false, false));
    assert_eq!(learns("simulator: {lens_distance_m: 0.016}"), (true, false));
    assert_eq!(learns("simulator: {stitch: {blend_deg: 3}}"), (true, true));
}

#[test]
fn only_video_files_and_cameras_have_packets_to_record() {
    let records = |input: &str| {
        let source = format!("source: {{input: {input}}}\n");
        parse(&(source + "recording: {folder: flights, frames: camera}")).is_ok()
    };
    assert!(records("flight.mp4") && records("theta"));
    for input in ["sim", "flight.mcap", "picture.png", env!("CARGO_MANIFEST_DIR")] {
        assert!(!records(input), "{input}");
    }
}

#[test]
fn the_shipped_file_says_the_defaults() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../pipeline.yaml");
    assert_eq!(Pipeline::load(Path::new(path), &[]).unwrap(), Pipeline::default());
}

#[test]
fn the_shipped_file_names_every_key() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../pipeline.yaml");
    let text = std::fs::read_to_string(path).unwrap();
    let schema = serde_json::to_value(json_schema()).unwrap();
    let sections = schema["$defs"].as_object().unwrap().values().chain([&schema]);
    let keys =
        sections.filter_map(|section| section["properties"].as_object()).flat_map(|p| p.keys());
    let missing: Vec<_> = keys.filter(|key| !text.contains(&format!("{key}:"))).collect();
    assert!(missing.is_empty(), "pipeline.yaml does not mention {missing:?}");
}

/// Every malformed or senseless file, and what the message has to say.
const WRONG: &[(&str, &[&str])] = &[
    ("camera: [1, 2", &["not YAML"]),
    (
        "ros2: {connect: [tcp/127.0.0.1:7447]}",
        &["ros2.connect", "in gateway.listen too", "another port"],
    ),
    ("ros2: {connect: ['7447']}", &["ros2.connect", "tcp/ADDRESS:PORT"]),
    ("autopilot: {link: /dev/ttyACM0}", &["autopilot.link", "serial:DEVICE"]),
    (
        "gateway: {listen: [tcp/10.0.0.7:7447]}",
        &["gateway.listen", "gateway.security", "unsecured"],
    ),
    ("gateway: {connect: [tcp/10.0.0.7:7447]}", &["gateway.connect", "unsecured: true"]),
    ("gateway: {scout_interface: wlan0}", &["gateway.scout_interface", "unsecured: true"]),
    ("gateway: {listen: [tls/127.0.0.1:7447]}", &["gateway.listen", "needs gateway.security"]),
    ("gateway: {security: {ca: a, certificate: b, key: c}}", &["security", "roster"]),
    (
        "gateway: {security: {ca: a, certificate: b, key: c, roster: d}}",
        &["gateway.listen", "tls/ADDRESS:PORT"],
    ),
    ("gateway: {mode: client}", &["gateway.mode", "needs a router", "gateway.connect"]),
    ("gateway: {mode: router}", &["gateway.mode"]),
    ("autopilot: {system_id: 0}", &["autopilot.system_id", "from 1 to 255"]),
    ("autopilot: {component_id: 1}", &["autopilot.component_id", "from 2 to 255"]),
    ("autopilot: {target_hz: 0.1}", &["autopilot.target_hz", "0.5 to 100"]),
    ("autopilot: {obstacles_hz: 101}", &["autopilot.obstacles_hz", "from 0 to 100"]),
    ("autopilot: {odometry_hz: .nan}", &["not a finite number"]),
    ("autopilot: {max_age_ms: 9}", &["autopilot.max_age_ms", "500"]),
    ("autopilot: {obstacle_range_m: [5, 5]}", &["autopilot.obstacle_range_m"]),
    ("autopilot: {obstacle_range_m: [0, 1001]}", &["autopilot.obstacle_range_m"]),
    ("autopilot: {target: a b}", &["autopilot.target", "cannot be a name"]),
    ("camera:\n\twidth: 1", &["not YAML"]),
    ("camera: {width: 1}\ncamera: {width: 2}", &["line 2", "duplicated key"]),
    ("- camera", &["must be a section", "not a list"]),
    ("just text", &["must be a section", "the text 'just text'"]),
    ("---\na: 1\n---\nb: 2", &["2 documents"]),
    ("1: 2", &["key must be text"]),
    ("camra: {}", &["line 1, column 1", "unknown key", "did you mean 'camera'?"]),
    ("camera:\n  widht: 3840", &["line 2, column 3", "camera.widht", "did you mean 'width'?"]),
    (
        "search: {qqq: 1}",
        &["unknown key (known are mode, processors, far_magnification, proposals)"],
    ),
    ("camera: {width: wide}", &["camera.width", "must be a whole number", "the text 'wide'"]),
    ("camera: {width: 38.5}", &["must be a whole number, not 38.5"]),
    (
        "camera: {width: 20000, height: 10000}",
        &["from 64 to 16384, not 20000", "from 32 to 8192, not 10000"],
    ),
    (
        "camera: {width: 3840, height: 2160}",
        &["line 1, column 17", "twice as wide as high", "3840x2160"],
    ),
    (
        "camera: {projection: dual_fisheye}",
        &["camera.lenses", "has two lenses, not 0", "docs/CAMERAS.md"],
    ),
    (
        "camera: {projection: dual_fisheye, lenses: [{circle_px: 3, field_deg: 190}]}",
        &["camera.lenses.0.centre_px: is missing", "camera.lenses.0.camera_from_lens: is missing"],
    ),
    (
        "camera:\n  width: 1280\n  height: 640\n  projection: dual_fisheye\n  lenses:\n    - \
         {centre_px: [319.5, 319.5], circle_px: 330, field_deg: 190, camera_from_lens: {}}\n    - \
         {centre_px: [959.5, 319.5], circle_px: 310, field_deg: 190, camera_from_lens: {}}",
        &["line 6", "camera.lenses", "image circle of lens 0", "leaves the image of 1280x640"],
    ),
    (
        "camera:\n  projection: dual_fisheye\n  lenses:\n    - {centre_px: [959, 959], circle_px: \
         900, field_deg: 190, camera_from_lens: {}, double_sphere: [0.1, 0.6]}\n    - {centre_px: \
         [2879, 959], circle_px: 900, field_deg: 190, camera_from_lens: {}}",
        &["line 4", "camera.lenses.0.focal_px", "needs the focal lengths"],
    ),
    (
        "camera:\n  projection: dual_fisheye\n  lenses:\n    - {centre_px: [959, 959], circle_px: \
         900, field_deg: 190, camera_from_lens: {}, focal_px: [9, 9], double_sphere: [0.1, 0.6], \
         equidistant: [0, 0, 0, 0]}\n    - {centre_px: [2879, 959], circle_px: 900, field_deg: 190, \
         camera_from_lens: {}}",
        &["line 4", "camera.lenses.0: a lens has one curve"],
    ),
    (
        "camera:\n  projection: dual_fisheye\n  lenses:\n    - {centre_px: [959, 959], circle_px: \
         900, field_deg: 190, camera_from_lens: {orientation: [1, 1, 0, 0]}}\n    - {centre_px: \
         [2879, 959], circle_px: 900, field_deg: 190, camera_from_lens: {}}",
        &["line 4", "camera.lenses.0.camera_from_lens.orientation", "has length 1, not 1.4142"],
    ),
    (
        "camera: {projection: stereographic, stereographic_field_deg: 360}",
        &["camera.stereographic_field_deg", "from 1 to 350, not 360"],
    ),
    ("camera: {lens_distance_m: -0.1}", &["from 0 to 1, not -0.1"]),
    (
        "camera: {response: table, response_table: [0, 1, 1.00000000001]}",
        &["camera.response_table", "single precision"],
    ),
    (
        "camera: {width: 7680, height: 3840}\npartition: {count: 5}",
        &["line 2", "partition.count", "px a side", "4096 at most"],
    ),
    ("camera: {response: table}", &["camera.response_table", "2 to 256 codes, not of 0"]),
    (
        "camera: {response: table, response_table: [0, 2, 2]}",
        &["camera.response_table", "entry 2 is 2 after 2"],
    ),
    ("camera: {latency_ms: -1}", &["from 0 to 10000, not -1"]),
    ("camera: {latency_ms: .inf}", &["not a finite number"]),
    ("profile: flihgt", &["flight, repeat, unlimited, stills", "did you mean 'flight'?"]),
    ("profile: [flight]", &["must be one of flight, repeat, unlimited, stills, not a list"]),
    ("flow: losless", &["latest, lossless", "did you mean 'lossless'?"]),
    ("flow: [latest]", &["must be one of latest, lossless, not a list"]),
    ("search: {budget: all}", &["search.budget: must be one of flight, unlimited, not 'all'"]),
    ("fusion:\n  filter: 0", &["line 2", "fusion.filter: must be one of constant_velocity, none"]),
    (
        "profile: repeat\nflow: lossless",
        &["line 2", "flow: profile says it now", "line 1", "Cure: leave flow out"],
    ),
    (
        "profile: stills\nfusion: {filter: none}",
        &["line 2", "fusion.filter: profile says it now", "Cure: leave fusion.filter out"],
    ),
    (
        "fusion: {filter: none}",
        &["line 1", "fusion.filter: fusion.filter: none: no profile", "Cure: profile: stills"],
    ),
    (
        "flow: lossless\nfusion: {filter: none}\nsearch: {budget: unlimited}",
        &["line 3", "search.budget: ", "stills have no other budget", "profile: stills"],
    ),
    ("search: {mode: ro}", &["greedy, optimized, exhaustive, roi", "did you mean 'roi'?"]),
    (
        "fusion:\n  confirm_hits: 6",
        &[
            "line 2",
            "fusion.confirm_hits: is fixed at 2 now",
            "the filter's design",
            "leave it out",
        ],
    ),
    ("search: {costs: {source_ms: 30}}", &["search.costs.source_ms: is fixed at 20.0 now"]),
    ("search: {costs: {source: 30}}", &["search.costs", "unknown key"]),
    (
        "search: {processors: 4, costs: {processors: 4}}",
        &["search.costs.processors: is called search.processors now", "Cure: leave"],
    ),
    ("instance: 'a b'", &["instance: 'a b' cannot be a name"]),
    ("observer: {name: a/b}", &["observer.name", "letters, digits"]),
    (
        "observer: {observer_from_camera: {position: [0, 0]}}",
        &["must have exactly 3 entries, not 2"],
    ),
    ("observer: {observer_from_camera: {orientation: [0, 0, 0, 0]}}", &["length 1, not 0.0000"]),
    ("bodies: {list: [{name: a}, {name: a}]}", &["two bodies are called 'a'", "id 0 belongs to"]),
    ("bodies: {list: []}", &["there is no body"]),
    ("bodies: {list: [{marker_m: 0.07}]}", &["0.07 m does not fit a facet of 0.0625 m"]),
    (
        "bodies: {list: [{preset: truncated, small_marker_m: 0.04}]}",
        &["bodies.list.0.small_marker_m", "0.04 m does not fit a triangle with edges of 0.075 m"],
    ),
    (
        "bodies: {list: [{preset: cube, small_shift_m: 0.001}]}",
        &["list.0.small_shift_m", "the preset cube has no small_shift_m"],
    ),
    ("bodies: {list: [{preset: custom}]}", &["list.0.file", "in a JSON file: say which"]),
    ("bodies: {list: [{preset: plate, file: a.json}]}", &["plate has no file"]),
    ("bodies: {list: [{edge_m: -0.1}]}", &["bodies.list.0.edge_m", "not -0.1"]),
    ("bodies: {list: [{preset: sphere}]}", &["squares, truncated, cube, plate, custom"]),
    ("simulator: {neighbours: 3}", &["3 neighbours, but 2 bodies"]),
    ("simulator: {distance_m: [2, 1]}", &["two rising numbers", "[2, 1]"]),
    ("simulator: {exposure_ms: 50}", &["exposure of 50 ms in a frame of 33.33 ms"]),
    (
        "partition:\n  count: 3",
        &[
            "line 2, column 10",
            "partition.count",
            "from 4 to 128, not 3",
            "three flat images never",
        ],
    ),
    ("partition: {count: 129}", &["from 4 to 128, not 129", "never all searched in time"]),
    ("partition: {count: -1}", &["from 4 to 128, not -1"]),
    ("partition: {count: 12.5}", &["partition.count", "must be a whole number, not 12.5"]),
    ("partition: {count: all}", &["must be a whole number", "not the text 'all'"]),
    ("partition: {count: [12]}", &["must be a whole number", "not a list"]),
    ("partition: {method: tammes}", &["partition.method", "must be one of covering, paper"]),
    (
        "partition:\n  weights: [0.5, 0.25, 0.25]",
        &[
            "line 2, column 12",
            "partition.weights: is fixed at [0.2, 0.02, 0.78]",
            "flockeye partition",
        ],
    ),
    ("partition: {seed: 3}", &["partition.seed: is fixed at 1 now", "leave it out"]),
    (
        "partition: {margin_deg: 7}",
        &["column 25", "partition.margin_deg: is no key any more: partition.nearest_m"],
    ),
    (
        "partition: {magnification: 2}",
        &["partition.magnification: is no key any more: the profile"],
    ),
    (
        "partition:\n  count: 4",
        &["line 2, column 10", "a marker of 0.05 m at 0.4 m", "fewest views for this margin are 5"],
    ),
    (
        "partition: {nearest_m: 0.1}\nbodies: {list: [{edge_m: 2, marker_m: 2}]}",
        &["partition.nearest_m", "a marker of 2 m at 0.1 m", "no number of views does"],
    ),
    ("partition: {count: 5, method: paper}", &["partition.count", "fewest views"]),
    ("gateway: {listen: [localhost]}", &["gateway.listen.0", "tcp/ADDRESS:PORT"]),
    ("gateway: {enabled: maybe}", &["must be true or false, not the text 'maybe'"]),
    ("stages: {fusion: {replicas: 2}}", &["only detection runs in several processes"]),
    ("stages: {detection: {restart: sometimes}}", &["never, on_failure, always"]),
    ("stages: {fusion: {nice: 25}}", &["stages.fusion.nice", "-20", "19"]),
    ("stages: {fusion: {scheduling: soon}}", &["normal, batch, idle, fifo, round_robin"]),
    ("stages: {fusion: {priority: 0}}", &["stages.fusion.priority", "1", "99"]),
    ("stages: {fusion: {cpus: 0}}", &["stages.fusion.cpus", "must be a list"]),
    ("search: {far_magnification: 9}", &["search.far_magnification", "1", "3"]),
    (
        "camera: {width: 16384, height: 8192}\nsearch: {far_magnification: 3}",
        &["line 2", "search.far_magnification: high-resolution tiles", "a smaller magnification"],
    ),
    (
        "stages: {detection: {command: python3 my.py}}",
        &["stages.detection.command", "must be a list"],
    ),
    (
        "inertial: {source: recording}",
        &["inertial.source", "only the recording of a flight", "FILE.mcap"],
    ),
    (
        "recording: {folder: here, frames: camera}",
        &["recording.frames", "source.input: sim has no coded video", "every: 1"],
    ),
    ("source: {input: ''}", &["source.input", "must not be empty"]),
    ("profile: repeat\nsource: {at_end: loop}", &["line 2", "a lossless run ends"]),
    (
        "simulator: {swarm: {drone: 2, start_ns: 0}}",
        &["simulator.swarm.drone", "drone 2 of a swarm of 2, counted from 0"],
    ),
    ("simulator: {swarm: {drone: 0}}", &["simulator.swarm", "start_ns"]),
    (
        "profile: repeat\nsimulator: {swarm: {drone: 0, start_ns: 0}}",
        &["line 2", "simulator.swarm", "profile: flight"],
    ),
    (
        "observer: {observer_from_camera: {orientation: [0, 0, 1, 0]}}\n\
         simulator: {swarm: {drone: 0, start_ns: 0}}",
        &["line 2", "simulator.swarm", "must not be turned"],
    ),
];

#[test]
fn wrong_files_are_refused_with_place_and_cure() {
    for (yaml, wanted) in WRONG {
        let message = parse(yaml).expect_err(yaml).to_string();
        for part in *wanted {
            assert!(message.contains(part), "{yaml:?} must say {part:?}, but says:\n{message}");
        }
        assert!(message.contains("line "), "{yaml:?} must say where:\n{message}");
    }
}

#[test]
fn all_problems_come_at_once() {
    let error = parse("camra: {}\nprofile: fast\nsearch: {mode: 3, processors: 0}\n").unwrap_err();
    let ConfigError::Problems { problems, .. } = &error else { panic!("{error}") };
    assert_eq!(problems.len(), 4, "{error}");
    assert!(error.to_string().starts_with("pipeline.yaml has 4 problems:"), "{error}");
}

#[test]
fn overrides_are_checked_like_the_file() {
    let overrides = ["search.mode=exhaustive".to_owned(), "profile=stills".to_owned()];
    let pipeline = Pipeline::parse("", &overrides, "pipeline.yaml").unwrap();
    assert_eq!((pipeline.search.mode, pipeline.profile), (SearchMode::Exhaustive, Profile::Stills));
    let error = Pipeline::parse("", &["serach.mode=roi".to_owned()], "x").unwrap_err().to_string();
    assert!(
        error.contains("--set serach.mode=roi") && error.contains("did you mean 'search'?"),
        "{error}"
    );
}

fn resolved(pipeline: &Pipeline) -> Resolved {
    Resolved::of(pipeline.clone()).unwrap()
}

#[test]
fn a_partition_has_as_many_views_as_are_wanted() {
    for count in [5, 32, 33, 128] {
        let pipeline = parse(&format!("partition: {{count: {count}}}")).unwrap();
        let views = resolved(&pipeline).partition_views;
        assert_eq!(views.len(), count);
        assert_eq!(resolved(&pipeline).partition_views, views);
        // What the launcher resolved is what the stages read.
        let json = serde_json::to_string(&pipeline).unwrap();
        assert_eq!(serde_json::from_str::<Pipeline>(&json).unwrap(), pipeline);
    }
    let pipeline = parse("partition: {method: paper}").unwrap();
    assert_ne!(
        resolved(&pipeline).division.partition,
        resolved(&Pipeline::default()).division.partition
    );
}

mod former_keys;
