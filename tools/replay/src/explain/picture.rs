//! The answer as a picture: the view around the target with markers and hypotheses, and the body's
//! model beside it.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::{Context as _, bail};
use flockeye_config::Resolved;
use flockeye_contract::ViewHeader;
use flockeye_convert::{RadianceCache, image_of, view_of};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::Ray;
use flockeye_geometry::body::Body;
use flockeye_geometry::view::View;
use flockeye_imaging::align::{AlignOptions, BodyPrint, Picture, depict};
use nalgebra::{Isometry3, Point3, Vector2};

use super::explanation::FrameExplanation;
use super::known::FrameKnowledge;
use super::poses;
use crate::recorded::RecordedPixels;
use flockeye_fusion::Verdict;

/// Pixels along the side of the picture of the place.
const SIDE_PX: usize = 720;
/// Radii of the body that the picture shows to each side.
const REACH_RADII: f64 = 1.7;
/// Largest magnification of the recorded view.
const MOST_ENLARGED: f64 = 16.0;

/// Colours of outlines; docs/RECORDING.md explains them.
const PREDICTED: [u8; 3] = [255, 210, 0];
const ACCEPTED: [u8; 3] = [40, 220, 60];
const REFUSED: [u8; 3] = [255, 60, 50];
const RIVAL: [u8; 3] = [230, 80, 255];
const TRUTH: [u8; 3] = [0, 210, 255];
const DECODED: [u8; 3] = [70, 130, 255];

/// A picture in colours.
struct RgbPicture {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

/// Writes the picture.
///
/// # Errors
/// The recording has no pixels of the place, no place is known, or the file cannot be written.
pub(super) fn write(
    path: &Path,
    resolved: &Resolved,
    known: &FrameKnowledge,
    explanation: &FrameExplanation,
) -> anyhow::Result<()> {
    let Some((reference, _)) = poses::reference_pose(resolved, known).or_else(|| {
        let place = poses::place(resolved, known)?;
        Some((place.camera_from_markers, super::explanation::ResidualOf::Prediction))
    }) else {
        bail!("nothing says where {} is, so there is nothing to draw", explanation.target);
    };
    let body = resolved.bodies.get(known.target).context("there is no such body")?;
    let Some((header, pixels)) = best_view(known, &reference) else {
        let has_pixels = known.gathered.views.values().any(|(_, pixels)| pixels.is_some());
        match has_pixels {
            true => bail!(
                "no view of frame {} shows {}, so there is nothing to draw: {}",
                explanation.frame.sequence,
                explanation.target,
                explanation.why
            ),
            false => bail!(
                "the recording has no pixels of views, so there is nothing to draw. Cure: record with them (--frames views)"
            ),
        }
    };
    let mut canvas = scene(known, body, header, pixels, &reference)?;
    if let Some(panels) = model(resolved, known, header, pixels, &reference)? {
        canvas = canvas.beside(&panels);
    }
    canvas.save(path).with_context(|| format!("cannot write {}", path.display()))
}

/// The view that alignment used, or else the view of the place with the highest resolution.
fn best_view<'k>(
    known: &'k FrameKnowledge,
    reference: &Isometry3<f64>,
) -> Option<(&'k ViewHeader, &'k RecordedPixels)> {
    let with_pixels = |index: &u32| {
        let (header, pixels) = known.gathered.views.get(index)?;
        Some((header, pixels.as_ref()?))
    };
    let read = known.trials().filter_map(|trial| with_pixels(&trial.view_index?)).last();
    let direction = Ray::try_new(reference.translation.vector, 1e-9)?;
    let shows =
        |(header, _): &(&ViewHeader, &RecordedPixels)| view_of(header).holds(&direction, 0.0);
    read.filter(shows).or_else(|| {
        let all = known.gathered.views.keys().filter_map(with_pixels);
        all.filter(shows).max_by(|(one, _), (other, _)| one.focal_px.total_cmp(&other.focal_px))
    })
}

/// Draws the part of a view around the target, enlarged, with markers and hypotheses.
fn scene(
    known: &FrameKnowledge,
    body: &Body,
    header: &ViewHeader,
    pixels: &RecordedPixels,
    reference: &Isometry3<f64>,
) -> anyhow::Result<RgbPicture> {
    let view = view_of(header);
    let image = image_of(header, pixels.as_ref())?;
    let range_m = reference.translation.vector.norm();
    let reach_px = view.focal_px * REACH_RADII * body.radius() / range_m;
    let scale = (SIDE_PX as f64 / (2.0 * reach_px)).min(MOST_ENLARGED);
    let direction = Ray::try_new(reference.translation.vector, 1e-9);
    let middle = direction.and_then(|direction| view.project(&direction));
    let middle = middle.map_or_else(|| Vector2::repeat(view.centre_px()), |pixel| pixel.0);
    let half = SIDE_PX as f64 / 2.0;
    let mut canvas = RgbPicture::new(SIDE_PX, SIDE_PX);
    for y in 0..SIDE_PX {
        for x in 0..SIDE_PX {
            let at =
                middle + (Vector2::new(x as f64 + 0.5, y as f64 + 0.5).add_scalar(-half)) / scale;
            let (column, row) = (at.x.round(), at.y.round());
            let last = f64::from(header.size_px) - 1.0;
            if (0.0..=last).contains(&column) && (0.0..=last).contains(&row) {
                let value = image.row(row as usize)[column as usize];
                canvas.put(x as f64, y as f64, [value; 3]);
            }
        }
    }
    let to_canvas = |at: Vector2<f64>| (at - middle) * scale + Vector2::repeat(half - 0.5);
    let mut outline = |pose: &Isometry3<f64>, colour| {
        for facet in facing(body, pose) {
            let corners: Option<Vec<Vector2<f64>>> =
                facet.iter().map(|corner| Some(to_canvas(seen(&view, corner)?))).collect();
            corners.into_iter().for_each(|corners| canvas.polygon(&corners, colour));
        }
    };
    if let Some(truth) = known.gathered.true_body() {
        outline(&flockeye_convert::isometry(&truth.camera_from_markers), TRUTH);
    }
    if let Some((predicted, _)) = known.before.as_ref().and_then(|before| before.predicted) {
        outline(&predicted, PREDICTED);
    }
    let mut hypotheses: Vec<_> = known.trials().flat_map(|trial| trial.decided()).collect();
    // Accepted hypotheses are drawn over all others.
    hypotheses.sort_by_key(|(_, verdict)| *verdict == Verdict::Accepted);
    for (hypothesis, verdict) in hypotheses {
        let Ok(found) = &hypothesis.found else { continue };
        let colour = match verdict {
            Verdict::Accepted => ACCEPTED,
            Verdict::LessLikely | Verdict::Rival | Verdict::Rivals(_) => RIVAL,
            _ => REFUSED,
        };
        outline(&found.camera_from_markers, colour);
    }
    let record = known.gathered.records.get(&header.view_index);
    for marker in record.into_iter().flat_map(|record| &record.markers) {
        let corners: Vec<Vector2<f64>> = marker
            .corners_in_view
            .iter()
            .map(|&[u, v]| to_canvas(Vector2::new(f64::from(u), f64::from(v))))
            .collect();
        canvas.polygon(&corners, DECODED);
    }
    Ok(canvas)
}

/// The facets of a body that face the camera, in its frame.
fn facing(body: &Body, pose: &Isometry3<f64>) -> Vec<Vec<Point3<f64>>> {
    let eye = pose.inverse_transform_point(&Point3::origin());
    let faces = body.facets().iter().filter(|facet| {
        facet.outline.first().is_some_and(|corner| facet.normal.dot(&(eye - corner)) > 0.0)
    });
    faces.map(|facet| facet.outline.iter().map(|corner| pose * corner).collect()).collect()
}

fn seen(view: &View, point_in_camera: &Point3<f64>) -> Option<Vector2<f64>> {
    let towards = Ray::try_new(point_in_camera.coords, 1e-9)?;
    Some(view.project(&towards)?.0)
}

/// Draws picture, model and residual at a pose, one below the other. `None` if they cannot be
/// compared.
fn model(
    resolved: &Resolved,
    known: &FrameKnowledge,
    header: &ViewHeader,
    pixels: &RecordedPixels,
    reference: &Isometry3<f64>,
) -> anyhow::Result<Option<RgbPicture>> {
    let dictionary = Dictionary::load(&resolved.bodies.dictionary)?;
    let body = resolved.bodies.get(known.target).context("there is no such body")?;
    let print =
        BodyPrint::new(body, |id| dictionary.print(id)).context("a body cannot be drawn")?;
    let mut radiances = RadianceCache::new(resolved.measured_response)?;
    let light = radiances.of(header)?;
    let image = image_of(header, pixels.as_ref())?;
    let picture =
        Picture::still(image, view_of(header), light, resolved.camera.pixels_per_radian());
    let Ok(shown) = depict(&print, &picture, reference, &AlignOptions::default()) else {
        return Ok(None);
    };
    let panels = shown.panels(light);
    let side = SIDE_PX / 3;
    let mut canvas = RgbPicture::new(side, SIDE_PX);
    let scale = (side as f64 / shown.width.max(shown.height) as f64).max(f64::MIN_POSITIVE);
    for panel in 0..3 {
        for y in 0..side {
            for x in 0..side {
                let (column, row) = ((x as f64 / scale) as usize, (y as f64 / scale) as usize);
                if column < shown.width && row < shown.height {
                    let value = panels[row * 3 * shown.width + panel * shown.width + column];
                    canvas.put(x as f64, (panel * side + y) as f64, [value; 3]);
                }
            }
        }
    }
    Ok(Some(canvas))
}

impl RgbPicture {
    fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgb: vec![30; 3 * width * height] }
    }

    fn put(&mut self, x: f64, y: f64, colour: [u8; 3]) {
        let (x, y) = (x.round(), y.round());
        if x >= 0.0 && y >= 0.0 && (x as usize) < self.width && (y as usize) < self.height {
            let place = 3 * (y as usize * self.width + x as usize);
            self.rgb[place..place + 3].copy_from_slice(&colour);
        }
    }

    /// Draws a closed line that is two pixels wide.
    fn polygon(&mut self, corners: &[Vector2<f64>], colour: [u8; 3]) {
        for (k, from) in corners.iter().enumerate() {
            let way = corners[(k + 1) % corners.len()] - from;
            // The number of steps is limited for lines that end far outside of the picture.
            let steps = way.amax().ceil().clamp(1.0, 1e4) as usize;
            for step in 0..=steps {
                let at = from + way * (step as f64 / steps as f64);
                for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)] {
                    self.put(at.x + dx, at.y + dy, colour);
                }
            }
        }
    }

    /// A picture of both, with the other one on the right.
    fn beside(&self, other: &Self) -> Self {
        let mut both = Self::new(self.width + other.width, self.height.max(other.height));
        let width = both.width;
        for (from, left) in [(self, 0), (other, self.width)] {
            for (y, row) in from.rgb.chunks_exact(3 * from.width).enumerate() {
                let place = 3 * (y * width + left);
                both.rgb[place..place + row.len()].copy_from_slice(row);
            }
        }
        both
    }

    fn save(&self, path: &Path) -> anyhow::Result<()> {
        let file = BufWriter::new(File::create(path)?);
        let mut encoder = png::Encoder::new(file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.rgb)?;
        Ok(writer.finish()?)
    }
}
