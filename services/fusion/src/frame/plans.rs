//! The plans that open frames follow.

use std::collections::BTreeMap;
use std::rc::Rc;

use flockeye_geometry::search::{Plan, Purpose, StopRule};

/// Plans that are remembered, for frames that still follow them.
const REMEMBERED_PLANS: usize = 16;

/// What a plan asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct FollowedPlan {
    /// Why each view is cut, by the view's place in the plan.
    pub purposes: Vec<Purpose>,
    /// When the search stops.
    pub stop_rule: StopRule,
}

/// The last plans of this process, which numbers them from 1.
#[derive(Debug, Default)]
pub struct Plans {
    newest: u64,
    remembered: BTreeMap<u64, Rc<FollowedPlan>>,
}

impl Plans {
    /// Remembers a plan.
    pub fn add(&mut self, plan_id: u64, plan: &Plan) {
        let purposes = plan.views.iter().map(|view| view.purpose).collect();
        let followed = FollowedPlan { purposes, stop_rule: plan.stop_rule };
        self.newest = plan_id;
        self.remembered.insert(plan_id, Rc::new(followed));
        while self.remembered.len() > REMEMBERED_PLANS {
            self.remembered.pop_first();
        }
    }

    /// A plan, as far as it is remembered.
    pub fn get(&self, plan_id: u64) -> Option<&Rc<FollowedPlan>> {
        self.remembered.get(&plan_id)
    }

    /// Whether this process made a plan of this number.
    pub fn has_made(&self, plan_id: u64) -> bool {
        (1..=self.newest).contains(&plan_id)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::{alpha, planner, tracker_of};
    use crate::planning::Planning;

    #[test]
    fn old_plans_are_forgotten() {
        let tracker = tracker_of(vec![alpha()], 1);
        let (mut planning, mut plans) = (Planning::new(planner()), Plans::default());
        for _ in 0..100 {
            let next = planning.next(&tracker);
            plans.add(next.plan_id, &next.plan);
        }
        assert_eq!(plans.remembered.len(), REMEMBERED_PLANS);
        assert_eq!(plans.get(100).unwrap().purposes[0], Purpose::Partition(0));
        assert_eq!(plans.get(1), None);
        assert!(plans.has_made(1) && !plans.has_made(0) && !plans.has_made(101));
    }
}
