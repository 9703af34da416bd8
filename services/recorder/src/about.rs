//! Metadata of a recording: the facts about its pipeline.

use anyhow::Context as _;
use flockeye_config::{Coding, Flow, RESOLVED, Resolved};
use flockeye_contract::CONTRACT_VERSION;
use flockeye_recording::About;
use flockeye_runtime::clock;
use flockeye_runtime::instance::Instance;

use crate::core::Core;

/// The metadata at the beginning of a recording, and the core of the recorder.
pub(crate) fn beginning(instance: &Instance, resolved: &Resolved) -> anyhow::Result<(About, Core)> {
    let pipeline = &resolved.pipeline;
    let path = instance.folder().join("pipeline.json");
    let json = std::fs::read(&path).with_context(|| path.display().to_string())?;
    let mut parsed: serde_json::Value =
        serde_json::from_slice(&json).with_context(|| path.display().to_string())?;
    // Resolve `auto` now: it depends on files that may be missing at a replay.
    let coding = if pipeline.is_coded_as_video() { Coding::Video } else { Coding::Images };
    parsed["fusion"]["coding"] = serde_json::to_value(coding)?;
    let bodies = serde_json::to_vec(&parsed[RESOLVED]["bodies"])?;
    let utc_from_monotonic_ns = clock::utc_ns() - clock::monotonic_ns();
    let flow = pipeline.flow();
    let utc_from_exposure_ns = match flow {
        Flow::Latest => utc_from_monotonic_ns,
        // Exposure times are stream times; the stream begins now.
        Flow::Lossless => clock::utc_ns(),
    };
    let facts = [
        ("format", "1"),
        ("contract", CONTRACT_VERSION),
        ("version", env!("CARGO_PKG_VERSION")),
        ("instance", instance.name()),
        ("observer", &pipeline.observer.name),
        ("swarm", &pipeline.observer.swarm),
        ("flow", flow.name()),
        ("utc_from_exposure_ns", &utc_from_exposure_ns.to_string()),
    ];
    let json_type = "application/json".to_owned();
    let about = About {
        utc_from_monotonic_ns,
        metadata: facts.map(|(name, value)| (name.to_owned(), value.to_owned())).into(),
        attachments: vec![
            ("pipeline.json".to_owned(), json_type.clone(), serde_json::to_vec(&parsed)?),
            ("bodies.json".to_owned(), json_type, bodies),
        ],
    };
    Ok((about, Core::new(&pipeline.observer.name, utc_from_exposure_ns)))
}
