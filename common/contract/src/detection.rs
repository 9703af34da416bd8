//! `detection`: markers that a worker found in one view. It also acknowledges the view.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_count;
use crate::{ContractError, FrameStamp, ViewHeader};

/// Header of a detection record. Payload: its [`DetectedMarker`]s; there may be none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/DetectionHeader")]
#[repr(C)]
pub struct DetectionHeader {
    /// The frame the view was cut from.
    pub stamp: FrameStamp,
    /// The plan that requested the view.
    pub plan_id: u64,
    /// Start of rectification's work on the frame, copied from the view. A latency field.
    pub taken_ns: i64,
    /// Publication time of the view, copied from it. A latency field.
    pub issued_ns: i64,
    /// Start of the worker's search, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub received_ns: i64,
    /// Publication time of the record, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub sent_ns: i64,
    /// Rises each time the worker's process is replaced.
    pub generation: u32,
    /// Index of the view in the plan, copied from it.
    pub view_index: u32,
    /// The attempt, copied from the view.
    pub attempt: u32,
    /// The worker that searched it.
    pub worker: u32,
    /// Number of decoded markers in the payload that belong to a configured body. The view is a hit
    /// if there is one.
    pub hits: u32,
    /// 1 if the view could not be searched (the log has the reason); the record still acknowledges
    /// it.
    pub failed: u32,
    /// Generation of the rectification that requested the view, copied from it.
    pub view_generation: u32,
    /// Always 0.
    pub reserved: u32,
}

/// One decoded marker.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/DetectedMarker")]
#[repr(C)]
pub struct DetectedMarker {
    /// Unit rays of the corners in the camera frame, in ArUco's order (clockwise from the printed
    /// pattern's top left).
    pub rays_in_camera: [[f64; 3]; 4],
    /// Standard deviation of each ray, perpendicular to it, radians. The error of the camera's model,
    /// `camera.lens_error_px`, is part of it.
    pub deviations: [f64; 4],
    /// The same corners in the view, pixels, (0, 0) the centre of the first.
    pub corners_in_view: [[f32; 2]; 4],
    /// The marker's id in its dictionary.
    pub id: u32,
    /// Always 0.
    pub reserved: u32,
}

/// Maximum number of markers in a record; larger records are refused.
pub const MAX_DETECTED_MARKERS: usize = 256;

impl DetectionHeader {
    /// Answer to a view with the fields copied from it.
    pub fn answering(view: &ViewHeader) -> Self {
        Self {
            stamp: view.stamp,
            plan_id: view.plan_id,
            taken_ns: view.taken_ns,
            issued_ns: view.issued_ns,
            view_index: view.view_index,
            attempt: view.attempt,
            view_generation: view.generation,
            ..Self::default()
        }
    }

    /// Refuses records with rays that are no unit vectors or with invalid standard deviations.
    pub fn check(&self, markers: &[DetectedMarker]) -> Result<(), ContractError> {
        check_count("markers in a view", markers.len(), MAX_DETECTED_MARKERS)?;
        check_count("hits among the markers", self.hits as usize, markers.len())?;
        for marker in markers {
            for ray in &marker.rays_in_camera {
                let norm = ray.iter().map(|x| x * x).sum::<f64>().sqrt();
                // NaN compares false, so it is refused too.
                let is_unit = (norm - 1.0).abs() < 1e-6;
                if !is_unit {
                    return Err(ContractError::Ray { norm });
                }
            }
            if !marker.deviations.iter().all(|&sigma| sigma > 0.0 && sigma < 1.0) {
                return Err(ContractError::NotFinite { what: "deviation of a corner" });
            }
        }
        Ok(())
    }
}
