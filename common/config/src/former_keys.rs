//! Keys of earlier releases: translated for one release, or refused with what became of them.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

use serde_json::{Value, json};

use crate::document::{Data, Node};
use crate::problem::{Origin, Problem, Problems};
use crate::schema;
use crate::types::Profile;

/// The key that says how a pipeline runs.
const PROFILE: &str = "profile";

/// The keys that said it before, each with its values, the default first.
const FORMER_PROFILE: [(&str, [&str; 2]); 3] = [
    ("flow", ["latest", "lossless"]),
    ("search.budget", ["flight", "unlimited"]),
    ("fusion.filter", ["constant_velocity", "none"]),
];

/// Whether a setting `key.path=value` says how the pipeline runs, by today's key or a former one.
pub fn says_how_it_runs(setting: &str) -> bool {
    let key = setting.split('=').next().unwrap_or_default().trim();
    key == PROFILE || FORMER_PROFILE.iter().any(|(former, _)| *former == key)
}

/// Translates the former keys of `document`. What contradicts itself is added to `problems`, and what
/// became of each key to `notices`.
pub(crate) fn translate(document: &mut Node, problems: &mut Problems, notices: &mut Vec<String>) {
    profile(document, problems, notices);
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
fn profile(document: &mut Node, problems: &mut Problems, notices: &mut Vec<String>) {
    let found_before = problems.0.len();
    let mut written = Vec::new();
    for (path, values) in FORMER_PROFILE {
        let Some(node) = document.take(path) else { continue };
        schema::check_at(&node, &json!({ "enum": values }), path, problems);
        if let Data::Scalar(Value::String(value)) = node.data {
            written.push(Former { path, origin: node.origin, value });
        }
    }
    let Some(first) = written.first() else { return };
    if problems.0.len() > found_before {
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
                problems.add(Problem::new(key.origin.clone(), key.path, what));
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
            document.add(PROFILE, first.origin.clone(), Value::from(name));
        }
        Err((path, what)) => {
            let origin =
                written.iter().find(|key| key.path == path).unwrap_or(first).origin.clone();
            problems.add(Problem::new(origin, path, format!("{names}: {what}")));
        }
    }
}

/// The profile that means what the former keys meant, or the key that no profile agrees with, and why.
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
