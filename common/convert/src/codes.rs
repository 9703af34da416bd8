//! Conversions between codes of the contract and enumerations of geometry and imaging.

use flockeye_contract as contract;
use flockeye_contract::{FrameHeader, PixelFormat, Projection, Range, Transfer, ViewHeader};
use flockeye_geometry::camera::{Camera, CameraModel};
use flockeye_geometry::search;
use flockeye_imaging::light::{CodeRange, TransferCurve};

/// The contract's code of a camera's model.
pub fn projection_of(camera: &Camera) -> Projection {
    match camera.model() {
        CameraModel::Equirectangular { .. } => Projection::Equirectangular,
        CameraModel::DualFisheye(_) => Projection::DualFisheye,
        CameraModel::Stereographic { .. } => Projection::Stereographic,
    }
}

/// Common fields of the headers of a camera's frames: 8-bit luma of full range, with no gap between
/// rows.
pub fn frame_header(
    camera: &Camera,
    (transfer, gamma): (Transfer, f32),
    readout_ms: f64,
) -> FrameHeader {
    FrameHeader {
        readout_ns: (readout_ms * 1e6) as u64,
        width: camera.width(),
        height: camera.height(),
        stride: camera.width(),
        pixel_format: PixelFormat::Gray8.code(),
        transfer: transfer.code(),
        gamma,
        range: Range::Full.code(),
        projection: projection_of(camera).code(),
        ..FrameHeader::default()
    }
}

/// Transfer curve of a code; `None` for a measured table, which the configuration contains.
pub fn transfer_curve(transfer: Transfer, gamma: f32) -> Option<TransferCurve> {
    match transfer {
        Transfer::Srgb => Some(TransferCurve::Srgb),
        Transfer::Gamma => Some(TransferCurve::Gamma(gamma)),
        Transfer::Linear => Some(TransferCurve::Linear),
        Transfer::Table => None,
    }
}

/// Code values of black and white.
pub fn code_range(range: Range) -> CodeRange {
    match range {
        Range::Full => CodeRange::Full,
        Range::Limited => CodeRange::Limited,
    }
}

/// The contract's code of a stop rule.
pub fn stop_rule(rule: search::StopRule) -> contract::StopRule {
    match rule {
        search::StopRule::FirstHit => contract::StopRule::FirstHit,
        search::StopRule::All => contract::StopRule::All,
        search::StopRule::Deadline => contract::StopRule::Deadline,
    }
}

/// Search windows of a view. An unknown code, which no checked view has, means all windows.
pub fn search_of(view: &ViewHeader) -> search::Search {
    match contract::Search::try_from(view.search) {
        Ok(contract::Search::FineWindow) => search::Search::FineWindow,
        Ok(contract::Search::CoarseWindow) => search::Search::CoarseWindow,
        Ok(contract::Search::Nothing) => search::Search::Nothing,
        Ok(contract::Search::AllWindows) | Err(_) => search::Search::AllWindows,
    }
}

/// Purpose of a view, from its header. `None` for an unknown code.
pub fn purpose_of(view: &ViewHeader) -> Option<search::Purpose> {
    match contract::ViewKind::try_from(view.kind).ok()? {
        contract::ViewKind::Partition => Some(search::Purpose::Partition(view.tile as usize)),
        contract::ViewKind::HighResolution => {
            Some(search::Purpose::HighResolution(view.tile as usize))
        }
        contract::ViewKind::Roi => Some(search::Purpose::Roi(view.target as usize)),
        contract::ViewKind::Proposal => Some(search::Purpose::Proposal),
    }
}

/// The contract's code of a way to search a view.
pub fn search_code(search: search::Search) -> contract::Search {
    match search {
        search::Search::AllWindows => contract::Search::AllWindows,
        search::Search::FineWindow => contract::Search::FineWindow,
        search::Search::CoarseWindow => contract::Search::CoarseWindow,
        search::Search::Nothing => contract::Search::Nothing,
    }
}
