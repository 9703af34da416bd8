//! Why a port cannot be had or used.

use flockeye_contract::CONTRACT_VERSION;

/// Why a port cannot be had or used.
#[derive(Debug, thiserror::Error)]
pub enum PortError {
    /// A topic's services cannot be created.
    #[error("cannot create the topic {topic}: {reason}")]
    Create {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: String,
    },
    /// A topic's services cannot be opened.
    #[error(
        "cannot open the topic {topic}: {reason}. Cure: start the pipeline with `flockeye up`, and \
         use stages of contract version {CONTRACT_VERSION}"
    )]
    Open {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: String,
    },
    /// Too many publishers, subscribers or processes.
    #[error("cannot join the topic {topic}: {reason}")]
    Join {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: String,
    },
    /// A message cannot be written.
    #[error("cannot publish on {topic}: {reason}")]
    Publish {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: String,
    },
    /// A message cannot be taken.
    #[error("cannot receive from {topic}: {reason}")]
    Receive {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: String,
    },
}
