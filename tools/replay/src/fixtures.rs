//! Artificial frames for tests, shared with fusion's own tests.

use flockeye_fusion::{PoseMeasurement, Record};

pub(crate) use self::scene::*;

#[path = "../../../services/fusion/tests/scene/mod.rs"]
mod scene;
