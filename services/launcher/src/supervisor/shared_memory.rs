//! The shared memory of a pipeline, which its launcher creates.

use std::rc::Rc;
use std::time::Duration;

use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, TopicServices, create_all_services};
use iceoryx2::prelude::*;

/// Timeout of the clean-up after dead processes.
const CLEANUP_TIME: Duration = Duration::from_secs(1);

/// All topics of a pipeline. Ports are dropped before it.
pub(super) struct SharedMemory {
    // Services drop before the node.
    _services: Vec<TopicServices>,
    node: Rc<Node<ipc::Service>>,
    /// Memory of each topic.
    pub budget: Budget,
}

impl SharedMemory {
    /// Creates all topics, or opens those of an earlier launcher whose stages fly on.
    pub(super) fn create(instance: &Instance, budget: Budget) -> anyhow::Result<Self> {
        let node = instance.create_node("launcher", "cannot open shared memory")?;
        // An earlier launcher may have been killed while its stages fly on.
        node.blocking_cleanup_dead_nodes(CLEANUP_TIME);
        let services = create_all_services(&node, &budget)?;
        Ok(Self { _services: services, node, budget })
    }

    /// Ports of the launcher, whose messages are not counted.
    pub(super) fn ports(&self) -> Ports {
        Ports::new(self.node.clone(), self.budget.clone(), SharedCounters::default())
    }

    /// Frees the ports of dead processes.
    pub(super) fn clean_up(&self) {
        self.node.blocking_cleanup_dead_nodes(CLEANUP_TIME);
    }
}
