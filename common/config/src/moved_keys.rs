//! Sections of the release before that stand elsewhere now. They are moved, with a warning that names their successor.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use serde_json::Value;

use crate::document::{Data, Key, Node};
use crate::problem::{Problem, Problems};

/// The section and key of each, and the key at the top that it is now.
const MOVED: [(&str, &str, &str); 2] =
    [("gateway", "ros2", "ros2"), ("gateway", "autopilot", "autopilot")];

/// Moves the sections. One that is written in both places is added to `problems`.
pub(crate) fn translate(document: &mut Node, problems: &mut Problems) {
    for (section, name, today) in MOVED {
        let Some(node) = take(document, section, name) else { continue };
        let Data::Section(entries) = &mut document.data else { continue };
        let former = format!("{section}.{name}");
        let at_top = entries.iter().find(|(key, node)| key.name == today && !is_empty(node));
        if let Some((key, _)) = at_top {
            let what =
                format!("{today} is written at {} too. Cure: leave {former} out", key.origin);
            problems.add(Problem::new(node.origin, &former, what));
            continue;
        }
        warn(format!(
            "{}: {former} is called {today} now; the next release refuses it",
            node.origin
        ));
        entries.retain(|(key, _)| key.name != today);
        entries.push((Key { origin: node.origin.clone(), name: today.to_owned() }, node));
    }
}

/// Removes a key from a section, and gives its value where it has one.
fn take(document: &mut Node, section: &str, name: &str) -> Option<Node> {
    let Data::Section(entries) = &mut document.data else { return None };
    let (_, node) = entries.iter_mut().find(|(key, _)| key.name == section)?;
    let Data::Section(entries) = &mut node.data else { return None };
    let index = entries.iter().position(|(key, _)| key.name == name)?;
    Some(entries.remove(index).1).filter(|node| !is_empty(node))
}

fn is_empty(node: &Node) -> bool {
    matches!(node.data, Data::Scalar(Value::Null))
}

/// Logs a warning once in each process.
fn warn(text: String) {
    static GIVEN: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    if GIVEN.lock().unwrap_or_else(PoisonError::into_inner).insert(text.clone()) {
        tracing::warn!("{text}");
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::Pipeline;

    fn parse(yaml: &str, overrides: &[&str]) -> Result<Pipeline, String> {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        Pipeline::parse(yaml, &overrides, "pipeline.yaml").map_err(|error| error.to_string())
    }

    #[test]
    fn a_section_is_found_at_its_former_place() {
        let yaml = "gateway: {listen: [tcp/127.0.0.1:7448], ros2: {domain: 7}, autopilot: {system_id: 9}}\nros2:";
        let pipeline = parse(yaml, &[]).unwrap();
        assert_eq!(pipeline.ros2.unwrap().domain, 7);
        assert_eq!(pipeline.autopilot.unwrap().system_id, 9);
        let listen = "gateway: {listen: [tcp/127.0.0.1:7448]}";
        let pipeline = parse(listen, &["gateway.ros2.domain=8"]).unwrap();
        assert_eq!(pipeline.ros2.unwrap().domain, 8);
        assert_eq!(parse("gateway: {ros2: , autopilot: }", &[]).unwrap().ros2, None);
    }

    #[test]
    fn a_section_in_both_places_is_refused_and_its_values_are_checked() {
        let both = parse("ros2: {domain: 1}\ngateway: {ros2: {domain: 2}}", &[]).unwrap_err();
        assert!(both.contains("line 2") && both.contains("leave gateway.ros2 out"), "{both}");
        let wrong = parse("gateway: {autopilot: {system_id: 0}}", &[]).unwrap_err();
        assert!(wrong.contains("autopilot.system_id"), "{wrong}");
    }
}
