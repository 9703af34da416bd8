//! Errors of opening and using ports.
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

/// Error of creating the services of a topic, or of opening or using a port.
#[expect(missing_docs, reason = "the texts name the fields")]
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PortError {
    /// iceoryx2 does not accept the topic's name, or the contract's version.
    #[error("cannot create the topic {topic}: not a name that iceoryx2 accepts")]
    CreateName { topic: &'static str },
    /// The service of messages.
    #[error("cannot create the topic {topic}: {reason:?}")]
    CreateMessages { topic: &'static str, reason: PublishSubscribeOpenOrCreateError },
    /// The service of wake-ups.
    #[error("cannot create the topic {topic}: {reason:?}")]
    CreateWakeUps { topic: &'static str, reason: EventOpenOrCreateError },
    /// iceoryx2 does not accept the topic's name, or the contract's version.
    #[error("cannot open the topic {topic}: not a name that iceoryx2 accepts")]
    OpenName { topic: &'static str },
    /// The topic is missing, or has another contract version.
    #[error(
        "cannot open the topic {topic}: {reason:?}. Cure: start the pipeline with `flockeye up`, and \
         use stages of contract version {CONTRACT_VERSION}"
    )]
    OpenMessages { topic: &'static str, reason: PublishSubscribeOpenError },
    /// The topic's event service is missing.
    #[error(
        "cannot open the topic {topic}: {reason:?}. Cure: start the pipeline with `flockeye up`, and \
         use stages of contract version {CONTRACT_VERSION}"
    )]
    OpenWakeUps { topic: &'static str, reason: EventOpenError },
    /// The topic has no place for a publisher.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Publisher { topic: &'static str, reason: PublisherCreateError },
    /// The topic has no place for the notifier of a publisher's readers.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Notifier { topic: &'static str, reason: NotifierCreateError },
    /// The topic has no place for a subscriber.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Subscriber { topic: &'static str, reason: SubscriberCreateError },
    /// The topic has no place for the listener that wakes a subscriber's process.
    #[error("cannot join the topic {topic}: {reason:?}")]
    Listener { topic: &'static str, reason: ListenerCreateError },
    /// The message is too long.
    #[error("cannot publish on {topic}: {items} items where the topic has room for {room}")]
    TooManyItems { topic: &'static str, items: usize, room: usize },
    /// There is no memory: subscribers keep too many messages.
    #[error("cannot publish on {topic}: {reason:?}")]
    Loan { topic: &'static str, reason: LoanError },
    /// The message cannot be sent.
    #[error("cannot publish on {topic}: {reason:?}")]
    Send { topic: &'static str, reason: SendError },
    /// Subscribers cannot be woken.
    #[error("cannot publish on {topic}: {reason:?}")]
    WakeUp { topic: &'static str, reason: NotifierNotifyError },
    /// A connection to a subscriber broke.
    #[error("cannot publish on {topic}: {reason:?}")]
    PublisherConnection { topic: &'static str, reason: ConnectionFailure },
    /// This process keeps too many messages, or a connection broke.
    #[error("cannot receive from {topic}: {reason:?}")]
    Receive { topic: &'static str, reason: IoxReceiveError },
    /// A connection to a publisher broke.
    #[error("cannot receive from {topic}: {reason:?}")]
    SubscriberConnection { topic: &'static str, reason: ConnectionFailure },
}

impl PortError {
    /// Whether the topic exists and has no place for another port.
    pub fn is_crowded(&self) -> bool {
        matches!(
            self,
            Self::Publisher { .. }
                | Self::Notifier { .. }
                | Self::Subscriber { .. }
                | Self::Listener { .. }
        )
    }
}
