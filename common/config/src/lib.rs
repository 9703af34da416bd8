//! pipeline.yaml: read, overridden from the command line, checked, typed, resolved.
//!
//! Everything that is wrong is reported at once, each problem with its place, what is wrong and
//! what is allowed. The document is checked in two passes: against the JSON Schema of the types
//! (which editors use too, see [`json_schema`]), then semantically.
//!
//! | module | what it is for |
//! | --- | --- |
//! | `types` | the configuration as types; their comments are the schema's descriptions |
//! | `document` | YAML as a tree that holds the place of each value |
//! | `former_keys` | keys of earlier releases: translated or refused |
//! | `schema` | the document checked against the JSON Schema |
//! | `meaning` | semantic validation: constraints that no schema can express |
//! | `read` | text and overrides to a checked [`Pipeline`] |
//! | `problem` | problems, with their places |
//! | `resolve` | values computed from a configuration: bodies, camera, views |

mod document;
mod former_keys;
mod instance_name;
mod meaning;
mod problem;
mod read;
mod resolve;
mod schema;
mod types;

pub use former_keys::says_how_it_runs;
pub use instance_name::is_instance_name;
pub use problem::{ConfigError, Origin, Problem};
pub use read::{FLOW, RESOLVED, json_schema, read_document};
pub use resolve::{Division, ResolveError, Resolved, SettingError, bodies, isometry, read_bodies};
pub use types::*;
