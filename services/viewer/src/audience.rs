//! The audience: pages and Foxglove's clients.

use std::sync::Arc;

use crate::foxglove_view::FoxgloveView;
use crate::pages::{Demand, Pages};

/// The pages and clients that are connected.
pub(crate) struct Audience {
    pub pages: Arc<Pages>,
    /// Foxglove's clients, where they are served.
    pub foxglove: Option<FoxgloveView>,
}

impl Audience {
    /// The union of all pages' and clients' demands.
    pub(crate) fn wanted(&self) -> Demand {
        let wanted = self.foxglove.as_ref().map(FoxgloveView::wanted).unwrap_or_default();
        self.pages.wanted().or(wanted)
    }

    /// Whether a page or client can take a picture or a close-up now.
    pub(crate) fn takes_pictures(&self, wanted: Demand) -> bool {
        let takes =
            |foxglove: &FoxgloveView| foxglove.wanted().pictures || foxglove.wanted().closeups;
        (wanted.pictures || wanted.closeups)
            && (self.pages.takes_pictures() || self.foxglove.as_ref().is_some_and(takes))
    }

    /// Calls `tell` with Foxglove's clients, where they are served.
    pub(crate) fn to_foxglove(&self, tell: impl FnOnce(&FoxgloveView)) {
        if let Some(foxglove) = &self.foxglove {
            tell(foxglove);
        }
    }
}
