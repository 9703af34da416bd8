//! A neighbour as in alignment: the picture, the model at the published pose, and the residual
//! between them.

use anyhow::Context as _;
use flockeye_config::Resolved;
use flockeye_contract::{FrameHeader, MeasuredBy, Track, ViewHeader};
use flockeye_convert::{RadianceCache, isometry};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::Bodies;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::search::{PredictedNeighbour, roi_view};
use flockeye_imaging::align::{AlignOptions, BodyPrint, Picture, depict};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::sphere::{Cut, Interpolation, SphereImage, rectify_into};
use nalgebra::{Isometry3, Matrix3, Vector3};

use crate::picture::gray_jpeg;
use crate::wire::{CloseupHead, Likeness};

/// Makes close-ups of one pipeline's neighbours.
pub(crate) struct CloseupMaker {
    bodies: Bodies,
    prints: Vec<BodyPrint>,
    camera: Camera,
    pixels_per_radian: f64,
    observer_from_camera: Isometry3<f64>,
    radiances: RadianceCache,
}

impl CloseupMaker {
    /// A maker for the neighbours' bodies of this configuration.
    ///
    /// # Errors
    /// The dictionary cannot be read, a body cannot be drawn, or the camera's curve does not rise.
    pub(crate) fn new(resolved: &Resolved) -> anyhow::Result<Self> {
        let dictionary = Dictionary::load(&resolved.bodies.dictionary)?;
        let prints =
            resolved.bodies.iter().map(|body| BodyPrint::new(body, |id| dictionary.print(id)));
        Ok(Self {
            bodies: resolved.bodies.clone(),
            prints: prints.collect::<Result<_, _>>().context("a body cannot be drawn")?,
            camera: resolved.camera,
            pixels_per_radian: resolved.roi_options.pixels_per_radian,
            observer_from_camera: resolved.observer_from_camera,
            radiances: RadianceCache::new(resolved.measured_response)?,
        })
    }

    /// The close-up of a track's neighbour in the track's frame: its head and the JPEG. `None`
    /// where there is nothing to see, for example for a pose inside the camera.
    ///
    /// # Errors
    /// The frame does not match its header, or its response curve is unknown.
    pub(crate) fn closeup(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
        track: &Track,
        key: &str,
    ) -> anyhow::Result<Option<(CloseupHead, Vec<u8>)>> {
        let target = track.target as usize;
        let (Some(body), Some(print)) = (self.bodies.get(target), self.prints.get(target)) else {
            return Ok(None);
        };
        // The measurement of this frame; between measurements the prediction.
        let observer_from_target = match MeasuredBy::try_from(track.measured_by) {
            Ok(MeasuredBy::Aligned | MeasuredBy::Decoded) => {
                isometry(&track.measured_observer_from_target)
            }
            _ => isometry(&track.observer_from_target),
        };
        let camera_from_markers =
            self.observer_from_camera.inverse() * observer_from_target * body.target_from_markers;
        // The view that a plan would request, if the pose were exact.
        let seen = PredictedNeighbour::from_pose(
            target,
            body,
            &camera_from_markers,
            &Matrix3::zeros(),
            &Vector3::zeros(),
        );
        let Some(planned) = seen.and_then(|seen| roi_view(&seen, self.pixels_per_radian)) else {
            return Ok(None);
        };
        let view = planned.view;
        let sphere = SphereImage::new(pixels, header.stride as usize, self.camera)?;
        let side = view.size_px as usize;
        let mut cut = vec![0; side * side];
        let interpolation = Interpolation::suited_to(&view, &self.camera);
        let distance_m = camera_from_markers.translation.vector.norm();
        rectify_into(&sphere, &Cut { view, distance_m, interpolation }, &mut cut, side)?;
        let curve = ViewHeader {
            transfer: header.transfer,
            gamma: header.gamma,
            range: header.range,
            ..ViewHeader::default()
        };
        let light = self.radiances.of(&curve)?;
        let image = LumaImage::new(&cut, side, side, side)?;
        let picture = Picture::still(image, view, light, self.camera.pixels_per_radian());
        let head = |size, panels, score| CloseupHead {
            key: key.to_owned(),
            target: track.target,
            size,
            panels,
            score,
        };
        match depict(print, &picture, &camera_from_markers, &AlignOptions::default()) {
            Ok(shown) => {
                let (width, height) = (shown.width, shown.height);
                let score = Likeness {
                    correlation: shown.evidence.correlation as f32,
                    log_odds: shown.evidence.log_odds as f32,
                    facets: shown.evidence.agreeing_facets,
                };
                let jpeg = gray_jpeg(&shown.panels(light), 3 * width, height)?;
                Ok(Some((head([width as u32, height as u32], 3, Some(score)), jpeg)))
            }
            // A body that is too far or hidden is shown without the model.
            Err(_) => {
                let jpeg = gray_jpeg(&cut, side, side)?;
                Ok(Some((head([view.size_px; 2], 1, None), jpeg)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use bytemuck::Zeroable;
    use flockeye_config::Pipeline;

    use super::*;

    #[test]
    fn what_cannot_be_seen_gives_no_close_up_and_no_panic() {
        let resolved = Resolved::of(Pipeline::default()).unwrap();
        let mut maker = CloseupMaker::new(&resolved).unwrap();
        let header =
            FrameHeader { width: 3840, height: 1920, stride: 3840, ..FrameHeader::default() };
        let pixels = vec![128; 3840 * 1920];
        let mut closeup = |track: &Track| maker.closeup(&header, &pixels, track, "0.0.1").unwrap();
        let pose = flockeye_contract::Pose::default();
        let inside = Track { observer_from_target: pose, ..Track::zeroed() };
        assert!(closeup(&inside).is_none(), "the camera is inside the body");
        let at = |x: f64| {
            let pose = flockeye_contract::Pose { position: [x, 0.0, 0.0], ..pose };
            Track { observer_from_target: pose, ..Track::zeroed() }
        };
        assert!(closeup(&Track { target: 99, ..at(1.0) }).is_none(), "no such body");
        let (head, jpeg) = closeup(&at(1.0)).unwrap();
        assert_eq!((head.panels, jpeg.starts_with(&[0xff, 0xd8])), (3, true));
        assert!(head.score.unwrap().correlation.abs() < 0.5, "there is nothing but grey: {head:?}");
        // Far away a body is a speck: it is shown, and not compared.
        let (head, _) = closeup(&at(60.0)).unwrap();
        assert_eq!((head.panels, head.score), (1, None));
    }
}
