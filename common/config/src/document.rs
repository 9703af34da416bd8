//! Configuration document as a tree that holds the place of each value.

use saphyr::{LoadableYamlNode, MarkedYaml, Scalar, YamlData};
use serde_json::Value;

use crate::problem::{Origin, Problem};

/// A value and the place where it was written.
#[derive(Debug, Clone)]
pub(crate) struct Node {
    pub origin: Origin,
    pub data: Data,
}

/// Content of a node.
#[derive(Debug, Clone)]
pub(crate) enum Data {
    /// Null, a truth value, a number or a text.
    Scalar(Value),
    /// A list.
    List(Vec<Node>),
    /// A section: keys in the order in which they were written.
    Section(Vec<(Key, Node)>),
}

/// A key and the place where it was written.
#[derive(Debug, Clone)]
pub(crate) struct Key {
    pub origin: Origin,
    pub name: String,
}

impl Node {
    /// Reads a YAML document.
    ///
    /// # Errors
    /// The first place that is no YAML, or a construct that a configuration cannot have (keys that
    /// are no text, tags, several documents).
    pub(crate) fn parse(yaml: &str) -> Result<Self, Problem> {
        let documents = MarkedYaml::load_from_str(yaml).map_err(|error| {
            let origin =
                Origin::File { line: error.marker().line(), column: error.marker().col() + 1 };
            Problem::new(origin, "", format!("not YAML: {}", error.info()))
        })?;
        let start = Origin::File { line: 1, column: 1 };
        match <[MarkedYaml<'_>; 1]>::try_from(documents) {
            Ok([document]) => convert(document),
            Err(documents) if documents.is_empty() => {
                Ok(Self { origin: start, data: Data::Section(Vec::new()) })
            }
            Err(documents) => Err(Problem::new(
                start,
                "",
                format!("{} documents in one file; one is allowed", documents.len()),
            )),
        }
    }

    /// A document from JSON that a program wrote. All values have the same place.
    pub(crate) fn from_json(value: Value) -> Self {
        let origin = Origin::File { line: 1, column: 1 };
        let data = match value {
            Value::Array(items) => Data::List(items.into_iter().map(Self::from_json).collect()),
            Value::Object(entries) => {
                let entry =
                    |(name, value)| (Key { origin: origin.clone(), name }, Self::from_json(value));
                Data::Section(entries.into_iter().map(entry).collect())
            }
            scalar => Data::Scalar(scalar),
        };
        Self { origin, data }
    }

    /// Replaces, or adds, the value at a dotted path (`search.mode`, `stages.detection.replicas`).
    ///
    /// # Errors
    /// A text that is not `key.path=value`, or a path that leads through something that is no
    /// section.
    pub(crate) fn set(&mut self, assignment: &str) -> Result<(), Problem> {
        let origin = Origin::Override(assignment.to_owned());
        let Some((path, value)) = assignment.split_once('=') else {
            return Err(Problem::new(origin, "", "write key.path=value".into()));
        };
        let mut value = Self::parse(value)
            .map_err(|problem| Problem::new(origin.clone(), path, problem.what))?;
        // An empty value is an empty document; as a value it means nothing.
        if matches!(&value.data, Data::Section(entries) if entries.is_empty()) {
            value.data = Data::Scalar(Value::Null);
        }
        value.relocate(&origin);
        match self.entry(path, &origin) {
            Ok(node) => *node = value,
            Err(name) => {
                let what = format!("'{name}' is inside a value that is no section");
                return Err(Problem::new(origin, path, what));
            }
        }
        Ok(())
    }

    /// The value at a dotted path. Keys that are missing are added, with `origin` and without a
    /// value.
    ///
    /// # Errors
    /// The name of a key inside a value that is no section.
    fn entry<'p>(&mut self, path: &'p str, origin: &Origin) -> Result<&mut Self, &'p str> {
        let mut node = self;
        for name in path.split('.').map(str::trim) {
            if matches!(node.data, Data::Scalar(Value::Null)) {
                node.data = Data::Section(Vec::new());
            }
            let Data::Section(entries) = &mut node.data else { return Err(name) };
            let index = match entries.iter().position(|(key, _)| key.name == name) {
                Some(index) => index,
                None => {
                    let key = Key { origin: origin.clone(), name: name.to_owned() };
                    let empty = Self { origin: origin.clone(), data: Data::Scalar(Value::Null) };
                    entries.push((key, empty));
                    entries.len() - 1
                }
            };
            node = &mut entries[index].1;
        }
        Ok(node)
    }

    /// The document without places, in the form that serde reads. A key without a value counts as
    /// absent.
    pub(crate) fn to_json(&self) -> Value {
        match &self.data {
            Data::Scalar(value) => value.clone(),
            Data::List(items) => items.iter().map(Self::to_json).collect(),
            Data::Section(entries) => entries
                .iter()
                .map(|(key, node)| (key.name.clone(), node.to_json()))
                .filter(|(_, value)| !value.is_null())
                .collect(),
        }
    }

    /// Place of the value at a dotted path, or of the nearest section that was written.
    pub(crate) fn origin_of(&self, path: &str) -> Origin {
        let mut node = self;
        for name in path.split('.') {
            let next = match &node.data {
                Data::Section(entries) => {
                    entries.iter().find(|(key, _)| key.name == name).map(|(_, node)| node)
                }
                Data::List(items) => name.parse().ok().and_then(|index: usize| items.get(index)),
                Data::Scalar(_) => None,
            };
            match next {
                Some(next) => node = next,
                None => break,
            }
        }
        node.origin.clone()
    }

    /// The value at a dotted path; none where nothing, or an empty value, was written.
    pub(crate) fn get(&self, path: &str) -> Option<&Self> {
        let mut node = self;
        for name in path.split('.') {
            let Data::Section(entries) = &node.data else { return None };
            node = entries.iter().find(|(key, _)| key.name == name).map(|(_, node)| node)?;
        }
        (!matches!(node.data, Data::Scalar(Value::Null))).then_some(node)
    }

    /// Removes the key at a dotted path, and returns its value; none where it was not written.
    pub(crate) fn take(&mut self, path: &str) -> Option<Self> {
        let (name, rest) = match path.split_once('.') {
            Some((name, rest)) => (name, Some(rest)),
            None => (path, None),
        };
        let Data::Section(entries) = &mut self.data else { return None };
        let index = entries.iter().position(|(key, _)| key.name == name)?;
        match rest {
            Some(rest) => entries[index].1.take(rest),
            None => Some(entries.remove(index).1),
        }
    }

    /// Puts a value at a dotted path that has none; missing sections are added.
    pub(crate) fn put(&mut self, path: &str, value: Self) {
        // The key may exist without a value.
        self.take(path);
        if let Ok(node) = self.entry(path, &value.origin.clone()) {
            *node = value;
        }
    }

    fn relocate(&mut self, origin: &Origin) {
        self.origin = origin.clone();
        match &mut self.data {
            Data::Scalar(_) => {}
            Data::List(items) => items.iter_mut().for_each(|item| item.relocate(origin)),
            Data::Section(entries) => entries.iter_mut().for_each(|(key, node)| {
                key.origin = origin.clone();
                node.relocate(origin);
            }),
        }
    }
}

fn convert(node: MarkedYaml<'_>) -> Result<Node, Problem> {
    let origin = Origin::File { line: node.span.start.line(), column: node.span.start.col() + 1 };
    let data = match node.data {
        YamlData::Value(scalar) => Data::Scalar(scalar_to_json(&scalar, &origin)?),
        YamlData::Sequence(items) => {
            Data::List(items.into_iter().map(convert).collect::<Result<_, _>>()?)
        }
        YamlData::Mapping(entries) => {
            let entries = entries.into_iter().map(|(key, value)| {
                let key_node = convert(key)?;
                match key_node.data {
                    Data::Scalar(Value::String(name)) => {
                        Ok((Key { origin: key_node.origin, name }, convert(value)?))
                    }
                    _ => Err(Problem::new(key_node.origin, "", "a key must be text".into())),
                }
            });
            Data::Section(entries.collect::<Result<_, _>>()?)
        }
        YamlData::Tagged(..)
        | YamlData::Representation(..)
        | YamlData::Alias(_)
        | YamlData::BadValue => {
            return Err(Problem::new(
                origin,
                "",
                "tags and broken values have no meaning here".into(),
            ));
        }
    };
    Ok(Node { origin, data })
}

fn scalar_to_json(scalar: &Scalar<'_>, origin: &Origin) -> Result<Value, Problem> {
    Ok(match scalar {
        Scalar::Null => Value::Null,
        Scalar::Boolean(flag) => Value::Bool(*flag),
        Scalar::Integer(number) => Value::from(*number),
        Scalar::FloatingPoint(number) => {
            let number = number.into_inner();
            serde_json::Number::from_f64(number).map(Value::Number).ok_or_else(|| {
                Problem::new(origin.clone(), "", format!("{number} is not a finite number"))
            })?
        }
        Scalar::String(text) => Value::String(text.to_string()),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn overrides_replace_and_add() {
        let mut node = Node::parse("a:\n  b: 1\n").unwrap();
        node.set("a.b=2").unwrap();
        node.set("a.c.d=[x, 1.5]").unwrap();
        node.set("e=").unwrap();
        assert_eq!(node.to_json(), serde_json::json!({"a": {"b": 2, "c": {"d": ["x", 1.5]}}}));
        assert_eq!(node.origin_of("a.c.d").to_string(), "--set a.c.d=[x, 1.5]");
        assert!(node.set("a.b.c=1").unwrap_err().to_string().contains("no section"));
        assert!(node.set("nonsense").unwrap_err().to_string().contains("key.path=value"));
    }

    #[test]
    fn places_are_remembered() {
        let node = Node::parse("a:\n  - 1\n  - {b: 2}\n").unwrap();
        assert_eq!(node.origin_of("a.1.b").to_string(), "line 3, column 9");
        assert_eq!(node.origin_of("a.1.nowhere").to_string(), "line 3, column 5");
    }

    #[test]
    fn what_is_no_configuration_is_refused_with_its_place() {
        let error = |yaml| Node::parse(yaml).unwrap_err().to_string();
        assert!(error("a: [1, 2").contains("line"), "{}", error("a: [1, 2"));
        assert!(error("a: 1\na: 2\n").contains("duplicated key"));
        assert!(error("1: 2").contains("key must be text"));
        assert!(error("a: .nan").contains("not a finite number"));
    }
}
