//! What no schema can say: values that contradict each other, names, rotations.

use flockeye_geometry::partition::{PartitionError, Weights};

use super::document::Node;
use super::{
    BodySet, Count, Flow, Fusion, Mount, Partition, Pipeline, Problem, Problems, Response,
    StageProcess,
};
use crate::sphere::SphereViewsError;

/// Adds everything about `pipeline` that cannot be meant to `problems`.
pub(super) fn check(pipeline: &Pipeline, document: &Node, problems: &mut Problems) {
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
    meaning.fusion(&pipeline.fusion);
    meaning.network(pipeline);
    meaning.stages(pipeline);
}

struct Meaning<'a> {
    document: &'a Node,
    problems: &'a mut Problems,
}

impl Meaning<'_> {
    fn problem(&mut self, path: &str, what: String) {
        self.problems.add(Problem::new(self.document.origin_of(path), path, what));
    }

    fn instance(&mut self, name: &str) {
        if !crate::instance::is_instance_name(name) {
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
        let norm = mount.orientation.iter().map(|q| q * q).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > 1e-3 {
            self.problem(
                &format!("{path}.orientation"),
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
        if let Err(fault) = pipeline.camera_model() {
            self.problem(&fault.key, fault.reason);
        }
        if pipeline.camera.response == Response::Table
            && let Err(fault) = pipeline.response_table()
        {
            self.problem(&fault.key, fault.reason);
        }
    }

    fn bodies(&mut self, bodies: &BodySet) {
        if bodies.file.is_some() {
            return; // read, and refused, by whoever opens it: see `Pipeline::bodies`
        }
        for (index, body) in bodies.list.iter().enumerate() {
            self.name(&format!("bodies.list.{index}.name"), &body.name);
            self.mount(
                &format!("bodies.list.{index}.target_from_markers"),
                &body.target_from_markers,
            );
            if body.marker_m > body.edge_m {
                self.problem(
                    &format!("bodies.list.{index}.marker_m"),
                    format!(
                        "a marker of {} m does not fit a facet of {} m",
                        body.marker_m, body.edge_m
                    ),
                );
            }
        }
        if let Err(error) = super::super::bodies::from_presets(bodies) {
            self.problem("bodies.list", error.to_string());
        }
    }

    fn partition(&mut self, pipeline: &Pipeline) {
        let partition = &pipeline.partition;
        if let Err(error) = Weights::new(partition.weights) {
            return self.problem("partition.weights", error.to_string());
        }
        // The markers of a file are not known yet: see `Pipeline::partition_views`.
        let markers = pipeline.bodies.list.iter().map(|body| body.marker_m);
        let largest_m = match pipeline.bodies.file {
            Some(_) => 0.0,
            None => markers.fold(0.0, f64::max),
        };
        let error = match pipeline.partition_field_rad(largest_m) {
            Err(error) => error,
            Ok(_) => {
                if let Err(error @ SphereViewsError::TooLarge { .. }) =
                    pipeline.partition_views(largest_m)
                {
                    let text = error.to_string();
                    let what = text.trim_start_matches("partition.count: ").to_owned();
                    self.problem("partition.count", what);
                }
                return;
            }
        };
        if !matches!(error, PartitionError::Field { .. }) {
            return self.problem("partition", error.to_string());
        }
        // What was written and made it so.
        let path = match (partition.margin_deg, partition.count) {
            (Some(_), _) => "partition.margin_deg",
            (None, Count::Chosen(_)) if partition.weights != Partition::default().weights => {
                "partition.weights"
            }
            (None, Count::Chosen(_)) => "partition.nearest_m",
            (None, count) if count == Partition::default().count => "partition.nearest_m",
            (None, Count::Views(_)) => "partition.count",
        };
        let reason = match partition.margin_deg {
            Some(_) => String::new(),
            None => format!("a marker of {largest_m} m at {} m: ", partition.nearest_m),
        };
        self.problem(path, format!("{reason}{error}"));
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
        if pipeline.flow == Flow::Lossless && pipeline.source.at_end == super::AtEnd::Loop {
            self.problem(
                "source.at_end",
                "a lossless run ends with its recording: use stop".into(),
            );
        }
    }

    fn fusion(&mut self, fusion: &Fusion) {
        let Fusion { confirm_hits, confirm_window, .. } = *fusion;
        if confirm_hits > confirm_window {
            self.problem(
                "fusion.confirm_hits",
                format!(
                    "{confirm_hits} measurements among {confirm_window} frames: raise \
                     fusion.confirm_window"
                ),
            );
        }
    }

    fn network(&mut self, pipeline: &Pipeline) {
        let lists = [
            ("gateway.listen", &pipeline.gateway.listen),
            ("gateway.connect", &pipeline.gateway.connect),
        ];
        for (path, endpoints) in lists {
            for (index, endpoint) in endpoints.iter().enumerate() {
                let is_endpoint = endpoint.split_once('/').is_some_and(|(protocol, address)| {
                    ["tcp", "udp"].contains(&protocol) && address.contains(':')
                });
                if !is_endpoint {
                    self.problem(
                        &format!("{path}.{index}"),
                        format!("'{endpoint}' is no endpoint: write tcp/ADDRESS:PORT or udp/ADDRESS:PORT"),
                    );
                }
            }
        }
    }

    fn stages(&mut self, pipeline: &Pipeline) {
        for (name, stage) in pipeline.stages.iter() {
            if stage.replicas.is_some_and(|replicas| replicas > 1) && name != "detection" {
                self.problem(
                    &format!("stages.{name}.replicas"),
                    format!("only detection runs in several processes, {name} in one"),
                );
            }
            self.rising(&format!("stages.{name}.backoff_s"), stage.backoff_s, 0.01);
        }
    }
}

impl super::Stages {
    /// Every stage with its name, in the order of the dataflow.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, &StageProcess)> {
        [
            ("capture", &self.capture),
            ("simulator", &self.simulator),
            ("rectification", &self.rectification),
            ("detection", &self.detection),
            ("fusion", &self.fusion),
            ("gateway", &self.gateway),
        ]
        .into_iter()
    }
}
