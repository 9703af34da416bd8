//! Partitions as a table and as JSON.

use std::fmt;

use flockeye_cli::text_table::TextTable;
use flockeye_geometry::partition::{Criterion, Method, Partition, PartitionError};
use serde::Serialize;

use super::arguments::PartitionArguments;

/// Properties and cost of a partition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PartitionRow {
    /// The paper's N.
    pub count: usize,
    /// The paper's theta, the circles' diameter, degrees.
    pub theta_deg: f64,
    /// The paper's p, pixels of all circles: N theta^2/360^2 h w.
    pub pixels: f64,
    /// The paper's d, the stretch at the circles' rim.
    pub stretch: f64,
    /// Value of the criterion.
    pub cost: f64,
    /// Area of all circles divided by the area of the sphere.
    pub overlap: f64,
    /// The square views with the margin; none if the field is too wide for a flat image.
    pub views: Option<SquareViews>,
    /// Centres of the circles and views, unit vectors in the camera frame.
    pub directions: Vec<[f64; 3]>,
    /// Rolls of the views, degrees from upright.
    pub rolls_deg: Vec<f64>,
}

/// Properties of square views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SquareViews {
    /// Field along a side, degrees.
    pub field_deg: f64,
    /// Pixels along a side.
    pub size_px: u32,
    /// Pixels of all views.
    pub pixels: f64,
    /// Pixels of the upright squares around the circles.
    pub circumscribed_pixels: Option<f64>,
    /// Area of all views divided by the area of the sphere.
    pub overlap: f64,
}

/// The whole table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PartitionTable {
    /// covering or paper.
    pub method: &'static str,
    /// Seed of the random start.
    pub seed: u64,
    /// Largest width of an object that is always completely in one view, degrees.
    pub margin_deg: f64,
    /// Size of the sphere image, pixels.
    pub image_px: [u32; 2],
    /// alpha1, alpha2, alpha3.
    pub weights: [f64; 3],
    /// The number of views with the least cost among the stored coverings.
    pub choice: usize,
    /// A row for each number of views.
    pub partitions: Vec<PartitionRow>,
}

impl PartitionRow {
    fn of(
        partition: &Partition,
        criterion: &Criterion,
        arguments: &PartitionArguments,
    ) -> Result<Self, PartitionError> {
        let terms = partition.terms();
        let count = terms.count;
        let radius_rad = partition.covering_diameter_rad() / 2.0;
        let image = f64::from(arguments.width) * f64::from(arguments.width / 2);
        let views = match SquareViews::of(partition, arguments) {
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

impl SquareViews {
    fn of(partition: &Partition, arguments: &PartitionArguments) -> Result<Self, PartitionError> {
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

/// Rounds to some decimals, because the last digits differ between machines.
fn rounded(value: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (value * scale).round() / scale
}

fn pixels_per_radian(width: u32) -> f64 {
    f64::from(width) / std::f64::consts::TAU
}

impl PartitionTable {
    /// The table of these partitions.
    pub(crate) fn of(
        arguments: &PartitionArguments,
        partitions: &[Partition],
    ) -> Result<Self, PartitionError> {
        let criterion = arguments.weights.unwrap_or_default();
        let rows =
            partitions.iter().map(|partition| PartitionRow::of(partition, &criterion, arguments));
        Ok(Self {
            method: match arguments.method {
                Method::Covering => "covering",
                Method::Paper => "paper",
            },
            seed: arguments.seed,
            margin_deg: arguments.margin,
            image_px: [arguments.width, arguments.width / 2],
            weights: criterion.weights(),
            choice: criterion.choice(),
            partitions: rows.collect::<Result<_, _>>()?,
        })
    }

    /// JSON with a line for each partition.
    pub(crate) fn to_json(&self) -> serde_json::Result<String> {
        let head = Self { partitions: Vec::new(), ..self.clone() };
        let head = serde_json::to_string(&head)?;
        let rows = self.partitions.iter().map(serde_json::to_string);
        let rows = rows.collect::<Result<Vec<_>, _>>()?.join(",\n");
        Ok(format!("{}\n{rows}\n]}}", head.trim_end_matches("]}")))
    }
}

impl fmt::Display for PartitionTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The first line of each title is the heading of a group of columns.
        let titles = [
            "\nN",
            "circles\ntheta °",
            "\nMpixels",
            "\nstretch",
            "\noverlap",
            "\ncost",
            "square views\nfield °",
            "\npixels",
            "\nMpixels",
            "\nsaved",
            "\noverlap",
        ];
        let mut table = TextTable::new(0, &titles);
        for row in &self.partitions {
            let circles = [
                row.count.to_string(),
                format!("{:.4}", row.theta_deg),
                format!("{:.2}", row.pixels / 1e6),
                format!("{:.3}", row.stretch),
                format!("{:.3}", row.overlap),
                format!("{:.4}", row.cost),
            ];
            let views = row.views.as_ref().map(|views| {
                let saved = views.circumscribed_pixels.map_or("-".to_owned(), |circumscribed| {
                    format!("{:.1} %", 100.0 * (1.0 - views.pixels / circumscribed))
                });
                [
                    format!("{:.3}", views.field_deg),
                    views.size_px.to_string(),
                    format!("{:.2}", views.pixels / 1e6),
                    saved,
                    format!("{:.3}", views.overlap),
                ]
            });
            table.row(circles.into_iter().chain(views.unwrap_or(["-"; 5].map(str::to_owned))));
        }
        writeln!(f, "{}", table.text())?;
        if self.partitions.iter().any(|row| row.views.is_none()) {
            writeln!(f, "-: with this margin the views are too wide for flat images")?;
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
