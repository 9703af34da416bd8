//! Rotation of a partition, and the numbering of its parts.

use nalgebra::{Matrix3, Vector3};

/// Turns directions so that the first looks straight ahead (+x) and the nearest to it lies level,
/// to its left (+y), and orders them from ahead to behind.
///
/// A covering may be rotated freely. The first direction is the one with the nearest neighbour.
/// Only sums, products and roots are used, as everywhere in partitions.
pub(super) fn canonical(directions: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let mut closest = (0, 0, -2.0);
    for (a, p) in directions.iter().enumerate() {
        for (b, q) in directions.iter().enumerate() {
            // Values that differ only by rounding count as equal: the lower numbers win.
            if a != b && p.dot(q) > closest.2 + 1e-9 {
                closest = (a, b, p.dot(q));
            }
        }
    }
    let (first, second, cosine) = closest;
    let ahead = directions[first];
    let left = directions[second] - ahead * cosine;
    let left = left / left.norm_squared().sqrt();
    let turn =
        Matrix3::from_rows(&[ahead.transpose(), left.transpose(), ahead.cross(&left).transpose()]);
    let mut turned: Vec<_> = directions.iter().map(|direction| turn * direction).collect();
    turned.sort_by_key(rank);
    turned
}

/// Ahead before behind, then above before below, then left before right. Values that differ only by
/// rounding count as equal.
fn rank(direction: &Vector3<f64>) -> [i64; 3] {
    let coarse = |value: f64| (value * -1e7).round() as i64;
    [coarse(direction.x), coarse(direction.z), coarse(direction.y)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Chance;

    #[test]
    fn the_first_is_ahead_and_the_rest_follow() {
        let mut random = Chance::stream(3, 0);
        let directions: Vec<_> = (0..20).map(|_| random.portable_direction()).collect();
        let turned = canonical(&directions);
        assert!((turned[0] - Vector3::x()).norm() < 1e-12);
        assert!(turned.windows(2).all(|pair| pair[0].x >= pair[1].x - 1e-6));
        let nearest = turned[1..].iter().max_by(|p, q| p.x.total_cmp(&q.x)).expect("there are 19");
        assert!(nearest.z.abs() < 1e-12 && nearest.y > 0.0);
        // A rotation: angles stay, and so does handedness.
        let volume = |d: &[Vector3<f64>]| -> f64 {
            let mut sum = 0.0;
            for a in d {
                for b in d {
                    for c in d {
                        sum += a.cross(b).dot(c).powi(3) * a.dot(b) * b.dot(c).powi(2);
                    }
                }
            }
            sum
        };
        assert!((volume(&directions) - volume(&turned)).abs() < 1e-9);
    }
}
