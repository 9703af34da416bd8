//! Why a port cannot be opened or used: one type for each operation.
//!
//! iceoryx2's errors are kept as they are; texts print them in iceoryx2's words.

use flockeye_contract::CONTRACT_VERSION;
use iceoryx2::port::listener::ListenerCreateError;
use iceoryx2::port::notifier::{NotifierCreateError, NotifierNotifyError};
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::port::update_connections::ConnectionFailure;
use iceoryx2::port::{LoanError, ReceiveError as IoxReceiveError, SendError};
use iceoryx2::service::builder::event::{EventOpenError, EventOpenOrCreateError};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::waitset::{WaitSetAttachmentError, WaitSetCreateError};

/// Why the services of a topic cannot be created.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CreateError {
    /// iceoryx2 does not accept the topic's name, or the contract's version.
    #[error("cannot create the topic {topic}: not a name that iceoryx2 accepts")]
    Name {
        /// The topic.
        topic: &'static str,
    },
    /// The service of messages.
    #[error("cannot create the topic {topic}: {reason:?}")]
    Messages {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: PublishSubscribeOpenOrCreateError,
    },
    /// The service of wake-ups.
    #[error("cannot create the topic {topic}: {reason:?}")]
    WakeUps {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: EventOpenOrCreateError,
    },
}

/// Why a port cannot be opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    /// iceoryx2 does not accept the topic's name, or the contract's version.
    #[error("cannot open the topic {topic}: not a name that iceoryx2 accepts")]
    Name {
        /// The topic.
        topic: &'static str,
    },
    /// The topic is not there, or is of another contract version.
    #[error(
        "cannot open the topic {topic}: {reason:?}. Cure: start the pipeline with `flockeye up`, and \
         use stages of contract version {CONTRACT_VERSION}"
    )]
    Messages {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: PublishSubscribeOpenError,
    },
    /// The topic's wake-ups are not there.
    #[error(
        "cannot open the topic {topic}: {reason:?}. Cure: start the pipeline with `flockeye up`, and \
         use stages of contract version {CONTRACT_VERSION}"
    )]
    WakeUps {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: EventOpenError,
    },
    /// The topic has no place for a publisher.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Publisher {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: PublisherCreateError,
    },
    /// The topic has no place for what wakes a publisher's readers.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Notifier {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: NotifierCreateError,
    },
    /// The topic has no place for a subscriber.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Subscriber {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: SubscriberCreateError,
    },
    /// The topic has no place for what wakes a subscriber's process.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Listener {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: ListenerCreateError,
    },
}

impl OpenError {
    /// Whether the topic is there and has no place for another port.
    pub fn is_crowded(&self) -> bool {
        match self {
            Self::Name { .. } | Self::Messages { .. } | Self::WakeUps { .. } => false,
            Self::Publisher { .. }
            | Self::Notifier { .. }
            | Self::Subscriber { .. }
            | Self::Listener { .. } => true,
        }
    }
}

/// Why a message cannot be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// The message is too long.
    #[error("cannot publish on {topic}: {items} items where the topic has room for {room}")]
    TooManyItems {
        /// The topic.
        topic: &'static str,
        /// Items of the message.
        items: usize,
        /// Items that the topic has room for.
        room: usize,
    },
    /// There is no memory: subscribers keep too many messages.
    #[error("cannot publish on {topic}: {reason:?}")]
    Loan {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: LoanError,
    },
    /// The message cannot be sent.
    #[error("cannot publish on {topic}: {reason:?}")]
    Send {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: SendError,
    },
    /// Subscribers cannot be woken.
    #[error("cannot publish on {topic}: {reason:?}")]
    WakeUp {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: NotifierNotifyError,
    },
    /// A connection to a subscriber broke.
    #[error("cannot publish on {topic}: {reason:?}")]
    Connection {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: ConnectionFailure,
    },
}

/// Why messages cannot be received.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ReceiveError {
    /// This process keeps too many messages, or a connection broke.
    #[error("cannot receive from {topic}: {reason:?}")]
    Message {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: IoxReceiveError,
    },
    /// A connection to a publisher broke.
    #[error("cannot receive from {topic}: {reason:?}")]
    Connection {
        /// The topic.
        topic: &'static str,
        /// iceoryx2's reason.
        reason: ConnectionFailure,
    },
}

/// Why a process cannot wait for messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WaitError {
    /// There is nothing to wait with.
    #[error("cannot wait for messages: {0:?}")]
    Create(#[from] WaitSetCreateError),
    /// A port cannot be waited for.
    #[error("cannot wait for messages: {0:?}")]
    Attach(#[from] WaitSetAttachmentError),
}

/// Why a port cannot be had or used, for code that does several of these.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PortError {
    /// Creating services.
    #[error(transparent)]
    Create(#[from] CreateError),
    /// Opening a port.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// Publishing.
    #[error(transparent)]
    Publish(#[from] PublishError),
    /// Receiving.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
}
