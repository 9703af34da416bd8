//! The services of topics, by which ports of different processes connect.

use flockeye_contract::{CONTRACT_VERSION, Topic, TopicVisitor, VERSION_ATTRIBUTE, visit_topics};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::error::PortError;
use crate::memory::{Budget, Limits, MAX_EVENT_PORTS, MAX_NODES};

/// Shared memory between processes.
pub(super) type Service = ipc::Service;
/// Carries a topic's messages.
pub(super) type DataService<T> =
    publish_subscribe::PortFactory<Service, [<T as Topic>::Item], <T as Topic>::Header>;
/// Wakes a topic's readers.
pub(super) type WakeService = event::PortFactory<Service>;

/// Keeps a topic's services alive while no stage has them open.
pub type TopicServices = Box<dyn std::any::Any>;

/// Creates the services of one topic, every lane of it, with its limits. Where stages fly on
/// without a launcher, the services exist already and must have these limits.
///
/// # Errors
/// [`PortError`] with iceoryx2's reason.
pub fn create_services<T: Topic + 'static>(
    node: &Node<Service>,
    limits: &Limits,
) -> Result<Vec<TopicServices>, PortError> {
    (0..limits.lanes).map(|lane| create_lane::<T>(node, limits, lane)).collect()
}

/// Creates the services of all topics, with their limits.
///
/// # Errors
/// [`PortError`] with iceoryx2's reason.
pub fn create_all_services(
    node: &Node<Service>,
    budget: &Budget,
) -> Result<Vec<TopicServices>, PortError> {
    struct Creation<'a> {
        node: &'a Node<Service>,
        budget: &'a Budget,
        services: Vec<TopicServices>,
    }
    impl TopicVisitor for Creation<'_> {
        type Error = PortError;

        fn visit<T: Topic + 'static>(&mut self) -> Result<(), PortError> {
            let limits = self.budget.topic::<T>();
            self.services.extend(create_services::<T>(self.node, limits)?);
            Ok(())
        }
    }
    let mut creation = Creation { node, budget, services: Vec::new() };
    visit_topics(&mut creation)?;
    Ok(creation.services)
}

fn create_lane<T: Topic + 'static>(
    node: &Node<Service>,
    limits: &Limits,
    lane: usize,
) -> Result<TopicServices, PortError> {
    let topic = T::NAME;
    let name = service_name::<T>(limits, lane).ok_or(PortError::CreateName { topic })?;
    let version = version().ok_or(PortError::CreateName { topic })?;
    let data = node
        .service_builder(&name)
        .publish_subscribe::<[T::Item]>()
        .user_header::<T::Header>()
        .enable_safe_overflow(limits.patience.is_none())
        .max_publishers(limits.publishers)
        .max_subscribers(limits.subscribers)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(limits.buffer)
        .subscriber_max_borrowed_samples(limits.borrowed)
        .history_size(limits.history)
        .open_or_create_with_attributes(&version)
        .map_err(|reason| PortError::CreateMessages { topic, reason })?;
    let wake = node
        .service_builder(&name)
        .event()
        .max_listeners(MAX_EVENT_PORTS)
        .max_notifiers(MAX_EVENT_PORTS)
        .max_nodes(MAX_NODES)
        .open_or_create()
        .map_err(|reason| PortError::CreateWakeUps { topic, reason })?;
    Ok(Box::new((data, wake)))
}

/// Name of a lane's service: the topic's own name, or `NAME/0`, `NAME/1` ... for a topic with
/// lanes. `None` for a name that iceoryx2 does not accept.
pub(super) fn service_name<T: Topic>(limits: &Limits, lane: usize) -> Option<ServiceName> {
    let name = match limits.has_lanes {
        true => format!("{}/{lane}", T::NAME),
        false => T::NAME.to_owned(),
    };
    name.as_str().try_into().ok()
}

/// Attributes of services of this contract version. `None` for a version that iceoryx2 does not
/// accept.
pub(super) fn version() -> Option<AttributeVerifier> {
    let (key, value) = (VERSION_ATTRIBUTE.try_into().ok()?, CONTRACT_VERSION.try_into().ok()?);
    AttributeVerifier::new().require(&key, &value).ok()
}
