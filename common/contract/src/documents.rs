//! Pins what `docs/CONTRACT.md` and `examples/flockeye_contract.py` say to what the crate has.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;

use serde::Serialize;

use crate::{
    CONTRACT_VERSION, ComplaintKind, HandOverState, MeasuredBy, PixelFormat, Projection, Range,
    RotationSource, Search, SearchMode, StageState, StopReason, StopRule, TrackState, Transfer,
    VERSION_ATTRIBUTE, ViewKind,
};

const DOCUMENT: &str = include_str!("../../../docs/CONTRACT.md");
const PYTHON: &str = include_str!("../../../examples/flockeye_contract.py");

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
    for (file, text, least) in [("CONTRACT.md", DOCUMENT, 2), ("flockeye_contract.py", PYTHON, 1)] {
        let words = ["version", "CONTRACT_VERSION", VERSION_ATTRIBUTE];
        let stated: Vec<&str> = words.iter().flat_map(|word| numbers_after(text, word)).collect();
        assert!(stated.len() >= least, "{file} states {stated:?}");
        assert!(stated.iter().all(|version| *version == CONTRACT_VERSION), "{file}: {stated:?}");
    }
    let required = format!("`{VERSION_ATTRIBUTE}` = `{CONTRACT_VERSION}`");
    assert!(DOCUMENT.contains(&required), "CONTRACT.md does not tell stages to require {required}");
}

#[test]
fn versions_are_found_in_every_notation() {
    let text = "version **2**, iceoryx2 version 0.10.0, version 3. A version of `4`; version `5`";
    assert_eq!(numbers_after(text, "version"), ["2", "3", "5"]);
}

/// Size and alignment of a type of ctypes, or of a class that was read before.
fn size_of_python(expression: &str, classes: &BTreeMap<&str, [usize; 2]>) -> [usize; 2] {
    let mut factors = expression.split(" * ");
    let [size, alignment] = match factors.next().unwrap() {
        "c_uint8" => [1, 1],
        "c_uint32" | "c_float" => [4, 4],
        "c_int64" | "c_uint64" | "c_double" => [8, 8],
        class => classes[class],
    };
    [factors.fold(size, |size, count| size * count.parse::<usize>().unwrap()), alignment]
}

/// The classes of the Python file, laid out as C lays them out, as text like that of
/// `docs/CONTRACT.md`.
fn python_layout() -> String {
    let mut classes = BTreeMap::new();
    let mut text = String::new();
    for class in PYTHON.split("\nclass ").skip(1) {
        let Some((name, body)) = class.split_once("(Contract):") else { continue };
        let fields = body.split("_fields_ = [").nth(1).unwrap().split(']').next().unwrap();
        let (mut size, mut alignment) = (0usize, 1);
        let mut offsets = String::new();
        for field in fields.split("(\"").skip(1) {
            let (field, rest) = field.split_once("\", ").unwrap();
            let [bytes, aligned] = size_of_python(rest.split(')').next().unwrap(), &classes);
            size = size.next_multiple_of(aligned);
            offsets += &format!("  {field} {size}\n");
            size += bytes;
            alignment = alignment.max(aligned);
        }
        size = size.next_multiple_of(alignment);
        text += &format!("{name} {size} {alignment}\n{offsets}");
        classes.insert(name, [size, alignment]);
    }
    text
}

#[test]
fn the_python_types_have_the_documented_layout() {
    let documented = DOCUMENT.split("```layout\n").nth(1).unwrap().split("```").next().unwrap();
    assert_eq!(python_layout(), documented);
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
        ("stage state", names(StageState::ALL)),
        ("hand-over state", names(HandOverState::ALL)),
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

#[test]
fn the_python_codes_are_the_contracts() {
    let states = names(TrackState::ALL).join("\", \"");
    assert!(PYTHON.contains(&format!("\nTRACK_STATES = [\"{states}\"]\n")));
    let stages = names(StageState::ALL).join(", ").to_uppercase();
    assert!(PYTHON.contains(&format!("\n{stages} = range({})\n", StageState::ALL.len())));
    let searches =
        names(Search::ALL).join(", ").to_uppercase().replace("NOTHING", "SEARCH_NOTHING");
    assert!(PYTHON.contains(&format!("\n{searches} = range({})\n", Search::ALL.len())));
}
