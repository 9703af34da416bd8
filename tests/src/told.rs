//! Pipelines without a camera, whose fusion (`told-fusion`) sends given poses. So many real
//! gateways fit on one machine.

use crate::flockeye;

/// Settings of a pipeline whose fusion reports `targets` every `period_ms`.
pub fn settings(period_ms: u64, targets: &[&str]) -> Vec<String> {
    let fusion = flockeye().with_file_name("told-fusion");
    let mut set = vec![
        format!(
            "stages.fusion.command=[{}, \"{period_ms}\", {}]",
            fusion.display(),
            targets.join(", ")
        ),
        "stages.detection.replicas=1".to_owned(),
        "supervision.start_s=0.5".to_owned(),
        "camera.width=256".to_owned(),
        "camera.height=128".to_owned(),
    ];
    for idle in ["simulator", "rectification", "detection", "egomotion"] {
        set.push(format!("stages.{idle}.command=[sleep, \"100000\"]"));
    }
    set
}
