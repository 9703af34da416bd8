//! The documents: every link between them leads somewhere, and the site has all of them.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The documents, by their path from the root.
fn documents() -> Vec<PathBuf> {
    let folders = ["", "docs", "docs/results", "deploy"];
    let mut found = Vec::new();
    for folder in folders {
        let entries = std::fs::read_dir(root().join(folder)).expect("it is there").flatten();
        let names = entries.map(|entry| Path::new(folder).join(entry.file_name()));
        found.extend(names.filter(|name| name.extension().is_some_and(|ending| ending == "md")));
    }
    found.sort();
    found
}

/// The lines outside blocks of code, with their numbers.
fn prose(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut is_code = false;
    text.lines().enumerate().filter_map(move |(number, line)| {
        if line.trim_start().starts_with("```") {
            is_code = !is_code;
            return None;
        }
        (!is_code).then_some((number + 1, line))
    })
}

/// The names that headings get on a page, as GitHub and mdBook make them.
fn anchors(text: &str) -> BTreeSet<String> {
    let headings = prose(text).filter(|(_, line)| line.starts_with('#'));
    headings
        .map(|(_, line)| {
            let heading = line.trim_start_matches('#').trim().to_lowercase();
            let kept = heading.chars().filter(|&c| c.is_alphanumeric() || " -_".contains(c));
            kept.collect::<String>().replace(' ', "-")
        })
        .collect()
}

/// The targets of a line's links.
fn links(line: &str) -> impl Iterator<Item = &str> {
    line.split("](").skip(1).filter_map(|rest| rest.split(')').next())
}

/// The path without `..`, as a browser takes it.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => drop(plain.pop()),
            part => plain.push(part),
        }
    }
    plain
}

#[test]
fn every_link_leads_somewhere() {
    let mut broken = Vec::new();
    for document in documents() {
        let text = std::fs::read_to_string(root().join(&document)).expect("it can be read");
        for (number, line) in prose(&text) {
            for link in links(line).filter(|link| !link.contains(':')) {
                let (path, anchor) = link.split_once('#').unwrap_or((link, ""));
                let folder = document.parent().expect("it is in one");
                let target = match path.is_empty() {
                    true => document.clone(),
                    false => plain(&folder.join(path)),
                };
                let there = root().join(&target);
                let has_anchor = || {
                    let text = std::fs::read_to_string(&there).unwrap_or_default();
                    anchor.is_empty() || anchors(&text).contains(anchor)
                };
                if !there.exists() || !has_anchor() {
                    broken.push(format!("{}:{number}: {link}", document.display()));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

#[test]
fn the_site_has_every_document() {
    let summary =
        std::fs::read_to_string(root().join("deploy/book/SUMMARY.md")).expect("it is there");
    let listed: BTreeSet<PathBuf> = summary.lines().flat_map(links).map(PathBuf::from).collect();
    let there: BTreeSet<PathBuf> = documents().into_iter().collect();
    let missing: Vec<_> = there.difference(&listed).collect();
    let surplus: Vec<_> = listed.difference(&there).collect();
    assert!(missing.is_empty() && surplus.is_empty(), "missing {missing:?}, surplus {surplus:?}");
}
