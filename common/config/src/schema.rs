//! Checks a document against the JSON Schema of the configuration types. It finds all faults at
//! once; serde alone would stop at the first.
//!
//! It supports the part of JSON Schema that `schemars` writes for the types in this crate.

use serde_json::{Map, Value};

use crate::document::{Data, Node};
use crate::problem::Problem;

/// Adds all violations of `schema` in `node` to `problems`.
pub(super) fn check(node: &Node, schema: &Value, problems: &mut Vec<Problem>) {
    check_at(node, schema, "", problems);
}

/// Adds all violations of `schema` in `node`, which is at the dotted `path`.
pub(super) fn check_at(node: &Node, schema: &Value, path: &str, problems: &mut Vec<Problem>) {
    Checker { definitions: schema.get("$defs").and_then(Value::as_object), problems }
        .node(node, schema, path);
}

struct Checker<'a> {
    definitions: Option<&'a Map<String, Value>>,
    problems: &'a mut Vec<Problem>,
}

impl<'a> Checker<'a> {
    fn node(&mut self, node: &Node, schema: &'a Value, path: &str) {
        let schema = self.resolve(schema);
        if let Some(alternatives) = schema.get("anyOf").and_then(Value::as_array) {
            return self.any_of(node, alternatives, path);
        }
        if let Some(allowed) = enumeration(schema) {
            return self.one_of(node, &allowed, path);
        }
        let types = types(schema);
        if !types.iter().any(|name| is_type(node, name)) {
            self.problem(
                node,
                path,
                format!("must be {}, not {}", wanted(&types, schema), describe(node)),
            );
            return;
        }
        match &node.data {
            Data::Scalar(value) => self.bounds(node, value, schema, path),
            Data::List(items) => self.list(node, items, schema, path),
            Data::Section(_) => self.section(node, schema, path),
        }
    }

    /// `Option<Section>` and similar types: null, or the other alternative.
    fn any_of(&mut self, node: &Node, alternatives: &'a [Value], path: &str) {
        let is_null = matches!(node.data, Data::Scalar(Value::Null));
        let is_null_schema =
            |schema: &&Value| schema.get("type").and_then(Value::as_str) == Some("null");
        if is_null && alternatives.iter().any(|schema| is_null_schema(&schema)) {
            return;
        }
        let others: Vec<_> = alternatives
            .iter()
            .filter(|schema| !is_null_schema(schema))
            .map(|schema| self.resolve(schema))
            .collect();
        let fits = |schema: &&&Value| match (enumeration(schema), &node.data) {
            (Some(allowed), Data::Scalar(Value::String(text))) => allowed.contains(&text.as_str()),
            (Some(_), _) => false,
            (None, _) => types(schema).iter().any(|name| is_type(node, name)),
        };
        match (others.iter().find(fits), others.as_slice()) {
            (Some(schema), _) | (None, [schema]) => self.node(node, schema, path),
            (None, several) => {
                let wanted = several.iter().map(|schema| alternative(schema));
                let wanted = wanted.collect::<Vec<_>>().join(" or ");
                self.problem(node, path, format!("must be {wanted}, not {}", describe(node)));
            }
        }
    }

    fn one_of(&mut self, node: &Node, allowed: &[&str], path: &str) {
        let found = match &node.data {
            Data::Scalar(Value::String(text)) if allowed.contains(&text.as_str()) => return,
            Data::Scalar(Value::String(text)) => format!("'{text}'"),
            _ => describe(node),
        };
        let hint = hint(found.trim_matches('\''), allowed.iter().copied());
        self.problem(
            node,
            path,
            format!("must be one of {}, not {found}{hint}", allowed.join(", ")),
        );
    }

    fn bounds(&mut self, node: &Node, value: &Value, schema: &Value, path: &str) {
        if let Some(number) = value.as_f64() {
            let bound = |key| schema.get(key).and_then(Value::as_f64);
            let below = bound("minimum").is_some_and(|minimum| number < minimum)
                || bound("exclusiveMinimum").is_some_and(|minimum| number <= minimum);
            let above = bound("maximum").is_some_and(|maximum| number > maximum);
            if below || above {
                let why = schema.get("x-why").and_then(Value::as_str);
                let why = why.map(|why| format!(": {why}")).unwrap_or_default();
                self.problem(node, path, format!("must be {}, not {value}{why}", range(schema)));
            }
        }
        if let (Some(text), Some(1..)) =
            (value.as_str(), schema.get("minLength").and_then(Value::as_u64))
            && text.is_empty()
        {
            self.problem(node, path, "must not be empty".into());
        }
    }

    fn list(&mut self, node: &Node, items: &[Node], schema: &'a Value, path: &str) {
        let limit = |key| schema.get(key).and_then(Value::as_u64).map(|count| count as usize);
        let (least, most) =
            (limit("minItems").unwrap_or(0), limit("maxItems").unwrap_or(usize::MAX));
        if items.len() < least || items.len() > most {
            let wanted = if least == most {
                format!("exactly {least}")
            } else if items.len() < least {
                format!("at least {least}")
            } else {
                format!("at most {most}")
            };
            self.problem(node, path, format!("must have {wanted} entries, not {}", items.len()));
        }
        if let Some(schema) = schema.get("items") {
            for (index, item) in items.iter().enumerate() {
                self.node(item, schema, &join(path, &index.to_string()));
            }
        }
    }

    fn section(&mut self, node: &Node, schema: &'a Value, path: &str) {
        let Data::Section(entries) = &node.data else { return };
        let properties = schema.get("properties").and_then(Value::as_object);
        let free = schema.get("additionalProperties").filter(|rest| rest.is_object());
        for (key, value) in entries {
            let known = properties.and_then(|properties| properties.get(&key.name)).or(free);
            match known {
                Some(schema) => self.node(value, schema, &join(path, &key.name)),
                None => {
                    let names = || {
                        properties.into_iter().flat_map(|names| names.keys().map(String::as_str))
                    };
                    let hint = hint(&key.name, names());
                    let allowed = names().collect::<Vec<_>>().join(", ");
                    let what = if hint.is_empty() {
                        format!("unknown key (known are {allowed})")
                    } else {
                        format!("unknown key{hint}")
                    };
                    self.problems.push(Problem::new(
                        key.origin.clone(),
                        &join(path, &key.name),
                        what,
                    ));
                }
            }
        }
        let required = schema.get("required").and_then(Value::as_array).into_iter().flatten();
        for name in required.filter_map(Value::as_str) {
            if !entries.iter().any(|(key, _)| key.name == name) {
                self.problem(node, &join(path, name), "is missing".into());
            }
        }
    }

    fn resolve(&self, schema: &'a Value) -> &'a Value {
        let mut schema = schema;
        while let Some(name) = schema.get("$ref").and_then(Value::as_str) {
            let name = name.trim_start_matches("#/$defs/");
            match self.definitions.and_then(|definitions| definitions.get(name)) {
                Some(definition) => schema = definition,
                None => break,
            }
        }
        schema
    }

    fn problem(&mut self, node: &Node, path: &str, what: String) {
        self.problems.push(Problem::new(node.origin.clone(), path, what));
    }
}

pub(super) fn join(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}

/// " - did you mean 'x'?" where one of `names` is similar to `found`.
pub(super) fn hint<'n>(found: &str, names: impl Iterator<Item = &'n str>) -> String {
    names
        .map(|name| (strsim::jaro_winkler(found, name), name))
        .filter(|(likeness, _)| *likeness > 0.8)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, name)| format!(" - did you mean '{name}'?"))
        .unwrap_or_default()
}

/// Texts that an enumeration's schema allows: `enum`, or `oneOf` of `const`s with their docs.
fn enumeration(schema: &Value) -> Option<Vec<&str>> {
    if let Some(values) = schema.get("enum").and_then(Value::as_array) {
        return values.iter().map(Value::as_str).collect();
    }
    let variants = schema.get("oneOf").and_then(Value::as_array)?;
    let mut allowed = Vec::new();
    for variant in variants {
        match (variant.get("const").and_then(Value::as_str), enumeration(variant)) {
            (Some(name), _) => allowed.push(name),
            (None, Some(names)) => allowed.extend(names),
            (None, None) => return None,
        }
    }
    Some(allowed)
}

/// Numbers that a schema allows, in words.
fn range(schema: &Value) -> String {
    let bound = |key| schema.get(key).and_then(Value::as_f64);
    match (bound("minimum"), bound("exclusiveMinimum"), bound("maximum")) {
        (Some(low), _, Some(high)) => format!("from {low} to {high}"),
        (_, Some(low), Some(high)) => format!("above {low} and at most {high}"),
        (Some(low), ..) => format!("at least {low}"),
        (_, Some(low), _) => format!("above {low}"),
        (.., Some(high)) => format!("at most {high}"),
        _ => "any".to_owned(),
    }
}

/// Types that a value may have, in words.
fn alternative(schema: &Value) -> String {
    match enumeration(schema) {
        Some(allowed) => allowed.join(", "),
        None if schema.get("minimum").is_some() => {
            format!("{} {}", wanted(&types(schema), schema), range(schema))
        }
        None => wanted(&types(schema), schema),
    }
}

fn types(schema: &Value) -> Vec<&str> {
    match schema.get("type") {
        Some(Value::String(name)) => vec![name],
        Some(Value::Array(names)) => names.iter().filter_map(Value::as_str).collect(),
        _ => vec!["null", "boolean", "number", "string", "array", "object"],
    }
}

fn is_type(node: &Node, name: &str) -> bool {
    match (&node.data, name) {
        // An empty section (`search:` with every key commented out) is a section.
        (Data::Scalar(Value::Null), "null" | "object") => true,
        (Data::Scalar(Value::Bool(_)), "boolean") | (Data::Scalar(Value::String(_)), "string") => {
            true
        }
        (Data::Scalar(Value::Number(_)), "number") => true,
        (Data::Scalar(Value::Number(number)), "integer") => number.is_i64() || number.is_u64(),
        (Data::List(_), "array") | (Data::Section(_), "object") => true,
        _ => false,
    }
}

fn wanted(types: &[&str], schema: &Value) -> String {
    let names = types.iter().map(|name| match *name {
        "null" => "null".to_owned(),
        "boolean" => "true or false".to_owned(),
        "integer" => "a whole number".to_owned(),
        "number" => "a number".to_owned(),
        "string" => "text".to_owned(),
        "array" => "a list".to_owned(),
        "object" => {
            let keys = schema.get("properties").and_then(Value::as_object);
            let keys =
                keys.map(|keys| keys.keys().map(String::as_str).collect::<Vec<_>>().join(", "));
            format!("a section with {}", keys.unwrap_or_else(|| "keys".to_owned()))
        }
        other => other.to_owned(),
    });
    names.collect::<Vec<_>>().join(" or ")
}

fn describe(node: &Node) -> String {
    match &node.data {
        Data::Scalar(Value::Null) => "empty".to_owned(),
        Data::Scalar(Value::String(text)) => format!("the text '{text}'"),
        Data::Scalar(value) => value.to_string(),
        Data::List(_) => "a list".to_owned(),
        Data::Section(_) => "a section".to_owned(),
    }
}
