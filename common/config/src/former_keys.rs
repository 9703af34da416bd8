//! Keys of earlier releases: translated for one release, or refused with the present way.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use serde_json::{Value, json};

use crate::document::{Data, Node};
use crate::problem::{Origin, Problem};
use crate::schema;
use crate::types::Profile;

/// The key that selects how a pipeline runs.
const PROFILE: &str = "profile";

/// Its former keys, each with its values, the default first.
const FORMER_PROFILE: [(&str, [&str; 2]); 3] = [
    ("flow", ["latest", "lossless"]),
    ("search.budget", ["flight", "unlimited"]),
    ("fusion.filter", ["constant_velocity", "none"]),
];

/// Renamed keys: former name, present name.
const MOVED: [(&str, &str); 3] = [
    ("search.costs.processors", "search.processors"),
    ("gateway.ros2", "ros2"),
    ("gateway.autopilot", "autopilot"),
];

/// Sections whose keys were all removed.
const GONE: [&str; 1] = ["search.costs"];

/// Renamed values: key, former value, present value.
const REWRITTEN: [(&str, &str, &str); 2] =
    [("partition.count", "auto", "12"), ("search.mode", "gaze", "roi")];

/// Reason why costs are constants.
const STATED: &str =
    "costs are the same for all machines, so that profile: repeat gives the same poses everywhere";
/// Reason why the filter's parameters are constants.
const FILTER: &str =
    "it belongs to the filter's design, and is tested and measured with this value alone";

/// Keys that became constants: the value as JSON, and the reason.
const FIXED: [(&str, &str, &str); 23] = [
    ("search.costs.source_ms", "20.0", STATED),
    ("search.costs.egomotion_ms", "2.2", STATED),
    ("search.costs.proposals_ms", "4.5", STATED),
    ("search.costs.cut_ms_per_megapixel", "2.5", STATED),
    ("search.costs.window_ms_per_megapixel", "4.0", STATED),
    ("search.costs.direct_pass_ms", "3.5", STATED),
    ("search.costs.corner_pass_ms", "4.0", STATED),
    ("search.costs.initiation_ms", "8.0", STATED),
    ("search.costs.background_pass_ms", "8.0", STATED),
    (
        "search.lossless_partitions",
        "4",
        "profile: unlimited sweeps the sphere in a few frames with it",
    ),
    ("fusion.confirm_hits", "2", FILTER),
    ("fusion.confirm_window", "5", FILTER),
    ("fusion.history_s", "0.5", FILTER),
    ("fusion.gate_probability", "0.999", FILTER),
    ("fusion.restart_after_gated", "3", FILTER),
    (
        "partition.weights",
        "[0.2, 0.02, 0.78]",
        "flockeye partition --weights compares others, for partition.count",
    ),
    ("partition.seed", "1", "other starts give partitions that are as good"),
    ("partition.margin_deg", "null", "partition.nearest_m says how far views overlap"),
    ("partition.magnification", "null", "the profile says it: 1, and 2 for stills"),
    ("simulator.lens_blur_px", "0.8", "it is that of the cameras that were measured"),
    ("fusion.angular_acceleration", "3.0", FILTER),
    ("autopilot.max_age_ms", "500", "an older pose is no obstacle's place any more"),
    ("recording.split_mb", "1000", "flockeye record --split takes another size"),
];

/// Defaults of the last release that differ from the constants. Its recordings have them.
const FORMER_DEFAULTS: [(&str, &str); 1] = [("search.costs.background_pass_ms", "45.0")];

/// Whether a setting `key.path=value` selects how the pipeline runs, by the present key or a former
/// one.
pub fn says_how_it_runs(setting: &str) -> bool {
    let key = setting.split('=').next().unwrap_or_default().trim();
    key == PROFILE || FORMER_PROFILE.iter().any(|(former, _)| *former == key)
}

/// Translates the former keys of `document`. Contradictions are added to `problems`, and
/// translations to `notices`.
pub(crate) fn translate(
    document: &mut Node,
    problems: &mut Vec<Problem>,
    notices: &mut Vec<String>,
) {
    profile(document, problems, notices);
    moved(document, problems, notices);
    rewritten(document, notices);
    fixed(document, problems, notices);
}

/// Renames former keys.
fn moved(document: &mut Node, problems: &mut Vec<Problem>, notices: &mut Vec<String>) {
    for (former, today) in MOVED {
        let Some(node) = document.take(former) else { continue };
        let origin = node.origin.clone();
        if matches!(node.data, Data::Scalar(Value::Null)) {
            continue;
        }
        if document.get(today).is_some() {
            let what =
                format!("is called {today} now, which is written too. Cure: leave {former} out");
            problems.push(Problem::new(origin, former, what));
        } else {
            notices.push(format!(
                "{origin}: {former} is called {today} now; the next release refuses it"
            ));
            document.put(today, node);
        }
    }
}

/// Renames former values.
fn rewritten(document: &mut Node, notices: &mut Vec<String>) {
    for (path, former, today) in REWRITTEN {
        let is_former = |node: &&Node| matches!(&node.data, Data::Scalar(Value::String(text)) if text == former);
        let Some(origin) = document.get(path).filter(is_former).map(|node| node.origin.clone())
        else {
            continue;
        };
        notices.push(format!(
            "{origin}: {path}: {former} is written {today} now; the next release refuses it"
        ));
        document.take(path);
        let value = serde_json::from_str(today).unwrap_or_else(|_| Value::from(today));
        document.put(path, Node { origin, data: Data::Scalar(value) });
    }
}

/// Removes keys that are constants now, and refuses values that are neither the constant nor the
/// default of the last release.
fn fixed(document: &mut Node, problems: &mut Vec<Problem>, notices: &mut Vec<String>) {
    for (path, value, why) in FIXED {
        let Some(node) = document.take(path) else { continue };
        let (origin, found) = (node.origin.clone(), node.to_json());
        if found.is_null() {
            continue;
        }
        let is_value =
            |value: &str| serde_json::from_str(value).is_ok_and(|value| is_equal(&found, &value));
        let is_former = |(key, former): &(&str, &str)| *key == path && is_value(former);
        let is_same = is_value(value) || FORMER_DEFAULTS.iter().any(is_former);
        if is_same {
            notices.push(format!("{origin}: {path} is fixed at {value} now: leave it out; the next release refuses it"));
            continue;
        }
        let fixed = match value {
            "null" => "is no key any more".to_owned(),
            _ => format!("is fixed at {value} now"),
        };
        problems.push(Problem::new(origin, path, format!("{fixed}: {why}. Cure: leave it out")));
    }
    for section in GONE {
        if document.get(section).is_none_or(|node| node.to_json() == json!({})) {
            document.take(section);
        }
    }
}

/// The constants that are numbers, in the order of the keys.
#[cfg(test)]
pub(crate) fn fixed_numbers() -> impl Iterator<Item = f64> {
    FIXED.iter().filter_map(|(_, value, _)| value.parse().ok())
}

/// Whether two values are the same, however their numbers are written.
fn is_equal(left: &Value, right: &Value) -> bool {
    match (left, right) {
        (Value::Array(left), Value::Array(right)) => {
            left.len() == right.len() && left.iter().zip(right).all(|(a, b)| is_equal(a, b))
        }
        _ => match (left.as_f64(), right.as_f64()) {
            (Some(left), Some(right)) => left == right,
            _ => left == right,
        },
    }
}

/// Writes each notice to the log, once in each process.
pub(crate) fn warn(notices: Vec<String>) {
    static GIVEN: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    let mut given = GIVEN.lock().unwrap_or_else(PoisonError::into_inner);
    for notice in notices {
        if !given.contains(&notice) {
            tracing::warn!("{notice}");
            given.insert(notice);
        }
    }
}

/// A former key that was written: its path, where, and its value.
struct Former {
    path: &'static str,
    origin: Origin,
    value: String,
}

/// `flow`, `search.budget` and `fusion.filter` together are `profile`.
fn profile(document: &mut Node, problems: &mut Vec<Problem>, notices: &mut Vec<String>) {
    let found_before = problems.len();
    let mut written = Vec::new();
    for (path, values) in FORMER_PROFILE {
        let Some(node) = document.take(path) else { continue };
        schema::check_at(&node, &json!({ "enum": values }), path, problems);
        if let Data::Scalar(Value::String(value)) = node.data {
            written.push(Former { path, origin: node.origin, value });
        }
    }
    let Some(first) = written.first() else { return };
    if problems.len() > found_before {
        return;
    }
    let names: Vec<String> =
        written.iter().map(|key| format!("{}: {}", key.path, key.value)).collect();
    let names = names.join(", ");
    if let Some(today) = document.get(PROFILE) {
        let is_of_command_line = |origin: &Origin| matches!(origin, Origin::Override(_));
        let is_replaced = is_of_command_line(&today.origin)
            && !written.iter().any(|key| is_of_command_line(&key.origin));
        if !is_replaced {
            let what = format!("{PROFILE} says it now, and is written at {}", today.origin);
            for key in &written {
                let what = format!("{what}. Cure: leave {} out", key.path);
                problems.push(Problem::new(key.origin.clone(), key.path, what));
            }
        }
        return;
    }
    let value_of = |path: &str, default: &'static str| {
        let found = written.iter().find(|key| key.path == path);
        found.map_or(default, |key| key.value.as_str())
    };
    let [flow, budget, filter] =
        FORMER_PROFILE.map(|(path, [default, _])| value_of(path, default) != default);
    match successor(flow, budget, filter) {
        Ok(profile) => {
            let name = profile.name();
            notices.push(format!(
                "{}: {names} is written {PROFILE}: {name} now; the next release refuses it",
                first.origin
            ));
            let node = Node { origin: first.origin.clone(), data: Data::Scalar(Value::from(name)) };
            document.put(PROFILE, node);
        }
        Err((path, what)) => {
            let origin =
                written.iter().find(|key| key.path == path).unwrap_or(first).origin.clone();
            problems.push(Problem::new(origin, path, format!("{names}: {what}")));
        }
    }
}

/// The profile that means what the former keys meant, or the key that no profile agrees with, and
/// why.
fn successor(
    is_lossless: bool,
    is_unlimited: bool,
    is_unfiltered: bool,
) -> Result<Profile, (&'static str, &'static str)> {
    match (is_lossless, is_unlimited, is_unfiltered) {
        // A flight goes by the clock, whatever its budget.
        (false, _, false) => Ok(Profile::Flight),
        (true, false, false) => Ok(Profile::Repeat),
        (true, true, false) => Ok(Profile::Unlimited),
        (true, false, true) => Ok(Profile::Stills),
        (false, _, true) => Err((
            "fusion.filter",
            "no profile works on frames for themselves in real time. Cure: profile: stills, which works \
             on every frame",
        )),
        (true, true, true) => Err((
            "search.budget",
            "stills have no other budget. Cure: profile: stills, or profile: unlimited with tracks",
        )),
    }
}
