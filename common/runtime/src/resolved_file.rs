//! Values derived from a configuration, as JSON: the section `resolved` of the instance's
//! `pipeline.json`. A stage in another language need not compute them.

use flockeye_config::Resolved;
use flockeye_geometry::view::View;
use serde_json::{Map, Value, json};

use crate::memory::{Budget, Limits};

/// The section. docs/CONTRACT.md lists its fields.
pub fn section(resolved: &Resolved) -> Value {
    let budget = Budget::of(resolved);
    let mount = &resolved.observer_from_camera;
    json!({
        "workers": resolved.pipeline.detection_workers(),
        "largest_view_px": resolved.largest_view_px(),
        "observer_from_camera": {
            "position": mount.translation.vector.as_slice(),
            "orientation": mount.rotation.coords.as_slice(),
        },
        "partitions": views(&resolved.partition_views),
        "high_resolution_tiles": views(&resolved.high_resolution_tiles),
        "bodies": bodies(resolved),
        "topics": budget.topics.iter().map(topic).collect::<Map<String, Value>>(),
    })
}

/// Bodies in the form of a bodies file, with every corner and facet, and the `target` number of
/// each.
pub fn bodies(resolved: &Resolved) -> Value {
    let mut bodies = resolved.bodies.to_json();
    for (target, body) in resolved.bodies.iter().enumerate() {
        bodies["bodies"][&body.name]["target"] = target.into();
    }
    bodies
}

fn views(views: &[View]) -> Value {
    let view = |view: &View| {
        json!({
            "direction_in_camera": view.direction_in_camera().as_slice(),
            "camera_from_view": view.camera_from_view.coords.as_slice(),
            "focal_px": view.focal_px,
            "size_px": view.size_px,
        })
    };
    views.iter().map(view).collect()
}

fn topic(limits: &Limits) -> (String, Value) {
    let value = json!({
        "lanes": limits.has_lanes.then_some(limits.lanes),
        "publishers": limits.publishers,
        "subscribers": limits.subscribers,
        "buffer": limits.buffer,
        "borrowed": limits.borrowed,
        "history": limits.history,
        "loaned": limits.loaned,
        "items": limits.items,
        "grows_to": limits.grows_to,
        "item_bytes": limits.item_bytes,
        "header_bytes": limits.header_bytes,
        "waits_for_readers": limits.patience.is_some(),
    });
    (limits.topic.to_owned(), value)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_config::Pipeline;
    use flockeye_geometry::body::Bodies;

    #[test]
    fn nothing_is_left_to_be_worked_out() {
        let resolved = Resolved::of(Pipeline::default()).unwrap();
        let section = section(&resolved);
        let bodies = section["bodies"].to_string();
        assert_eq!(Bodies::from_json(&bodies).unwrap().len(), resolved.bodies.len());
        for (target, body) in resolved.bodies.iter().enumerate() {
            assert_eq!(section["bodies"]["bodies"][&body.name]["target"], target);
        }
        assert_eq!(section["partitions"].as_array().unwrap().len(), resolved.partition_views.len());
        let frames = &section["topics"]["flockeye/frame"];
        assert_eq!(frames["items"], 3840 * 1920);
        assert!(frames["lanes"].is_null());
        assert_eq!(section["topics"]["flockeye/view"]["lanes"], section["workers"]);
    }
}
