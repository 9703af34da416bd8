//! Semantic validation: contradictory values, names, rotations.

use std::net::IpAddr;

use flockeye_contract::{StageName, Transfer};
use flockeye_geometry::body::{Bodies, Body};
use flockeye_geometry::partition::PartitionError;

use crate::document::Node;
use crate::instance_name::is_instance_name;
use crate::problem::Problem;
use crate::resolve::{self, Division, preset_body};
use crate::types::{
    AtEnd, BodySet, Flow, Gateway, GatewayMode, InertialSource, MavlinkAddress, Mount,
    PartitionSettings, Pipeline, Preset, PresetBody, RecordedFrames, may_have_replicas,
};

/// Semantic validation: appends each violated constraint of `pipeline` to `problems`.
pub(super) fn check(pipeline: &Pipeline, document: &Node, problems: &mut Vec<Problem>) {
    let mut meaning = Meaning { document, problems };
    meaning.instance(&pipeline.instance.0);
    meaning.name("observer.name", &pipeline.observer.name);
    meaning.name("observer.swarm", &pipeline.observer.swarm);
    meaning.mount("observer.observer_from_camera", &pipeline.observer.observer_from_camera);
    meaning.camera(pipeline);
    meaning.bodies(&pipeline.bodies);
    meaning.partition(pipeline);
    meaning.rising("source.reopen_s", pipeline.source.reopen_s, 0.01);
    meaning.rising("simulator.distance_m", pipeline.simulator.distance_m, 0.2);
    meaning.source(pipeline);
    meaning.inertial(pipeline);
    meaning.network(pipeline);
    meaning.stages(pipeline);
}

struct Meaning<'a> {
    document: &'a Node,
    problems: &'a mut Vec<Problem>,
}

impl Meaning<'_> {
    fn problem(&mut self, path: &str, what: String) {
        self.problems.push(Problem::new(self.document.origin_of(path), path, what));
    }

    fn instance(&mut self, name: &str) {
        if !is_instance_name(name) {
            self.problem(
                "instance",
                format!("'{name}' cannot be a name here: use 1 to 31 letters, digits, '-' and '_'"),
            );
        }
    }

    fn name(&mut self, path: &str, name: &str) {
        if !flockeye_contract::wire::is_name(name) {
            self.problem(
                path,
                format!("'{name}' cannot be a name: use 1 to 31 letters, digits, '-', '_' and '.'"),
            );
        }
    }

    fn mount(&mut self, path: &str, mount: &Mount) {
        self.rotation(&format!("{path}.orientation"), &mount.orientation);
    }

    fn rotation(&mut self, path: &str, quaternion: &[f64; 4]) {
        let norm = quaternion.iter().map(|q| q * q).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > 1e-3 {
            self.problem(
                path,
                format!("a rotation's quaternion x, y, z, w has length 1, not {norm:.4}"),
            );
        }
    }

    /// Two positive numbers, the first no larger than the second.
    fn rising(&mut self, path: &str, [low, high]: [f64; 2], least: f64) {
        if !(low >= least && high >= low) {
            self.problem(
                path,
                format!("must be two rising numbers from {least}, not [{low}, {high}]"),
            );
        }
    }

    fn camera(&mut self, pipeline: &Pipeline) {
        for (index, lens) in pipeline.camera.lenses.iter().enumerate() {
            self.mount(&format!("camera.lenses.{index}.camera_from_lens"), &lens.camera_from_lens);
        }
        for (index, lens) in pipeline.simulator.lenses.iter().enumerate() {
            self.mount(
                &format!("simulator.lenses.{index}.camera_from_lens"),
                &lens.camera_from_lens,
            );
        }
        let drawn = resolve::simulated_camera(pipeline).err();
        // A fault of the camera is also a fault of the drawn one.
        let fault = resolve::camera(&pipeline.camera).err().or(drawn);
        if let Some(fault) = fault {
            self.problem(&fault.key, fault.reason);
        }
        if pipeline.camera.response == Some(Transfer::Table)
            && let Err(fault) = resolve::response_table(&pipeline.camera)
        {
            self.problem(&fault.key, fault.reason);
        }
    }

    fn bodies(&mut self, bodies: &BodySet) {
        if bodies.file.is_some() {
            return; // read, and refused, by whoever opens it: see `Resolved::of`
        }
        let mut known = Vec::new();
        for (index, entry) in bodies.list.iter().enumerate() {
            let path = format!("bodies.list.{index}");
            self.name(&format!("{path}.name"), &entry.name);
            self.mount(&format!("{path}.target_from_markers"), &entry.target_from_markers);
            self.keys_of_preset(&path, entry);
            let Some(body) = preset_body(entry) else { continue };
            self.sizes(&path, &body);
            known.push(body);
        }
        // Bodies of a file are not known yet: see `Resolved::of`.
        let is_all = known.len() == bodies.list.len();
        if (is_all || !known.is_empty())
            && let Err(error) = Bodies::new(bodies.dictionary.clone(), known)
        {
            self.problem("bodies.list", error.to_string());
        }
    }

    /// Keys that only some presets have.
    fn keys_of_preset(&mut self, path: &str, entry: &PresetBody) {
        let is_custom = entry.preset == Preset::Custom;
        if is_custom && entry.file.is_none() {
            self.problem(
                &format!("{path}.file"),
                "a custom body is in a JSON file: say which".into(),
            );
        }
        let sizes = [
            ("edge_m", entry.edge_m, !is_custom),
            ("marker_m", entry.marker_m, !is_custom),
            ("small_marker_m", entry.small_marker_m, entry.preset == Preset::Truncated),
            ("small_shift_m", entry.small_shift_m, entry.preset == Preset::Truncated),
        ];
        let mut foreign: Vec<&str> = sizes
            .iter()
            .filter(|(_, value, is_own)| value.is_some() && !is_own)
            .map(|(key, ..)| *key)
            .collect();
        if entry.file.is_some() && !is_custom {
            foreign.push("file");
        }
        for key in foreign {
            let preset = entry.preset.name();
            self.problem(
                &format!("{path}.{key}"),
                format!("the preset {preset} has no {key}: leave it out"),
            );
        }
    }

    /// Whether every marker fits its facet.
    fn sizes(&mut self, path: &str, body: &Body) {
        let misfit = body.facets().iter().find_map(|facet| {
            let marker = &body.markers[facet.marker?];
            (!facet.holds(marker, 1e-9)).then_some((facet, marker))
        });
        let Some((facet, marker)) = misfit else { return };
        let (side, edge) = (marker.side(), (facet.outline[1] - facet.outline[0]).norm());
        let (key, shape) = match facet.outline.len() {
            3 => ("small_marker_m", "a triangle with edges"),
            _ => ("marker_m", "a facet"),
        };
        self.problem(
            &format!("{path}.{key}"),
            format!("a marker of {} m does not fit {shape} of {} m", rounded(side), rounded(edge)),
        );
    }

    fn partition(&mut self, pipeline: &Pipeline) {
        let partition = &pipeline.partition;
        // The markers of a file are not known yet: see `Resolved::of`.
        let markers = pipeline.bodies.list.iter().filter_map(preset_body);
        let largest_m = match pipeline.bodies.file {
            Some(_) => 0.0,
            None => markers.map(|body| body.largest_side()).fold(0.0, f64::max),
        };
        let error = match Division::of(partition, largest_m) {
            Err(error) => error,
            Ok(division) => {
                // A fault of the camera is reported at the camera's keys.
                let Ok(camera) = resolve::camera(&pipeline.camera) else { return };
                let near = division.views(pipeline, &camera).err();
                let far = resolve::high_resolution_tiles(pipeline, &camera).err();
                for fault in [near, far].into_iter().flatten() {
                    // A fault of the partition itself is left to `Resolved::of`.
                    if fault.key != resolve::PARTITION {
                        self.problem(&fault.key, fault.reason);
                    }
                }
                return;
            }
        };
        if !matches!(error, PartitionError::Field { .. }) {
            return self.problem("partition", error.to_string());
        }
        // The key whose value caused it.
        let path = match partition.count == PartitionSettings::default().count {
            true => "partition.nearest_m",
            false => "partition.count",
        };
        let (largest_m, nearest_m) = (rounded(largest_m), partition.nearest_m);
        self.problem(path, format!("a marker of {largest_m} m at {nearest_m} m: {error}"));
    }

    fn source(&mut self, pipeline: &Pipeline) {
        if pipeline.source.input.trim().is_empty() {
            self.problem(
                "source.input",
                "must not be empty: write sim, a file, a folder or a camera".into(),
            );
        }
        let bodies = pipeline.bodies.list.len();
        if pipeline.bodies.file.is_none() && pipeline.simulator.neighbours as usize > bodies {
            self.problem(
                "simulator.neighbours",
                format!(
                    "{} neighbours, but {bodies} bodies are configured",
                    pipeline.simulator.neighbours
                ),
            );
        }
        let frame_ms = 1e3 / pipeline.simulator.frames_per_second;
        if pipeline.simulator.exposure_ms > frame_ms {
            self.problem(
                "simulator.exposure_ms",
                format!(
                    "an exposure of {} ms in a frame of {frame_ms:.2} ms",
                    pipeline.simulator.exposure_ms
                ),
            );
        }
        self.simulated_swarm(pipeline);
        let recording = &pipeline.recording;
        let wants_packets =
            recording.folder.is_some() && recording.frames == RecordedFrames::Camera;
        if wants_packets && !pipeline.source.may_send_packets() {
            let input = &pipeline.source.input;
            let what = format!(
                "source.input: {input} has no coded video of its own. Cure: frames: every, with every: 1"
            );
            self.problem("recording.frames", what);
        }
        if pipeline.flow() == Flow::Lossless && pipeline.source.at_end == AtEnd::Loop {
            self.problem(
                "source.at_end",
                "a lossless run ends with its recording: use stop".into(),
            );
        }
    }

    fn simulated_swarm(&mut self, pipeline: &Pipeline) {
        let Some(swarm) = pipeline.simulator.swarm else { return };
        let path = "simulator.swarm";
        let neighbours = pipeline.simulator.neighbours;
        if swarm.drone > neighbours {
            self.problem(
                &format!("{path}.drone"),
                format!(
                    "drone {} of a swarm of {}, counted from 0: simulator.neighbours are the others",
                    swarm.drone,
                    neighbours + 1
                ),
            );
        }
        if pipeline.flow() == Flow::Lossless {
            let what =
                "its drones fly by one clock: a lossless run has its own. Cure: profile: flight";
            self.problem(path, what.into());
        }
        let [x, y, z, _] = pipeline.observer.observer_from_camera.orientation;
        if [x, y, z].iter().any(|part| part.abs() > 1e-6) {
            let what = "its cameras are level: observer.observer_from_camera must not be turned";
            self.problem(path, what.into());
        }
    }

    fn inertial(&mut self, pipeline: &Pipeline) {
        let path = "inertial.source";
        self.rotation("inertial.camera_from_sensor", &pipeline.inertial.camera_from_sensor);
        self.rotation(
            "simulator.inertial.camera_from_sensor",
            &pipeline.simulator.inertial.camera_from_sensor,
        );
        let is_simulated = pipeline.source.stage() == StageName::Simulator;
        match pipeline.inertial.parsed_source() {
            Err(problem) => self.problem(path, problem),
            Ok(InertialSource::Simulated) if !is_simulated => {
                self.problem(
                    path,
                    "only the simulated world has this one: source.input: sim".into(),
                );
            }
            Ok(InertialSource::Recording) if !pipeline.source.is_flight() => self.problem(
                path,
                "only the recording of a flight has this one: source.input: FILE.mcap".into(),
            ),
            Ok(InertialSource::Recorded(_)) if is_simulated => self.problem(
                path,
                "a recorded sensor belongs to a recording, not to source.input: sim".into(),
            ),
            Ok(InertialSource::Mavlink(_)) if pipeline.flow() == Flow::Lossless => self.problem(
                path,
                "a lossless run is not in real time, an autopilot is: use profile: flight".into(),
            ),
            Ok(_) => {}
        }
    }

    fn network(&mut self, pipeline: &Pipeline) {
        let lists = [
            ("gateway.listen", &pipeline.gateway.listen),
            ("gateway.connect", &pipeline.gateway.connect),
        ];
        let is_secure = pipeline.gateway.security.is_some();
        for (path, endpoints) in lists {
            self.endpoints(path, endpoints, is_secure);
        }
        let Gateway { mode, listen, connect, .. } = &pipeline.gateway;
        self.protection(&pipeline.gateway);
        if *mode == GatewayMode::Client && connect.is_empty() {
            let what = "a client needs a router. Cure: name its endpoint in gateway.connect";
            self.problem("gateway.mode", what.into());
        }
        if let Some(ros2) = &pipeline.ros2 {
            self.endpoints("ros2.connect", &ros2.connect, false);
            if let Some(both) = ros2.connect.iter().find(|router| listen.contains(router)) {
                let what = format!(
                    "'{both}' is in gateway.listen too: there the router of ROS 2 cannot be. Cure: another port \
                     in gateway.listen"
                );
                self.problem("ros2.connect", what);
            }
        }
        if let Some(autopilot) = &pipeline.autopilot {
            if let Err(reason) = MavlinkAddress::parse(&autopilot.link) {
                self.problem("autopilot.link", format!("'{}' {reason}", autopilot.link));
            }
            if let Some(target) = &autopilot.target {
                self.name("autopilot.target", target);
            }
            let [near, far] = autopilot.obstacle_range_m;
            // Also false where one of them is not a number.
            if !(near >= 0.0 && near < far && far <= 1000.0) {
                let what = format!("[{near}, {far}] must rise and lie within 0 to 1000");
                self.problem("autopilot.obstacle_range_m", what);
            }
            for (key, hz) in [
                ("target_hz", autopilot.target_hz),
                ("obstacles_hz", autopilot.obstacles_hz),
                ("odometry_hz", autopilot.odometry_hz),
            ] {
                if hz != 0.0 && hz < 0.5 {
                    let what = format!("{hz} a second: 0.5 to 100, or 0 for never");
                    self.problem(&format!("autopilot.{key}"), what);
                }
            }
        }
    }

    /// Requires certificates for an endpoint that others can reach, unless `unsecured` waives them.
    fn protection(&mut self, gateway: &Gateway) {
        if let (Some(_), Some(interface)) = (&gateway.security, &gateway.scout_interface) {
            let what = format!(
                "'{interface}': what comes by multicast is not protected. Cure: leave it out, and name the \
                 others in gateway.connect"
            );
            self.problem("gateway.scout_interface", what);
        }
        if gateway.security.is_some() || gateway.unsecured || !gateway.enabled {
            return;
        }
        let cure = "Cure: gateway.security (docs/SECURITY.md), or gateway.unsecured: true where all who can link are \
                    trusted";
        // A link works both ways, whichever side opened it. A client does not listen.
        let listen: &[String] =
            if gateway.mode == GatewayMode::Peer { &gateway.listen } else { &[] };
        for (key, endpoints) in [("listen", listen), ("connect", &gateway.connect)] {
            for (index, endpoint) in endpoints.iter().enumerate() {
                if !is_loopback(endpoint) {
                    let what = format!(
                        "'{endpoint}': whoever is there can speak in every drone's name. {cure}"
                    );
                    self.problem(&format!("gateway.{key}.{index}"), what);
                }
            }
        }
        if let Some(interface) = &gateway.scout_interface {
            let what = format!("'{interface}': whoever is found there can link. {cure}");
            self.problem("gateway.scout_interface", what);
        }
    }

    fn endpoints(&mut self, path: &str, endpoints: &[String], is_secure: bool) {
        let protocols: &[&str] = if is_secure { &["tls"] } else { &["tcp", "udp"] };
        for (index, endpoint) in endpoints.iter().enumerate() {
            let is_endpoint = endpoint.split_once('/').is_some_and(|(protocol, address)| {
                protocols.contains(&protocol) && address.contains(':')
            });
            if is_endpoint {
                continue;
            }
            let what = if is_secure {
                format!("'{endpoint}' is no endpoint of gateway.security: write tls/ADDRESS:PORT")
            } else if endpoint.starts_with("tls/") {
                format!("'{endpoint}' needs gateway.security (docs/SECURITY.md)")
            } else {
                format!("'{endpoint}' is no endpoint: write tcp/ADDRESS:PORT or udp/ADDRESS:PORT")
            };
            self.problem(&format!("{path}.{index}"), what);
        }
    }

    fn stages(&mut self, pipeline: &Pipeline) {
        for (stage_name, stage) in pipeline.stages.iter() {
            let name = stage_name.name();
            let has_replicas = stage.replicas.is_some_and(|replicas| replicas > 1);
            if has_replicas && !may_have_replicas(stage_name) {
                self.problem(
                    &format!("stages.{name}.replicas"),
                    format!("only detection runs in several processes, {name} in one"),
                );
            }
            self.rising(&format!("stages.{name}.backoff_s"), stage.backoff_s, 0.01);
        }
    }
}

/// A size recomputed from corners, without their rounding.
fn rounded(length_m: f64) -> f64 {
    (length_m * 1e9).round() / 1e9
}

/// Whether only this machine can reach an endpoint.
fn is_loopback(endpoint: &str) -> bool {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, address)| address);
    let address = address.split(['#', '?']).next().unwrap_or(address);
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    let is_local = |ip: IpAddr| ip.is_loopback();
    host == "localhost" || host.trim_matches(['[', ']']).parse().is_ok_and(is_local)
}
