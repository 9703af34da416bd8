//! Search rate of each part of the sphere in a running pipeline.

use flockeye_config::Resolved;
use flockeye_contract::{Detections, Plans};
use flockeye_runtime::ports::{PortError, Ports, Subscriber};
use flockeye_tables::sweep::{Sweep, SweepReport};

/// A [`Sweep`] of a running pipeline.
pub(crate) struct SweepWatch {
    plans: Subscriber<Plans>,
    detections: Subscriber<Detections>,
    sweep: Sweep,
}

impl SweepWatch {
    /// Subscribes to plans and detection records. `None` where the search mode sweeps nothing.
    pub(crate) fn open(resolved: &Resolved, ports: &mut Ports) -> anyhow::Result<Option<Self>> {
        let Some(sweep) = Sweep::of(resolved)? else { return Ok(None) };
        let (plans, detections) = (ports.subscriber()?, ports.subscriber()?);
        Ok(Some(Self { plans, detections, sweep }))
    }

    /// Receives all waiting messages.
    pub(crate) fn receive(&mut self) -> Result<(), PortError> {
        // Plans come first, because records refer to them.
        while let Some(plan) = self.plans.receive()? {
            self.sweep.plan(plan.header.plan_id, plan.items());
        }
        while let Some(record) = self.detections.receive()? {
            self.sweep.searched(&record.header);
        }
        Ok(())
    }

    pub(crate) fn report(&self) -> Option<SweepReport> {
        self.sweep.report()
    }
}
