//! The page's first message: camera, tiles, bodies.

use flockeye_config::Resolved;
use flockeye_contract::{self as contract, StageName};
use flockeye_convert::xyzw;
use flockeye_geometry::body::Body;
use flockeye_geometry::view::View;
use nalgebra::{Isometry3, Point3};

use crate::wire;

/// The first message to a page.
pub(crate) fn hello(resolved: &Resolved, instance: &str, rate: f64) -> wire::Hello {
    let pipeline = &resolved.pipeline;
    let tiles = |views: &[View]| views.iter().map(tile).collect();
    let runs = StageName::ALL.into_iter().filter(|stage| pipeline.runs(*stage));
    wire::Hello {
        protocol: wire::PROTOCOL,
        instance: instance.to_owned(),
        flow: pipeline.flow().name(),
        simulated: pipeline.runs(StageName::Simulator),
        observer: pipeline.observer.name.clone(),
        camera_px: [resolved.camera.width(), resolved.camera.height()],
        observer_from_camera: transform(&resolved.observer_from_camera),
        partitions: tiles(&resolved.partition_views),
        high_resolution: tiles(&resolved.high_resolution_tiles),
        bodies: resolved.bodies.iter().map(body).collect(),
        stages: runs.map(StageName::name).collect(),
        rate: rate as f32,
        recording: None,
    }
}

pub(crate) fn pose(pose: &contract::Pose) -> wire::PagePose {
    wire::PagePose { p: pose.position.map(|x| x as f32), q: pose.orientation.map(|x| x as f32) }
}

fn transform(isometry: &Isometry3<f64>) -> wire::PagePose {
    pose(&flockeye_convert::pose(isometry))
}

/// A view in the page's format.
pub(crate) fn tile(view: &View) -> wire::ViewSquare {
    let half = f64::from(view.size_px) / (2.0 * view.focal_px);
    wire::ViewSquare { q: xyzw(&view.camera_from_view).map(|x| x as f32), half: half as f32 }
}

fn body(body: &Body) -> wire::PageBody {
    let facets = body.facets().iter().map(|facet| facet.outline.iter().map(point).collect());
    let markers = body.markers.iter().map(|marker| wire::PageMarker {
        id: marker.id,
        corners: marker.corners.each_ref().map(point),
    });
    wire::PageBody {
        name: body.name.clone(),
        target_from_markers: transform(&body.target_from_markers),
        facets: facets.collect(),
        markers: markers.collect(),
    }
}

fn point(point: &Point3<f64>) -> [f32; 3] {
    [point.x, point.y, point.z].map(|x| x as f32)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_config::Pipeline;

    #[test]
    fn a_page_learns_tiles_and_bodies() {
        let resolved = Resolved::of(Pipeline::default()).unwrap();
        let hello = hello(&resolved, "field", 15.0);
        assert_eq!(hello.partitions.len(), resolved.partition_views.len());
        assert_eq!((hello.bodies[0].name.as_str(), hello.camera_px), ("alpha", [3840, 1920]));
        assert_eq!(hello.bodies[0].markers.len(), resolved.bodies.get(0).unwrap().markers.len());
        assert!(hello.stages.contains(&"simulator") && !hello.stages.contains(&"capture"));
        let half = hello.partitions[0].half;
        let field = f64::from(half).atan() * 2.0;
        assert!((field - resolved.partition_views[0].field_rad()).abs() < 1e-6);
    }
}
