//! A body compared with a picture from some starts.

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::CornerRay;
use nalgebra::Isometry3;

use crate::aligner::{Aligner, Sought};
use crate::decide::Decision;
use crate::decide::markers::supports;
use crate::hypothesis::Hypothesis;

/// A body, the picture that it is looked for in, and what else counts.
#[derive(Debug)]
pub struct Comparison<'s> {
    /// The picture, and where alignment starts.
    pub sought: Sought<'s>,
    /// The body.
    pub body: &'s Body,
    /// Rays of its decoded markers' corners.
    pub decoded: &'s [CornerRay],
    /// The prediction of a confirmed track, `camera_from_markers`.
    pub confirmed: Option<&'s Isometry3<f64>>,
    /// Whether one facet alone starts no track, because starts are left that were not tried.
    pub needs_facets: bool,
    /// The prediction that is searched round if no start leads to the body.
    pub round: Option<&'s Isometry3<f64>>,
}

impl Comparison<'_> {
    /// Looks for the body, and adds what it tries to `tried`.
    pub fn run(&self, aligner: &Aligner, tried: &mut Vec<Hypothesis>) -> Decision {
        let Self { sought, body, decoded, .. } = self;
        let is_marked = |pose: &Isometry3<f64>| supports(body, decoded, pose);
        let decision = match self.confirmed {
            Some(predicted) => aligner.confirm(sought, predicted, is_marked, tried),
            None => aligner.initiate(sought, is_marked, self.needs_facets, tried),
        };
        match self.round {
            Some(predicted) => {
                aligner.or_round(decision, sought.target, sought.picture, predicted, tried)
            }
            None => decision,
        }
    }
}
