//! The control channel of a running pipeline: a Unix socket in the instance's folder, which only
//! its owner can use. A client sends one request as a line of JSON, and gets lines of JSON until
//! its request is done.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`server`] | the launcher's side, which never waits for a client |
//! | [`client`] | the side of `flockeye status`, `swap` and the like |

pub mod client;
pub(crate) mod server;

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use flockeye_contract::StageName;
use serde::{Deserialize, Serialize};

/// The socket of the instance in `folder`.
pub(crate) fn socket_path(folder: &Path) -> PathBuf {
    folder.join("control")
}

/// Maximum length of a request, bytes. Longer ones are refused.
pub(crate) const MAX_REQUEST_BYTES: usize = 65_536;

/// One worker of a stage, written `detection.1`, or `fusion` for the first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct WorkerName {
    /// The stage.
    pub stage: StageName,
    /// Which of its workers, from 0.
    pub replica: u32,
}

impl fmt::Display for WorkerName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&worker_label(self.stage.name(), self.replica))
    }
}

/// Name of a worker, whose stage may be a foreign one, in the form of a [`WorkerName`].
pub(crate) fn worker_label(stage: &str, replica: u32) -> String {
    match replica {
        0 => stage.to_owned(),
        replica => format!("{stage}.{replica}"),
    }
}

/// Reads a stage's name.
///
/// # Errors
/// There is no such stage, and which there are.
pub fn stage_name(text: &str) -> Result<StageName, String> {
    StageName::from_name(text).ok_or_else(|| {
        let names = StageName::ALL.map(StageName::name).join(", ");
        format!("there is no stage '{text}'. Stages: {names}")
    })
}

impl FromStr for WorkerName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, replica) = text.split_once('.').unwrap_or((text, "0"));
        let stage = stage_name(name)?;
        let replica = replica
            .parse()
            .map_err(|_| format!("'{replica}' is not the number of a worker, such as {name}.1"))?;
        Ok(Self { stage, replica })
    }
}

impl From<WorkerName> for String {
    fn from(worker: WorkerName) -> Self {
        worker.to_string()
    }
}

impl TryFrom<String> for WorkerName {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

/// Request of a client.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case", deny_unknown_fields)]
pub enum ControlRequest {
    /// Report all processes.
    Status,
    /// End a worker and leave it ended; without one: end the pipeline.
    Stop {
        /// Which worker.
        worker: Option<WorkerName>,
    },
    /// Start a worker that was ended or given up.
    Start {
        /// Which worker.
        worker: WorkerName,
    },
    /// End a worker and start it again.
    Restart {
        /// Which worker.
        worker: WorkerName,
    },
    /// Replace a worker's process by another one.
    Swap(SwapRequest),
}

/// Parameters of a swap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SwapRequest {
    /// Which worker.
    pub worker: WorkerName,
    /// Settings to be changed, `key.path=value`.
    #[serde(default)]
    pub set: Vec<String>,
    /// Program and arguments of another implementation. Empty: the one that runs.
    #[serde(default)]
    pub program: Vec<String>,
    /// Deadline by which the new process must do as well as the old one, seconds.
    pub within_s: f64,
    /// Whether the new process may do worse than the old one.
    #[serde(default)]
    pub accept_worse: bool,
}

/// Reply to a client.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    /// Progress so far, in words. More replies follow.
    Progress(String),
    /// The request is done: result in words, and as a value for programs.
    Done {
        /// The result in words.
        text: String,
        /// The result for programs.
        report: serde_json::Value,
    },
    /// The request was not done; the text is the reason.
    Failed(String),
}

impl Reply {
    /// Final reply whose text is the whole result.
    pub(crate) fn done(text: impl Into<String>) -> Self {
        Self::Done { text: text.into(), report: serde_json::Value::Null }
    }

    /// Whether no further reply follows.
    pub(crate) fn is_last(&self) -> bool {
        !matches!(self, Self::Progress(_))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn workers_are_read_as_they_are_written() {
        for text in ["fusion", "detection.1", "gateway"] {
            assert_eq!(text.parse::<WorkerName>().unwrap().to_string(), text);
        }
        assert!(
            "fusions".parse::<WorkerName>().unwrap_err().contains("Stages: capture, simulator")
        );
        assert!("detection.x".parse::<WorkerName>().unwrap_err().contains("'x' is not the number"));
    }

    #[test]
    fn requests_survive_the_socket() {
        let swap = ControlRequest::Swap(SwapRequest {
            worker: "detection.1".parse().unwrap(),
            set: vec!["detection.dictionary=X".to_owned()],
            program: vec!["python3".to_owned()],
            within_s: 10.0,
            accept_worse: false,
        });
        for request in [swap, ControlRequest::Status, ControlRequest::Stop { worker: None }] {
            let text = serde_json::to_string(&request).unwrap();
            assert_eq!(serde_json::from_str::<ControlRequest>(&text).unwrap(), request, "{text}");
        }
        let unknown = r#"{"command":"stop","worker":"fusions"}"#;
        let error = serde_json::from_str::<ControlRequest>(unknown).unwrap_err().to_string();
        assert!(error.contains("there is no stage 'fusions'"), "{error}");
    }
}
