//! An HTML page about a run, with the paper's figures and its table. The file needs no other files.

mod chart;
mod flight_path;
mod page;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::Context;
use flockeye_tables::{PoseRow, TruthRow};
use nalgebra::Vector3;

use crate::evaluation::{Evaluation, measurement, published};
use chart::{Axis, ChartSeries, Mark};

/// Approximate largest number of points of a line or a series of dots in a figure.
const MOST_POINTS: usize = 2_000;

/// Writes `index.html` into a folder, which is created if necessary, and returns its path. `source`
/// describes the compared files.
pub(crate) fn write(
    folder: &Path,
    source: &str,
    evaluation: &Evaluation,
    poses: &[PoseRow],
    truth: &[TruthRow],
) -> anyhow::Result<PathBuf> {
    let bodies: BTreeSet<&str> = truth.iter().map(|row| row.body.as_str()).collect();
    let figures: Vec<_> = bodies
        .into_iter()
        .map(|body| (body, figures(&BodyHistory::of(body, poses, truth))))
        .collect();
    let file = folder.join("index.html");
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    std::fs::write(&file, page::page(source, evaluation, &figures))
        .with_context(|| format!("cannot write {}", file.display()))?;
    Ok(file)
}

/// The truth and the poses of one body, frame by frame.
struct BodyHistory<'a> {
    body: &'a str,
    truth: Vec<&'a TruthRow>,
    /// Measured poses, each with the truth if it is known.
    measured: Vec<(&'a PoseRow, Option<&'a TruthRow>)>,
    coasted: Vec<&'a PoseRow>,
}

impl<'a> BodyHistory<'a> {
    fn of(body: &'a str, poses: &'a [PoseRow], truth: &'a [TruthRow]) -> Self {
        let mut truth: Vec<_> = truth.iter().filter(|row| row.body == body).collect();
        truth.sort_by_key(|row| row.frame);
        let by_frame: BTreeMap<u64, &TruthRow> =
            truth.iter().map(|row| (row.frame, *row)).collect();
        let mut poses: Vec<_> = poses.iter().filter(|pose| pose.target == body).collect();
        poses.sort_by_key(|pose| pose.frame);
        let (measured, coasted): (Vec<_>, Vec<_>) =
            poses.into_iter().partition(|pose| pose.is_measured());
        let measured =
            measured.into_iter().map(|pose| (pose, by_frame.get(&pose.frame).copied())).collect();
        Self { body, truth, measured, coasted }
    }

    /// A number of each row over time. The truth is a line; measured and predicted poses are dots.
    fn over_time(&self, number: impl Fn(&Vector3<f64>) -> f64) -> Vec<ChartSeries> {
        let truth = thinned(&self.truth, |row| row.frame, |row| (row.t_s, number(&row.position())));
        let point = |pose: &PoseRow| (pose.stamp_s, number(&pose.position));
        let coasted: Vec<_> = self.coasted.iter().map(|pose| point(pose)).collect();
        let measured: Vec<_> = self.measured.iter().map(|(pose, _)| point(pose)).collect();
        vec![
            ChartSeries { name: "truth", class: "truth", mark: Mark::Line, pieces: truth },
            dots("predicted only", "coast", &coasted),
            dots("measured", "pose", &measured),
        ]
    }
}

/// A dot for each point.
fn dots(name: &'static str, class: &'static str, points: &[(f64, f64)]) -> ChartSeries {
    let pieces = if points.is_empty() { Vec::new() } else { vec![every(points)] };
    ChartSeries { name, class, mark: Mark::Dots, pieces }
}

/// The drawings of a body, with their captions.
fn figures(history: &BodyHistory<'_>) -> Vec<(String, String)> {
    let time = |series: &[ChartSeries]| Axis::even(numbers(series, |point| point.0), 0.1);
    let over_time = |what: &str, height: f64, number: fn(&Vector3<f64>) -> f64| {
        let series = history.over_time(number);
        let heights = Axis::even(numbers(&series, |point| point.1), 0.1);
        chart::draw(
            &format!("{what} of {} over time", history.body),
            (time(&series), "time, s"),
            (heights, &format!("{what}, m")),
            height,
            &series,
        )
    };
    let axes = [("x", 0), ("y", 1), ("z", 2)].map(|(name, index)| {
        let number: fn(&Vector3<f64>) -> f64 = match index {
            0 => |p| p.x,
            1 => |p| p.y,
            _ => |p| p.z,
        };
        over_time(name, 230.0, number)
    });
    let true_path = thinned(&history.truth, |row| row.frame, |row| row.position());
    let measured_path =
        thinned(&history.measured, |(pose, _)| pose.frame, |(pose, _)| pose.position);
    vec![
        (
            over_time("distance", 340.0, Vector3::norm),
            "Distance against the truth over time (the paper: motion capture against visual \
             distance measurements)."
                .to_owned(),
        ),
        (
            axes.concat(),
            "Position along each axis of the observer: x forward, y left, z up.".to_owned(),
        ),
        (
            flight_path::draw(history.body, &true_path, &measured_path),
            "Flight path relative to the observer, who is where the axes meet (the paper: 3D flight \
             path relative to the observing drone)."
                .to_owned(),
        ),
        (
            error_against_distance(history),
            "Position error of measured frames against the true distance.".to_owned(),
        ),
    ]
}

fn error_against_distance(history: &BodyHistory<'_>) -> String {
    let mut of_frames = Vec::new();
    let mut of_tracks = Vec::new();
    for (pose, truth) in &history.measured {
        let Some(truth) = truth else { continue };
        of_tracks.push((truth.dist_m, published(pose, truth).position_m() * 1e3));
        of_frames
            .extend(measurement(pose, truth).map(|error| (truth.dist_m, error.position_m() * 1e3)));
    }
    let series = [
        dots("the frame's own measurement", "coast", &of_frames),
        dots("published pose", "pose", &of_tracks),
    ];
    chart::draw(
        &format!("Position error of {} against distance", history.body),
        (Axis::even(numbers(&series, |point| point.0), 0.2), "true distance, m"),
        (Axis::decades(numbers(&series, |point| point.1)), "position error, mm"),
        340.0,
        &series,
    )
}

fn numbers(
    series: &[ChartSeries],
    number: fn(&(f64, f64)) -> f64,
) -> impl Iterator<Item = f64> + use<'_> {
    series.iter().flat_map(|series| &series.pieces).flatten().map(number)
}

/// Every n-th point, so that about [`MOST_POINTS`] are left.
fn every<T: Copy>(points: &[T]) -> Vec<T> {
    points.iter().step_by(points.len() / MOST_POINTS + 1).copied().collect()
}

/// Points of the rows, in pieces of consecutive frames. Long lists are thinned.
fn thinned<R, T>(rows: &[R], frame: impl Fn(&R) -> u64, point: impl Fn(&R) -> T) -> Vec<Vec<T>> {
    let step = rows.len() / MOST_POINTS + 1;
    rows.chunk_by(|one, next| frame(one) + 1 == frame(next))
        .map(|piece| piece.iter().step_by(step).map(&point).collect())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::{pose_at, truth_at};
    use flockeye_contract::TrackState;

    #[test]
    fn the_page_has_the_figures_and_fetches_nothing() {
        let at = |frame: u64| {
            let angle = frame as f64 / 10.0;
            Vector3::new(angle.cos(), angle.sin(), 0.1 * angle)
        };
        let truth: Vec<_> = (0..60).map(|frame| truth_at(frame, at(frame))).collect();
        let mut poses: Vec<_> = (5..50)
            .map(|frame| pose_at(frame, at(frame) * 1.003, TrackState::Confirmed))
            .chain([pose_at(50, at(50), TrackState::Coasting)])
            .collect();
        poses[3].target = "<b>ravo".into();
        let evaluation = Evaluation::of(&poses, &truth);
        let folder = std::env::temp_dir().join(format!("flockeye-{}-report", std::process::id()));
        let file = write(&folder.join("deep"), "p & t", &evaluation, &poses, &truth)
            .expect("it can be written");
        let page = std::fs::read_to_string(&file).expect("it is there");
        std::fs::remove_dir_all(&folder).expect("it can be removed");
        assert_eq!(page.matches("<svg").count(), 1 + 3 + 3 + 1);
        assert_eq!(page.matches("<svg").count(), page.matches("</svg>").count());
        // Each measured frame has a dot in distance, x, y and z, and two dots in the error. The
        // prediction has one in each of the first four. The other dots are the keys.
        let dots = page.matches("<circle").count();
        assert_eq!(dots, 4 * (44 + 1 + 2) + 2 * 44 + 2);
        assert!(!page.contains("http") && !page.contains("src=") && !page.contains("@import"));
        assert!(page.contains("p &amp; t") && page.contains("&lt;b&gt;ravo is not there"));
        assert!(page.contains("prefers-color-scheme: dark"));
    }

    #[test]
    fn long_flights_are_thinned() {
        let rows: Vec<u64> = (0..9_000).collect();
        let pieces = thinned(&rows, |frame| *frame, |frame| *frame);
        assert!((1_000..=MOST_POINTS).contains(&pieces[0].len()), "{}", pieces[0].len());
        let few = [(1, 'a'), (2, 'b'), (5, 'c')];
        assert_eq!(thinned(&few, |row| row.0, |row| row.1), [vec!['a', 'b'], vec!['c']]);
        assert_eq!(every(&[1, 2, 3]), [1, 2, 3]);
    }
}
