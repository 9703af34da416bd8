//! What the world draws, as the contract's messages.

use flockeye_config::Resolved;
use flockeye_contract::{
    BodyTruth, FrameHeader, FrameStamp, PixelFormat, Projection, Range, Transfer, TruthHeader,
};
use flockeye_convert::{pose, projection_of, xyzw};
use flockeye_geometry::body::{Bodies, Body};
use nalgebra::Isometry3;

use crate::{FrameTruth, TargetTruth};

/// Writes the messages of one flight.
#[derive(Debug)]
pub(crate) struct TruthWriter {
    /// Width and height of a frame.
    size_px: (u32, u32),
    projection: Projection,
    /// Its code and its gamma.
    transfer: (Transfer, f32),
    readout_ns: u64,
    bodies: Vec<Body>,
    observer_from_camera: Isometry3<f64>,
    generation: u32,
}

impl TruthWriter {
    /// A writer for these bodies, in generation `generation` of this stage.
    pub(crate) fn new(resolved: &Resolved, flying: Option<&Bodies>, generation: u32) -> Self {
        Self {
            size_px: (resolved.camera.width(), resolved.camera.height()),
            projection: projection_of(&resolved.camera),
            transfer: resolved.transfer,
            readout_ns: (resolved.pipeline.camera.readout_ms * 1e6) as u64,
            bodies: flying.into_iter().flat_map(Bodies::iter).cloned().collect(),
            observer_from_camera: resolved.observer_from_camera,
            generation,
        }
    }

    /// Width and height of a frame, pixels.
    pub(crate) fn size_px(&self) -> (u32, u32) {
        self.size_px
    }

    /// The stamp of a frame that is published at `published_ns`.
    pub(crate) fn stamp(
        &self,
        frame: u64,
        exposure_ns: i64,
        truth: &FrameTruth,
        published_ns: i64,
    ) -> FrameStamp {
        FrameStamp {
            sequence: frame,
            exposure_ns,
            stream_ns: (truth.time_s * 1e9).round() as i64,
            published_ns,
            epoch: 0,
            source_generation: self.generation,
        }
    }

    /// The header of a frame.
    pub(crate) fn frame(&self, stamp: FrameStamp, truth: &FrameTruth) -> FrameHeader {
        let (width, height) = self.size_px;
        FrameHeader {
            stamp,
            exposure_time_ns: (truth.exposure_s * 1e9).round() as u64,
            readout_ns: self.readout_ns,
            width,
            height,
            stride: width,
            pixel_format: PixelFormat::Gray8.code(),
            transfer: self.transfer.0.code(),
            gamma: self.transfer.1,
            range: Range::Full.code(),
            projection: self.projection.code(),
        }
    }

    /// A frame's truth.
    pub(crate) fn truth(
        &self,
        stamp: FrameStamp,
        truth: &FrameTruth,
    ) -> (TruthHeader, Vec<BodyTruth>) {
        let targets = truth.bodies.iter().zip(&self.bodies);
        let bodies = targets.map(|(target, body)| self.body_truth(target, body)).collect();
        let header = TruthHeader {
            stamp,
            world_from_camera: xyzw(&truth.camera.world_from_camera),
            observer_yaw: truth.camera.yaw(),
            exposure_s: truth.exposure_s,
        };
        (header, bodies)
    }

    fn body_truth(&self, target: &TargetTruth, body: &Body) -> BodyTruth {
        let camera_from_target = target.camera_from_markers * body.target_from_markers.inverse();
        BodyTruth {
            camera_from_markers: pose(&target.camera_from_markers),
            observer_from_target: pose(&(self.observer_from_camera * camera_from_target)),
            best_side_px: target.best_side_px,
            blur_px: target.blur_px,
            name: target.name.as_str().into(),
            target: target.target as u32,
            markers_visible_50: target.markers_visible_50,
            markers_visible_90: target.markers_visible_90,
            localisable: u32::from(target.localisable),
        }
    }
}
