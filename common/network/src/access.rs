//! Rules of Zenoh's access control: which certificate may do what on a link.
//!
//! Zenoh asks which certificate the other end of the *link* has shown, and not who began to say
//! something. So every gateway and every router has these rules. Their names are literal, and they
//! hold until the session ends.

use flockeye_contract::wire::{all_frames_key, all_keys};
use flockeye_identity::Roster;
use serde_json::{Value, json};

/// All that can be asked for; nobody is told by it.
const ASK: &[&str] =
    &["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"];
/// All that can be said.
const SAY: &[&str] = &["put", "delete", "reply", "declare_queryable", "liveliness_token"];
/// What carries reports.
const REPORT: &[&str] = &["put", "reply"];

/// The rules of a swarm. What nothing allows is denied.
///
/// A member says what stands under its own name, and asks for all. Routers pass on all. Reports are
/// let in whatever name they bear, and judged by their signatures ([`flockeye_identity::Trust`]):
/// so whoever speaks in another's name is known and counted, where Zenoh would drop it without a
/// word. A gateway lets them in from everybody who could link; a router (`is_router`), which reads
/// no signatures, from members alone.
pub(crate) fn access_rules(roster: &Roster, is_router: bool) -> Value {
    let Roster { swarm, members, routers, .. } = roster;
    let all = all_keys(swarm, None);
    let rule = |id: String, flow: &str, messages: &[&str], keys: &[&str]| {
        json!({
            "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys,
        })
    };
    let everything = [ASK, SAY].concat();
    let reports = all_frames_key(swarm);
    let mut rules = vec![
        rule("report".into(), "ingress", REPORT, &[&reports]),
        rule("hear".into(), "egress", &["declare_subscriber"], &[&reports]),
        rule("ask".into(), "ingress", ASK, &[&all]),
        rule("pass on".into(), "ingress", &everything, &[&all]),
        rule("tell".into(), "egress", &everything, &[&all]),
    ];
    let mut subjects = Vec::new();
    let mut policies = Vec::new();
    if !is_router {
        subjects.push(json!({ "id": "anybody" }));
        policies.push(policy(&["report", "hear"], &["anybody"]));
    }
    let subject = |id: &str, names: &[String]| json!({ "id": id, "cert_common_names": names });
    let mut has_all = Vec::new();
    if !members.is_empty() {
        subjects.push(subject("members", members));
        policies.push(policy(&["ask", "report"], &["members"]));
        has_all.push("members");
    }
    if !routers.is_empty() {
        subjects.push(subject("routers", routers));
        policies.push(policy(&["pass on"], &["routers"]));
        has_all.push("routers");
    }
    if !has_all.is_empty() {
        policies.push(policy(&["tell"], &has_all));
    }
    for member in members {
        let id = format!("say {member}");
        rules.push(rule(id.clone(), "ingress", SAY, &[&all_keys(swarm, Some(member))]));
        subjects.push(subject(&id, std::slice::from_ref(member)));
        policies.push(policy(&[&id], &[&id]));
    }
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    })
}

fn policy(rules: &[&str], subjects: &[&str]) -> Value {
    json!({ "rules": rules, "subjects": subjects })
}
