//! Comparison of our detector with OpenCV's on the same photographs.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use flockeye_cli::text_table::TextTable;
use flockeye_config::DetectionEngine;
use flockeye_contract::{Search, ViewKind};
use flockeye_detection::{DetectorParameters, Engine, MarkerInView, windows};
use flockeye_geometry::Ray;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_tables::writer::{TableWriter, WrittenRow};
use nalgebra::{Vector2, Vector3};
use opencv::imgcodecs::{IMREAD_GRAYSCALE, imread};
use opencv::prelude::*;
use serde::Serialize;

/// Files with these endings are photographs.
const ENDINGS: [&str; 3] = ["jpg", "jpeg", "png"];
/// Assumed horizontal field of a photograph, radians, typical of cameras. Masks and the test for
/// squares depend on it.
const FIELD_RAD: f64 = 1.1;
/// Least side of a marker in each row of the table, pixels.
const SIZES_PX: [f64; 5] = [0.0, 14.0, 20.0, 30.0, 60.0];
/// Largest distance between the centres of the same marker, as a share of its side.
const SAME_PLACE_SHARE: f64 = 0.5;

/// A marker in a photograph.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct PhotographMarker {
    photograph: String,
    id: u32,
    /// Centre of the marker, pixels.
    at: [f64; 2],
    /// Side of a square with the marker's area, pixels.
    side_px: f64,
}

/// A corner of a marker in a photograph.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct CornerRow {
    /// own or opencv.
    engine: &'static str,
    photograph: String,
    id: u32,
    /// In ArUco's order: clockwise from the printed top left.
    corner: usize,
    x: f64,
    y: f64,
    /// Stated standard deviation along either axis, pixels.
    sigma_px: f64,
}

impl WrittenRow for CornerRow {
    fn names() -> Vec<&'static str> {
        vec!["engine", "photograph", "id", "corner", "x", "y", "sigma_px"]
    }
}

/// Counts of markers of one size.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
struct DetectorCounts {
    both: usize,
    ours_alone: usize,
    opencv_alone: usize,
}

/// Markers that both detectors found.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct PhotographComparison {
    photographs: usize,
    /// Counts by the index in [`SIZES_PX`].
    by_size: BTreeMap<usize, DetectorCounts>,
    ours_alone: Vec<PhotographMarker>,
    opencv_alone: Vec<PhotographMarker>,
    /// Files that could not be read.
    unreadable: Vec<PathBuf>,
}

/// Searches each photograph of a folder with both detectors, and writes all corners to a file if
/// one is given.
///
/// # Errors
/// The folder or its photographs are missing, the dictionary is unknown, or a file cannot be
/// written. An unreadable photograph is only reported.
pub(super) fn compare(
    folder: &Path,
    dictionary: &str,
    corners: Option<&Path>,
) -> anyhow::Result<PhotographComparison> {
    let mut corners = corners.map(TableWriter::create).transpose()?;
    let mut ours = Engine::new(DetectionEngine::Own, dictionary, DetectorParameters::default())?;
    let mut theirs =
        Engine::new(DetectionEngine::OpenCv, dictionary, DetectorParameters::default())?;
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full)
        .context("the curve of photographs")?;
    let mut comparison = PhotographComparison::default();
    let files = photographs(folder)?;
    ensure!(
        !files.is_empty(),
        "{} holds no photograph. Cure: put .jpg, .jpeg or .png files in it",
        folder.display()
    );
    for file in files {
        let Some((pixels, width, height)) = read(&file) else {
            comparison.unreadable.push(file);
            continue;
        };
        let image = LumaImage::new(&pixels, width, height, width)?;
        let side = width.max(height) as u32;
        let view = View::looking_at(&Ray::new_normalize(Vector3::x()), FIELD_RAD, side);
        let thresholds = || windows::thresholds(ViewKind::Partition, Search::AllWindows, 1.0);
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let mut search = |kind, engine: &mut Engine| -> anyhow::Result<Vec<PhotographMarker>> {
            let found = engine.detect(&image, &view, &light, 1.0, thresholds())?;
            if let Some(corners) = &mut corners {
                add_corners(corners, kind, &name, &view, &found)?;
            }
            Ok(found.iter().map(|found| marker(&name, found)).collect())
        };
        comparison.add(search("own", &mut ours)?, search("opencv", &mut theirs)?);
    }
    corners.map_or(Ok(()), TableWriter::finish)?;
    Ok(comparison)
}

fn photographs(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries =
        std::fs::read_dir(folder).with_context(|| format!("the folder {}", folder.display()))?;
    let mut files: Vec<PathBuf> =
        entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<_>>()?;
    files.retain(|file| {
        let ending = file.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        ENDINGS.iter().any(|known| known.eq_ignore_ascii_case(ending))
    });
    files.sort();
    Ok(files)
}

/// The luma of a photograph, its width and its height.
fn read(file: &Path) -> Option<(Vec<u8>, usize, usize)> {
    let mat = imread(file.to_str()?, IMREAD_GRAYSCALE).ok()?;
    let pixels = mat.data_bytes().ok()?.to_vec();
    (!pixels.is_empty()).then_some((pixels, mat.cols() as usize, mat.rows() as usize))
}

fn add_corners(
    corners: &mut TableWriter<CornerRow>,
    engine: &'static str,
    photograph: &str,
    view: &View,
    found: &[MarkerInView],
) -> anyhow::Result<()> {
    for marker in found {
        for (corner, ViewPixel(at)) in marker.corners_in_view.into_iter().enumerate() {
            let ray = |at: Vector2<f64>| view.ray(ViewPixel(at));
            let steps_rad = [Vector2::x(), Vector2::y()].map(|step| ray(at).angle(&ray(at + step)));
            let pixel_rad = steps_rad[0].hypot(steps_rad[1]) / 2f64.sqrt();
            corners.add(&CornerRow {
                engine,
                photograph: photograph.to_owned(),
                id: marker.id,
                corner,
                x: at.x,
                y: at.y,
                sigma_px: marker.deviations_rad[corner] / pixel_rad,
            })?;
        }
    }
    Ok(())
}

fn marker(photograph: &str, found: &MarkerInView) -> PhotographMarker {
    let [a, b, c, d] = found.corners_in_view.map(|ViewPixel(corner)| corner);
    let area = ((c - a).perp(&(d - b)) / 2.0).abs();
    let centre = (a + b + c + d) / 4.0;
    PhotographMarker {
        photograph: photograph.to_owned(),
        id: found.id,
        at: [centre.x, centre.y],
        side_px: area.sqrt(),
    }
}

impl PhotographComparison {
    /// Adds the markers that both detectors found in one photograph.
    fn add(&mut self, ours: Vec<PhotographMarker>, mut theirs: Vec<PhotographMarker>) {
        self.photographs += 1;
        for marker in ours {
            let counts = self.by_size.entry(size_of(&marker)).or_default();
            match theirs.iter().position(|other| is_same(other, &marker)) {
                Some(index) => {
                    counts.both += 1;
                    theirs.swap_remove(index);
                }
                None => {
                    counts.ours_alone += 1;
                    self.ours_alone.push(marker);
                }
            }
        }
        for marker in theirs {
            self.by_size.entry(size_of(&marker)).or_default().opencv_alone += 1;
            self.opencv_alone.push(marker);
        }
    }
}

fn size_of(marker: &PhotographMarker) -> usize {
    SIZES_PX.iter().rposition(|least| marker.side_px >= *least).unwrap_or(0)
}

fn is_same(one: &PhotographMarker, other: &PhotographMarker) -> bool {
    let apart = (one.at[0] - other.at[0]).hypot(one.at[1] - other.at[1]);
    one.id == other.id && apart < SAME_PLACE_SHARE * one.side_px.max(other.side_px)
}

impl fmt::Display for PhotographComparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let titles = ["side px", "both", "ours alone", "OpenCV alone", "ours, of all", "OpenCV"];
        let mut table = TextTable::new(1, &titles);
        let mut row = |name: String, counts: DetectorCounts| {
            let DetectorCounts { both, ours_alone, opencv_alone } = counts;
            let all = (both + ours_alone + opencv_alone).max(1) as f64;
            let share = |part: usize| format!("{:.1} %", 100.0 * part as f64 / all);
            table.row([
                name,
                both.to_string(),
                ours_alone.to_string(),
                opencv_alone.to_string(),
                share(both + ours_alone),
                share(both + opencv_alone),
            ]);
        };
        let mut all = DetectorCounts::default();
        for (&size, &counts) in &self.by_size {
            let name = match SIZES_PX.get(size + 1) {
                Some(next) => format!("{:.0} to {next:.0}", SIZES_PX[size]),
                None => format!("from {:.0}", SIZES_PX[size]),
            };
            row(name, counts);
            all.both += counts.both;
            all.ours_alone += counts.ours_alone;
            all.opencv_alone += counts.opencv_alone;
        }
        row("all".to_owned(), all);
        writeln!(f, "{} photographs", self.photographs)?;
        write!(f, "{}", table.text())?;
        for (whose, alone) in [("ours", &self.ours_alone), ("OpenCV", &self.opencv_alone)] {
            for PhotographMarker { photograph, id, at: [x, y], side_px } in alone {
                write!(
                    f,
                    "\n{whose} alone: {photograph}, id {id} at ({x:.0}, {y:.0}), {side_px:.0} px"
                )?;
            }
        }
        self.unreadable.iter().try_for_each(|file| write!(f, "\nunreadable: {}", file.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn marker(id: u32, x: f64, side_px: f64) -> PhotographMarker {
        PhotographMarker { photograph: "a.jpg".into(), id, at: [x, 50.0], side_px }
    }

    #[test]
    fn a_marker_is_the_same_if_id_and_place_are() {
        let mut comparison = PhotographComparison::default();
        let ours = vec![marker(3, 100.0, 20.0), marker(3, 200.0, 20.0), marker(7, 300.0, 80.0)];
        let theirs = vec![marker(3, 205.0, 19.0), marker(8, 300.0, 80.0)];
        comparison.add(ours, theirs);
        let counts = |size| comparison.by_size.get(&size).copied().unwrap_or_default();
        assert_eq!(counts(2), DetectorCounts { both: 1, ours_alone: 1, opencv_alone: 0 });
        assert_eq!(counts(4), DetectorCounts { both: 0, ours_alone: 1, opencv_alone: 1 });
        let text = comparison.to_string();
        assert!(text.contains("OpenCV alone: a.jpg, id 8 at (300, 50), 80 px"), "{text}");
        assert!(text.contains("from 60"), "{text}");
    }
}
