//! The partition of the sphere: the directions of views that together miss nothing (section III-A
//! of the paper).
//!
//! Two methods find the directions. `paper` spreads points and then grows circles around them.
//! `covering` minimises the circles themselves. In both methods the circles' diameter theta is
//! exact, from the convex hull of the directions. Views are squares, rotated about their axes so
//! that the smallest squares contain every object as wide as the margin. docs/DETECTION.md has the
//! figures.

mod ascent;
mod covering;
mod criterion;
mod hull;
mod orientation;
mod paper;
mod rolls;
mod squares;
mod stored;
#[cfg(test)]
mod tests;

use std::f64::consts::{FRAC_PI_2, PI};
use std::ops::RangeInclusive;
use std::sync::LazyLock;

use nalgebra::{Unit, UnitQuaternion, Vector3};

use crate::Ray;
use crate::view::{View, upright_axes};
pub use criterion::{Criterion, Terms};
use hull::{Triangle, covering_cosine, hull};
use squares::{Square, half_field};

/// The fewest views that cover the sphere: no three pinhole images do.
pub const FEWEST: usize = 4;
/// The most views that a partition may have.
pub const MOST: usize = 128;
/// Numbers of views with a stored covering.
pub const STORED: RangeInclusive<usize> = FEWEST..=32;
/// Seed of the stored partitions.
pub const STORED_SEED: u64 = 1;

/// Largest field of a view, degrees: beyond it a pinhole image stretches its rim more than eight
/// times.
const LARGEST_FIELD_RAD: f64 = 140.0 / 180.0 * PI;
/// Tolerance of a view's half-field over the smallest possible one: 0.0003 degrees.
const TOLERANCE_RAD: f64 = 5e-6;

/// Method by which directions are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// The smallest circles that leave no gap.
    Covering,
    /// The paper's method: spread points, then the smallest circles around them that leave no gap.
    Paper,
}

/// Directions whose circles of one common diameter cover the sphere, and the roll of a square view
/// along each.
#[derive(Debug, Clone, PartialEq)]
pub struct Partition {
    directions: Vec<Ray>,
    rolls_deg: Vec<f64>,
    /// Facets of the directions' hull: the holes between the circles.
    facets: Vec<Triangle>,
}

/// The stored partitions, measured once.
#[expect(clippy::expect_used, reason = "the file is part of the program; a test reads all of it")]
static PARTITIONS: LazyLock<Vec<Partition>> = LazyLock::new(|| {
    let partitions = stored::coverings()
        .map(|(directions, rolls_deg)| Partition::new(directions, rolls_deg).expect("a covering"));
    partitions.collect()
});

/// Reason why there is no partition, or none with such views.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum PartitionError {
    /// Too few or too many views.
    #[error(
        "a partition has {FEWEST} to {MOST} views, not {count}: three flat images never see the \
         whole sphere, and with more than {MOST} a frame is never searched in time"
    )]
    Count { count: usize },
    /// Directions that all lie in a plane or coincide, or rolls whose number differs from that of
    /// the directions.
    #[error("{directions} directions with {rolls} rolls do not go round the sphere")]
    Directions { directions: usize, rolls: usize },
    /// The margin has no width.
    #[error("a margin of {:.1} degrees is none: it must be 0 or more", .margin_rad.to_degrees())]
    Margin { margin_rad: f64 },
    /// The views would be larger than a pinhole image can be.
    #[error(
        "{count} views that hold whatever is {:.1} degrees wide would each span more than {:.0} \
         degrees, and a flat image has no more; {}",
        .margin_rad.to_degrees(), LARGEST_FIELD_RAD.to_degrees(), cure(.largest_margin_rad, .fewest)
    )]
    Field { count: usize, margin_rad: f64, largest_margin_rad: Option<f64>, fewest: Option<usize> },
    /// A weight of the criterion that is not positive.
    #[error("each weight must be above 0, not {weights:?}: use 0.01 for what hardly counts")]
    NegligibleWeight { weights: [f64; 3] },
    /// Weights of the criterion whose sum is not 1.
    #[error(
        "weights must sum to 1, but {weights:?} sum to {:.4}: divided by that they are [{}]",
        .weights.iter().sum::<f64>(), shares(.weights)
    )]
    WeightSum { weights: [f64; 3] },
    /// A resolution that is not usable.
    #[error("{pixels_per_radian} pixels for each radian give no view: 1 to 100000 are allowed")]
    Resolution { pixels_per_radian: f64 },
}

/// The weights as shares of their sum, as text.
fn shares(weights: &[f64; 3]) -> String {
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| format!("{:.4}", weight / sum)).join(", ")
}

/// Advice for a margin that is too large: [`PartitionError::Field`].
fn cure(largest_margin_rad: &Option<f64>, fewest: &Option<usize>) -> String {
    let margin = match largest_margin_rad {
        // Rounded down, so that the stated margin works.
        Some(margin) => {
            let degrees = (margin.to_degrees() * 10.0).floor() / 10.0;
            format!("the largest margin of so many is {degrees:.1} degrees")
        }
        None => "no margin makes so few do".to_owned(),
    };
    match fewest {
        Some(fewest) => format!("{margin}, the fewest views for this margin are {fewest}"),
        None => format!("{margin}, and no number of views does for this margin"),
    }
}

impl Partition {
    /// The 12 vertices of the icosahedron: the best covering of the sphere by 12 circles
    /// (L. Fejes Toth, 1953), of 74.7547 degrees.
    ///
    /// The order begins ahead (+x) and ends behind, so that a search in fixed order looks ahead
    /// first.
    #[expect(clippy::expect_used, reason = "12 is stored; a test looks")]
    pub fn icosahedron() -> Self {
        Self::stored(12).expect("12 is stored")
    }

    /// The stored covering by `count` circles, without computation; `None` where none is stored
    /// (see [`STORED`]).
    pub fn stored(count: usize) -> Option<Self> {
        PARTITIONS.iter().find(|partition| partition.len() == count).cloned()
    }

    /// Whether a partition is stored, so that it needs no computation.
    pub fn is_stored(method: Method, count: usize, seed: u64) -> bool {
        method == Method::Covering && STORED.contains(&count) && seed == STORED_SEED
    }

    /// The partition of a method, a number of views and a seed: stored, or else computed in up to a
    /// few seconds. The result is the same on every machine.
    ///
    /// # Errors
    /// A number of views that is too small or too large.
    pub fn of(method: Method, count: usize, seed: u64) -> Result<Self, PartitionError> {
        let stored = Self::stored(count).filter(|_| Self::is_stored(method, count, seed));
        stored.map_or_else(|| Self::compute(method, count, seed), Ok)
    }

    /// Finds the partition anew, without stored solutions.
    ///
    /// # Errors
    /// A number of views that is too small or too large.
    pub fn compute(method: Method, count: usize, seed: u64) -> Result<Self, PartitionError> {
        if !(FEWEST..=MOST).contains(&count) {
            return Err(PartitionError::Count { count });
        }
        let directions = match (method, count) {
            // Proved to be the best, and turned so that two views look ahead, one above the other.
            (Method::Covering, 12) => icosahedron_vertices(),
            (Method::Covering, _) => orientation::canonical(&covering::directions(count, seed)),
            (Method::Paper, _) => orientation::canonical(&paper::directions(count, seed)),
        };
        let directions: Vec<_> =
            directions.into_iter().map(|direction| direction.map(rounded)).collect();
        let none = PartitionError::Directions { directions: directions.len(), rolls: 0 };
        let facets = hull(&directions).ok_or(none)?;
        let is_stored = Self::is_stored(method, count, seed);
        let rolls_deg = rolls::degrees(&directions, &facets, seed, is_stored);
        Self::new(directions.into_iter().map(Unit::new_unchecked).collect(), rolls_deg)
    }

    /// Finds the holes between the directions.
    fn new(directions: Vec<Ray>, rolls_deg: Vec<f64>) -> Result<Self, PartitionError> {
        let (count, rolls) = (directions.len(), rolls_deg.len());
        let facets = hull(&vectors(&directions)).filter(|_| count == rolls);
        let facets = facets.ok_or(PartitionError::Directions { directions: count, rolls })?;
        Ok(Self { directions, rolls_deg, facets })
    }

    /// The middles of the circles, unit vectors in the camera frame. Their order is the numbering
    /// of the partitions.
    pub fn directions(&self) -> &[Ray] {
        &self.directions
    }

    /// Rolls of the square views, degrees clockwise from upright, from 0 to 90.
    pub fn rolls_deg(&self) -> &[f64] {
        &self.rolls_deg
    }

    /// Number of partitions: the paper's N.
    #[expect(clippy::len_without_is_empty, reason = "a partition of the sphere is never empty")]
    pub fn len(&self) -> usize {
        self.directions.len()
    }

    /// The smallest diameter with which circles around the directions leave no gap, radians: the
    /// paper's theta.
    pub fn covering_diameter_rad(&self) -> f64 {
        2.0 * covering_cosine(&self.facets).acos()
    }

    /// Terms of the paper's criterion.
    pub fn terms(&self) -> Terms {
        Terms::new(self.len(), self.covering_diameter_rad())
    }

    /// Field of square views such that any object `margin_rad` wide lies wholly in one of them,
    /// radians.
    ///
    /// At most theta + `margin_rad`, the square around the circle. It is less, because rotated
    /// squares reach with their corners into the holes between circles. Branch and bound proves it.
    /// It is at most 0.001 degrees too large (0.02 where whole sides of squares meet).
    ///
    /// # Errors
    /// A margin for which there is no pinhole image.
    pub fn field_rad(&self, margin_rad: f64) -> Result<f64, PartitionError> {
        if margin_rad.is_nan() || margin_rad < 0.0 {
            return Err(PartitionError::Margin { margin_rad });
        }
        let fits = |field: &f64| *field < LARGEST_FIELD_RAD;
        self.squares_field_rad(margin_rad).filter(fits).ok_or_else(|| {
            let fewest = STORED.filter_map(Self::stored).find(|other| {
                other.squares_field_rad(margin_rad).is_some_and(|field| fits(&field))
            });
            let fewest = fewest.map(|other| other.len());
            let largest_margin_rad = self.largest_margin_rad();
            PartitionError::Field { count: self.len(), margin_rad, largest_margin_rad, fewest }
        })
    }

    /// The largest margin, radians, for which there are views; `None` if there are none at all.
    fn largest_margin_rad(&self) -> Option<f64> {
        let fits = |margin: f64| {
            self.squares_field_rad(margin).is_some_and(|field| field < LARGEST_FIELD_RAD)
        };
        if !fits(0.0) {
            return None;
        }
        let (mut low, mut high) = (0.0, LARGEST_FIELD_RAD);
        while high - low > 1e-4 {
            let middle = (low + high) / 2.0;
            if fits(middle) { low = middle } else { high = middle }
        }
        Some(low)
    }

    /// One square view for each partition, at the sphere's own resolution in its middle.
    ///
    /// Their field is [`Self::field_rad`], so that any object at most `margin_rad` wide lies wholly
    /// in some view. `pixels_per_radian` belongs to the sphere image, and becomes the focal length
    /// in pixels.
    ///
    /// # Errors
    /// A margin or resolution for which there is no pinhole image.
    pub fn views(
        &self,
        margin_rad: f64,
        pixels_per_radian: f64,
    ) -> Result<Vec<View>, PartitionError> {
        let field_rad = self.field_rad(margin_rad)?;
        // In this form NaN is refused too.
        if !(1.0..=1e5).contains(&pixels_per_radian) {
            return Err(PartitionError::Resolution { pixels_per_radian });
        }
        // One pixel more, because n pixels' centres span only n - 1.
        let size_px = (2.0 * pixels_per_radian * (field_rad / 2.0).tan()).ceil() as u32 + 1;
        let view = |(direction, roll_deg): (&Ray, &f64)| {
            let upright = View::looking_at(direction, field_rad, size_px);
            let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll_deg.to_radians());
            View {
                camera_from_view: upright.camera_from_view * roll,
                focal_px: pixels_per_radian,
                size_px,
            }
        };
        Ok(self.directions.iter().zip(&self.rolls_deg).map(view).collect())
    }

    /// The partition whose direction is nearest to `ray_in_camera`; the lower number in a tie.
    pub fn nearest(&self, ray_in_camera: &Ray) -> usize {
        let mut nearest = (0, f64::NEG_INFINITY);
        for (index, direction) in self.directions.iter().enumerate() {
            let cosine = direction.dot(ray_in_camera);
            if cosine > nearest.1 {
                nearest = (index, cosine);
            }
        }
        nearest.0
    }

    /// Field that the squares need, radians; `None` beyond pinhole images.
    fn squares_field_rad(&self, margin_rad: f64) -> Option<f64> {
        let half_rad = margin_rad / 2.0;
        let circumscribed_rad = self.covering_diameter_rad() + margin_rad;
        if margin_rad >= LARGEST_FIELD_RAD {
            return None;
        }
        let points = vectors(&self.directions);
        let certified = half_field(&self.squares(), &points, &self.facets, half_rad, TOLERANCE_RAD)
            .map(|field| 2.0 * field.certified_tan().atan());
        let circumscribed = (circumscribed_rad / 2.0 < FRAC_PI_2).then_some(circumscribed_rad);
        certified.into_iter().chain(circumscribed).reduce(f64::min)
    }

    fn squares(&self) -> Vec<Square> {
        let square = |(direction, roll_deg): (&Ray, &f64)| {
            let (sin, cos) = roll_deg.to_radians().sin_cos();
            Square::new(upright_axes(direction), (cos, sin))
        };
        self.directions.iter().zip(&self.rolls_deg).map(square).collect()
    }
}

/// Rounded to 15 decimals, which any JSON reader reads to the same last bit.
fn rounded(value: f64) -> f64 {
    (value * 1e15).round() / 1e15 + 0.0
}

fn vectors(directions: &[Ray]) -> Vec<Vector3<f64>> {
    directions.iter().map(|direction| direction.into_inner()).collect()
}

/// The cyclic permutations of (0, +-1, +-phi), phi the golden ratio, from ahead to behind.
fn icosahedron_vertices() -> Vec<Vector3<f64>> {
    let phi = (1.0 + 5f64.sqrt()) / 2.0;
    let vertices = [
        (phi, 0.0, 1.0),
        (phi, 0.0, -1.0),
        (1.0, phi, 0.0),
        (1.0, -phi, 0.0),
        (0.0, 1.0, phi),
        (0.0, -1.0, phi),
        (0.0, 1.0, -phi),
        (0.0, -1.0, -phi),
        (-1.0, phi, 0.0),
        (-1.0, -phi, 0.0),
        (-phi, 0.0, 1.0),
        (-phi, 0.0, -1.0),
    ];
    vertices.map(|(x, y, z)| Unit::new_normalize(Vector3::new(x, y, z)).into_inner()).to_vec()
}
