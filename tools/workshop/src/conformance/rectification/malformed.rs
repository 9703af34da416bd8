//! Test with malformed frames and plans.

use flockeye_contract::{FrameHeader, PlanHeader, PlannedView, StopRule};
use flockeye_runtime::clock;

use super::{Bench, PAGE, STALE, Script, TAKEN_UP};
use crate::conformance::report::OWES;

impl Script<'_> {
    /// Malformed messages must not affect later ones.
    pub(super) fn malformed(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let honest = self.frame();
        for frame in [
            FrameHeader { height: 60_000, ..honest },
            FrameHeader { width: 0, height: 0, stride: 0, ..honest },
            FrameHeader { width: honest.width - 1, ..honest },
            FrameHeader { pixel_format: 77, ..honest },
        ] {
            self.frames.send(frame, &self.picture)?;
            bench.pass(TAKEN_UP)?;
            if !self.goes_on(bench, &format!("{frame:?}"))? {
                return Ok(());
            }
        }
        let largest = self.resolved.largest_view_px();
        let view = PlannedView {
            camera_from_view: [0.0, 0.0, 0.0, 1.0],
            focal_px: 100.0,
            size_px: 100,
            ..PlannedView::default()
        };
        for view in [
            PlannedView { size_px: 0, ..view },
            PlannedView { size_px: largest + 1, ..view },
            PlannedView { focal_px: f64::NAN, ..view },
            PlannedView { camera_from_view: [f64::NAN; 4], ..view },
            PlannedView { camera_from_view: [0.0; 4], ..view },
        ] {
            self.plan_id += 1;
            let made_ns = clock::monotonic_ns();
            let plan = PlanHeader {
                plan_id: self.plan_id,
                made_ns,
                view_budget: 1,
                ..PlanHeader::default()
            };
            self.plans.send(plan, &[view])?;
            // The frame must end, by any plan.
            self.fly(bench, |_| Some(0))?;
            if !self.goes_on(bench, &format!("{view:?}"))? {
                return Ok(());
            }
        }
        bench.pass(STALE)?;
        let (_, told) = self.fly(bench, |_| Some(0))?;
        for cut in &told.views {
            bench.report.field(
                "a plan older than 1 s is not followed",
                PAGE,
                "plan_id",
                cut.header.plan_id,
                0,
            );
        }
        Ok(())
    }

    /// Checks that a frame with a valid plan is cut after malformed messages.
    fn goes_on(&mut self, bench: &mut Bench, after: &str) -> anyhow::Result<bool> {
        self.plan(1, StopRule::All)?;
        let (_, told) = self.fly(bench, |_| Some(0))?;
        let goes_on = !told.views.is_empty();
        bench.report.holds("malformed frames and plans cost nothing else", OWES, goes_on, || {
            format!("the next frame had no view after {after}")
        });
        Ok(goes_on && bench.runs())
    }
}
