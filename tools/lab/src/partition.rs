//! `flockeye partition`: partitions of the sphere as a table, as JSON and as drawings.
//!
//! `common/geometry/data/partitions.json` is what `flockeye partition --compute --json` prints.

mod figure;
mod picture;

use std::fmt;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use flockeye_geometry::partition::{
    Criterion, FEWEST, MOST, Method, Partition, PartitionError, Terms, Weights,
};
use serde::Serialize;

use crate::cli::{self, Counts, MethodArgument};
use crate::screen::Screen;

/// What a partition costs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The paper's N.
    pub count: usize,
    /// The paper's theta, the circles' diameter, degrees.
    pub theta_deg: f64,
    /// The paper's p, pixels of all circles, as it is meant: N theta^2/360^2 h w.
    pub pixels: f64,
    /// The paper's d, the stretch at the circles' rim.
    pub stretch: f64,
    /// The criterion's value.
    pub cost: f64,
    /// Area of all circles over that of the sphere.
    pub overlap: f64,
    /// The square views with the margin; none where a flat image has no such field.
    pub views: Option<Squares>,
    /// Middles of the circles and views, unit vectors in the camera frame.
    pub directions: Vec<[f64; 3]>,
    /// Rolls of the views, degrees from upright.
    pub rolls_deg: Vec<f64>,
}

/// What square views cost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Squares {
    /// Field along a side, degrees.
    pub field_deg: f64,
    /// Pixels along a side.
    pub size_px: u32,
    /// Pixels of all views.
    pub pixels: f64,
    /// The same of the squares round the circles, which are upright.
    pub circumscribed_pixels: Option<f64>,
    /// Area of all views over that of the sphere.
    pub overlap: f64,
}

/// All of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table {
    /// covering or paper.
    pub method: &'static str,
    /// The random start.
    pub seed: u64,
    /// What is this wide lies wholly in one view, degrees.
    pub margin_deg: f64,
    /// Size of the sphere image, pixels.
    pub image_px: [u32; 2],
    /// alpha1, alpha2, alpha3.
    pub weights: [f64; 3],
    /// The number of views of least cost among the stored coverings.
    pub choice: usize,
    /// A row for each number of views.
    pub partitions: Vec<Row>,
}

impl Row {
    fn of(
        partition: &Partition,
        criterion: &Criterion,
        arguments: &cli::Partition,
    ) -> Result<Self, PartitionError> {
        let terms = partition.terms();
        let count = terms.count;
        let radius_rad = partition.covering_diameter_rad() / 2.0;
        let image = f64::from(arguments.width) * f64::from(arguments.width / 2);
        let views = match Squares::of(partition, arguments) {
            Ok(squares) => Some(squares),
            Err(PartitionError::Field { .. }) => None,
            Err(error) => return Err(error),
        };
        Ok(Self {
            count: partition.len(),
            theta_deg: rounded(2.0 * radius_rad.to_degrees(), 6),
            pixels: rounded(terms.pixels * image, 0),
            stretch: rounded(terms.stretch, 6),
            cost: rounded(criterion.cost(&terms), 6),
            overlap: rounded(count * (1.0 - radius_rad.cos()) / 2.0, 6),
            views,
            directions: partition.directions().iter().map(|d| [d.x, d.y, d.z]).collect(),
            rolls_deg: partition.rolls_deg().to_vec(),
        })
    }
}

impl Squares {
    fn of(partition: &Partition, arguments: &cli::Partition) -> Result<Self, PartitionError> {
        let margin_rad = arguments.margin.to_radians();
        let field_rad = partition.field_rad(margin_rad)?;
        let views = partition.views(margin_rad, pixels_per_radian(arguments.width))?;
        let size_px = views.iter().map(|view| view.size_px).max().unwrap_or(0);
        let count = partition.len() as f64;
        let all = |size_px: f64| count * size_px * size_px;
        let half_rad = (partition.covering_diameter_rad() + margin_rad) / 2.0;
        let circumscribed = (half_rad.to_degrees() < 85.0)
            .then(|| (2.0 * pixels_per_radian(arguments.width) * half_rad.tan()).ceil() + 1.0);
        Ok(Self {
            field_deg: rounded(field_rad.to_degrees(), 3),
            size_px,
            pixels: all(f64::from(size_px)),
            circumscribed_pixels: circumscribed.map(all),
            // A square pyramid's solid angle is 4 asin(sin^2 of its half-field).
            overlap: rounded(
                count * (field_rad / 2.0).sin().powi(2).asin() / std::f64::consts::PI,
                4,
            ),
        })
    }
}

/// To some decimals: the last digits differ from machine to machine.
fn rounded(value: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (value * scale).round() / scale
}

fn pixels_per_radian(width: u32) -> f64 {
    f64::from(width) / std::f64::consts::TAU
}

impl From<MethodArgument> for Method {
    fn from(method: MethodArgument) -> Self {
        match method {
            MethodArgument::Covering => Self::Covering,
            MethodArgument::Paper => Self::Paper,
        }
    }
}

/// `flockeye partition`.
///
/// # Errors
/// A margin that is none; a drawing that cannot be written.
pub fn run(arguments: &cli::Partition) -> anyhow::Result<()> {
    let partitions = arguments.counts.0.iter().map(|&count| find(arguments, count));
    let partitions = partitions.collect::<Result<Vec<_>, _>>()?;
    let table = Table::of(arguments, &partitions)?;
    if let Some(path) = &arguments.svg {
        write(path, &figure::draw(arguments)?)?;
    }
    Screen::new().line(&if arguments.json { table.to_json()? } else { table.to_string() });
    if let Some(path) = &arguments.picture {
        // The first that has views with this margin; if none has, the first one's reason counts.
        let mut pictures =
            partitions.iter().map(|p| picture::draw(p, arguments.margin.to_radians()));
        let first = pictures.next().context("there is no partition to draw")?;
        let drawn = first.or_else(|error| pictures.find_map(Result::ok).ok_or(error))?;
        write(path, &drawn)?;
    }
    Ok(())
}

/// The partition of `count` views that the arguments ask for; says how long it took where it was
/// looked for.
fn find(arguments: &cli::Partition, count: usize) -> Result<Partition, PartitionError> {
    let method = arguments.method.into();
    if !arguments.compute {
        return Partition::of(method, count, arguments.seed);
    }
    let start = Instant::now();
    let partition = Partition::compute(method, count, arguments.seed)?;
    tracing::info!(count, seconds = start.elapsed().as_secs_f64(), "found a partition");
    Ok(partition)
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

impl Table {
    fn of(arguments: &cli::Partition, partitions: &[Partition]) -> Result<Self, PartitionError> {
        let weights = arguments.weights.unwrap_or_default();
        let criterion = Criterion::new(weights);
        let rows = partitions.iter().map(|partition| Row::of(partition, &criterion, arguments));
        Ok(Self {
            method: match arguments.method {
                MethodArgument::Covering => "covering",
                MethodArgument::Paper => "paper",
            },
            seed: arguments.seed,
            margin_deg: arguments.margin,
            image_px: [arguments.width, arguments.width / 2],
            weights: weights.values(),
            choice: criterion.choice(),
            partitions: rows.collect::<Result<_, _>>()?,
        })
    }

    /// JSON with a line for each partition.
    fn to_json(&self) -> serde_json::Result<String> {
        let head = Self { partitions: Vec::new(), ..self.clone() };
        let head = serde_json::to_string(&head)?;
        let rows = self.partitions.iter().map(serde_json::to_string);
        let rows = rows.collect::<Result<Vec<_>, _>>()?.join(",\n");
        Ok(format!("{}\n{rows}\n]}}", head.trim_end_matches("]}")))
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:>4}  {:-^46}  {:-^43}", "", " circles ", " square views ")?;
        writeln!(
            f,
            "{:>4}  {:>9} {:>8} {:>8} {:>8} {:>8}   {:>8} {:>7} {:>8} {:>8} {:>8}",
            "N",
            "theta °",
            "Mpixels",
            "stretch",
            "overlap",
            "cost",
            "field °",
            "pixels",
            "Mpixels",
            "saved",
            "overlap"
        )?;
        for row in &self.partitions {
            write!(
                f,
                "{:>4}  {:>9.4} {:>8.2} {:>8.3} {:>8.3} {:>8.4}   ",
                row.count,
                row.theta_deg,
                row.pixels / 1e6,
                row.stretch,
                row.overlap,
                row.cost
            )?;
            match &row.views {
                Some(views) => {
                    let saved =
                        views.circumscribed_pixels.map_or("-".to_owned(), |circumscribed| {
                            format!("{:.1} %", 100.0 * (1.0 - views.pixels / circumscribed))
                        });
                    writeln!(
                        f,
                        "{:>8.3} {:>7} {:>8.2} {saved:>8} {:>8.3}",
                        views.field_deg,
                        views.size_px,
                        views.pixels / 1e6,
                        views.overlap
                    )?;
                }
                None => writeln!(f, "too wide for flat images with this margin")?,
            }
        }
        let [a1, a2, a3] = self.weights;
        write!(
            f,
            "method {}, seed {}, margin {}°, image {}x{}; weights {a1}, {a2}, {a3} choose {} views",
            self.method,
            self.seed,
            self.margin_deg,
            self.image_px[0],
            self.image_px[1],
            self.choice
        )
    }
}

/// Reads numbers of views: `12`, `6,12,24`, `4..32`.
///
/// # Errors
/// What is wrong with it.
pub fn counts(text: &str) -> Result<Counts, String> {
    let number = |text: &str| {
        let number = text.trim().parse::<usize>();
        let number =
            number.map_err(|_| format!("'{text}' is no number: write 12, 6,12,24 or 4..32"))?;
        let is_allowed = (FEWEST..=MOST).contains(&number);
        is_allowed.then_some(number).ok_or(PartitionError::Count { count: number }.to_string())
    };
    let mut counts = Vec::new();
    for part in text.split(',') {
        match part.split_once("..") {
            Some((first, last)) => {
                let (first, last) = (number(first)?, number(last)?);
                if first > last {
                    return Err(format!("{first}..{last} is empty: write {last}..{first}"));
                }
                counts.extend(first..=last);
            }
            None => counts.push(number(part)?),
        }
    }
    Ok(Counts(counts))
}

/// Reads weights: `0.2,0.02,0.78`.
///
/// # Errors
/// What is wrong with them.
pub fn weights(text: &str) -> Result<Weights, String> {
    let numbers = text.split(',').map(|part| part.trim().parse::<f64>());
    let numbers = numbers.collect::<Result<Vec<_>, _>>().ok();
    let numbers = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    let numbers =
        numbers.ok_or_else(|| format!("'{text}' must be three numbers, as in 0.2,0.02,0.78"))?;
    Weights::new(numbers).map_err(|error| error.to_string())
}

/// The paper's p of N circles, sphere images.
fn images(count: usize, theta_deg: f64) -> f64 {
    Terms::new(count, theta_deg.to_radians()).pixels
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn counts_are_numbers_lists_and_ranges() {
        assert_eq!(counts("12").unwrap().0, [12]);
        assert_eq!(counts("6, 12,24").unwrap().0, [6, 12, 24]);
        assert_eq!(counts("4..6,128").unwrap().0, [4, 5, 6, 128]);
        for (text, wanted) in [
            ("3..8", "4 to 128 views, not 3"),
            ("4..129", "not 129"),
            ("8..4", "write 4..8"),
            ("", "write 12"),
            ("4..", "write 12"),
            ("-5", "write 12"),
            ("4..x", "'x' is no number"),
        ] {
            let error = counts(text).unwrap_err();
            assert!(error.contains(wanted), "{text:?}: {error}");
        }
    }

    #[test]
    fn weights_are_three_shares() {
        assert_eq!(weights("0.2, 0.02, 0.78").unwrap(), Weights::default());
        assert!(weights("0.2,0.8").unwrap_err().contains("three numbers"));
        assert!(weights("a,b,c").unwrap_err().contains("three numbers"));
        assert!(weights("0.5,0.5,0.5").unwrap_err().contains("sum to 1"));
    }
}
