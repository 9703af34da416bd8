//! Tests that `docs/CONTRACT.md` matches the crate.
#![allow(clippy::unwrap_used)]

use serde::Serialize;

use crate::{
    CONTRACT_VERSION, ComplaintKind, HandOverState, JournalKind, MeasuredBy, PixelFormat,
    Projection, Range, RotationSource, Search, SearchMode, StageState, StopReason, StopRule,
    SwarmWay, TrackState, Transfer, VERSION_ATTRIBUTE, VideoCodec, ViewKind,
};

const DOCUMENT: &str = include_str!("../../../docs/CONTRACT.md");

/// The numbers without a point that follow `word` in a text, with or without markup between.
/// (Versions of libraries have points.)
fn numbers_after<'t>(text: &'t str, word: &'t str) -> Vec<&'t str> {
    text.split(word)
        .skip(1)
        .map(|rest| rest.trim_start_matches([' ', '=', '*', '`', '"']))
        .filter_map(|rest| {
            let end = rest.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(rest.len());
            let number = rest[..end].trim_end_matches('.');
            (!number.is_empty() && !number.contains('.')).then_some(number)
        })
        .collect()
}

#[test]
fn every_stated_version_is_the_contracts() {
    let words = ["version", "CONTRACT_VERSION", VERSION_ATTRIBUTE];
    let stated: Vec<&str> = words.iter().flat_map(|word| numbers_after(DOCUMENT, word)).collect();
    assert!(stated.len() >= 2, "CONTRACT.md states {stated:?}");
    assert!(stated.iter().all(|version| *version == CONTRACT_VERSION), "{stated:?}");
    let required = format!("`{VERSION_ATTRIBUTE}` = `{CONTRACT_VERSION}`");
    assert!(DOCUMENT.contains(&required), "CONTRACT.md does not tell stages to require {required}");
}

#[test]
fn versions_are_found_in_every_notation() {
    let text = "version **2**, iceoryx2 version 0.10.0, version 3. A version of `4`; version `5`";
    assert_eq!(numbers_after(text, "version"), ["2", "3", "5"]);
}

/// The names of an enumeration's values, as JSON has them, by their codes from 0.
fn names<T: Serialize>(values: &[T]) -> Vec<String> {
    let name = |value| serde_json::to_string(value).unwrap().trim_matches('"').to_owned();
    values.iter().map(name).collect()
}

#[test]
fn the_documented_codes_are_the_contracts() {
    for (what, names) in [
        ("pixel format", names(PixelFormat::ALL)),
        ("video codec", names(VideoCodec::ALL)),
        ("transfer curve", names(Transfer::ALL)),
        ("range", names(Range::ALL)),
        ("projection", names(Projection::ALL)),
        ("rotation source", names(RotationSource::ALL)),
        ("view kind", names(ViewKind::ALL)),
        ("search", names(Search::ALL)),
        ("stop rule", names(StopRule::ALL)),
        ("stop reason", names(StopReason::ALL)),
        ("search mode", names(SearchMode::ALL)),
        ("track state", names(TrackState::ALL)),
        ("measured by", names(MeasuredBy::ALL)),
        ("swarm way", names(SwarmWay::ALL)),
        ("stage state", names(StageState::ALL)),
        ("hand-over state", names(HandOverState::ALL)),
        ("journal kind", names(JournalKind::ALL)),
        ("complaint kind", names(ComplaintKind::ALL)),
    ] {
        let row = DOCUMENT.lines().find(|line| line.starts_with(&format!("| {what} | 0 ")));
        let row = row.unwrap_or_else(|| panic!("CONTRACT.md has no codes of {what}"));
        for (code, name) in names.iter().enumerate() {
            assert!(row.contains(&format!(" {code} `{name}`")), "{what} {code} `{name}`: {row}");
        }
        assert!(!row.contains(&format!(" {} `", names.len())), "more codes of {what}: {row}");
    }
}
