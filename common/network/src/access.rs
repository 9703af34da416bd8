//! Rules of Zenoh's access control: the messages that each certificate allows on a link.
//!
//! Zenoh checks the certificate at the other end of the *link*, and not that of a message's origin.
//! So every gateway and every router has these rules. Their names are literal, and they hold until
//! the session ends.

use flockeye_contract::wire::{all_frames_key, all_keys};
use flockeye_identity::Roster;
use serde_json::{Value, json};

/// Messages that request data and carry none.
const ASK: &[&str] =
    &["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"];
/// Messages that carry or announce data.
const SAY: &[&str] = &["put", "delete", "reply", "declare_queryable", "liveliness_token"];
/// Messages that carry reports.
const REPORT: &[&str] = &["put", "reply"];

/// The access rules of a swarm. All else is denied.
///
/// A member may publish under its own name, and may request everything. Routers pass on everything.
/// Reports are admitted under any name, and are judged by their signatures
/// ([`flockeye_identity::Trust`]). So a report in another's name is identified and counted, where
/// Zenoh would drop it silently. A gateway admits reports from every link; a router (`is_router`),
/// which reads no signatures, only from members.
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
