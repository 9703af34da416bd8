//! The choice of N: the paper's criterion, alpha1 N + alpha2 p + alpha3 d.

use super::{FEWEST, Partition, PartitionError, STORED};

/// The three terms of the criterion, not normalised.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Terms {
    /// N.
    pub count: f64,
    /// p / (h w) = N theta^2 / (360 degrees)^2: pixels of all circles, in sphere images.
    ///
    /// The paper prints the fraction upside down. Its p would grow as circles shrink, without the
    /// minimum at N = 12 that its own figure shows.
    pub pixels: f64,
    /// d = 1 / cos^2(theta / 2): stretch of the circle's rim along the radius in a pinhole view,
    /// relative to its middle. The stretch across the radius is the root of that.
    pub stretch: f64,
}

impl Terms {
    /// Terms for `count` circles of this diameter, radians.
    pub fn new(count: usize, diameter_rad: f64) -> Self {
        Self {
            count: count as f64,
            pixels: count as f64 * (diameter_rad / std::f64::consts::TAU).powi(2),
            stretch: (diameter_rad / 2.0).cos().powi(-2),
        }
    }

    fn values(&self) -> [f64; 3] {
        [self.count, self.pixels, self.stretch]
    }
}

/// The criterion with its normalisation.
///
/// N counts views, p images, d is a ratio. Weights that sum to one need terms of one range. So each
/// term is 0 at its least and 1 at its greatest among the coverings by 4 to 32 circles. The range
/// is fixed, so that a partition's cost does not depend on the other candidates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Criterion {
    weights: [f64; 3],
    least: [f64; 3],
    greatest: [f64; 3],
}

impl Criterion {
    /// The criterion with the weights alpha1, alpha2 and alpha3 of the number of views, their
    /// pixels and their distortion. The paper requires positive weights that sum to one. It also
    /// requires alpha1 far above alpha2, which is not checked.
    ///
    /// # Errors
    /// [`PartitionError::NegligibleWeight`] and [`PartitionError::WeightSum`].
    pub fn new(weights: [f64; 3]) -> Result<Self, PartitionError> {
        // In this form NaN is refused too.
        if !weights.iter().all(|&weight| weight > 0.0) {
            return Err(PartitionError::NegligibleWeight { weights });
        }
        if (weights.iter().sum::<f64>() - 1.0).abs() > 1e-6 {
            return Err(PartitionError::WeightSum { weights });
        }
        Ok(Self::normalised(weights))
    }

    fn normalised(weights: [f64; 3]) -> Self {
        let mut least = [f64::INFINITY; 3];
        let mut greatest = [f64::NEG_INFINITY; 3];
        for terms in STORED.filter_map(terms_of_stored) {
            for (axis, value) in terms.values().into_iter().enumerate() {
                least[axis] = least[axis].min(value);
                greatest[axis] = greatest[axis].max(value);
            }
        }
        Self { weights, least, greatest }
    }

    /// alpha1, alpha2 and alpha3.
    pub fn weights(&self) -> [f64; 3] {
        self.weights
    }

    /// alpha1 N + alpha2 p + alpha3 d, each term normalised.
    pub fn cost(&self, terms: &Terms) -> f64 {
        let mut cost = 0.0;
        for (axis, value) in terms.values().into_iter().enumerate() {
            let range = self.greatest[axis] - self.least[axis];
            cost += self.weights[axis] * (value - self.least[axis]) / range;
        }
        cost
    }

    /// The N of least cost among the stored coverings.
    pub fn choice(&self) -> usize {
        let mut choice = (f64::INFINITY, FEWEST);
        for terms in STORED.filter_map(terms_of_stored) {
            let cost = self.cost(&terms);
            if cost < choice.0 {
                choice = (cost, terms.count as usize);
            }
        }
        choice.1
    }
}

impl Default for Criterion {
    /// Weights distortion most, then the number of views, then pixels. alpha1 is ten times alpha2.
    /// The result is the paper's choice.
    fn default() -> Self {
        Self::normalised([0.2, 0.02, 0.78])
    }
}

fn terms_of_stored(count: usize) -> Option<Terms> {
    Partition::stored(count).map(|partition| partition.terms())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn choice(weights: [f64; 3]) -> usize {
        Criterion::new(weights).unwrap().choice()
    }

    #[test]
    fn the_default_is_the_papers_choice() {
        assert_eq!(Criterion::default().choice(), 12);
    }

    #[test]
    fn each_weight_pulls_its_way() {
        assert!(choice([0.98, 0.01, 0.01]) < 12);
        assert!(choice([0.01, 0.01, 0.98]) > 12);
        // The circles of 32 overlap the least.
        assert_eq!(choice([0.01, 0.98, 0.01]), 32);
    }

    #[test]
    fn wrong_weights_are_refused_with_the_cure() {
        let error = |weights| Criterion::new(weights).unwrap_err().to_string();
        assert!(error([0.5, 0.5, 0.5]).contains("sum to 1.5000"));
        assert!(error([0.5, 0.5, 0.5]).contains("[0.3333, 0.3333, 0.3333]"));
        assert!(error([1.0, 0.0, 0.0]).contains("above 0"));
        assert!(error([f64::NAN, 0.5, 0.5]).contains("above 0"));
        assert!(error([1.5, -0.25, -0.25]).contains("above 0"));
    }

    #[test]
    fn terms_are_the_papers() {
        let terms = Terms::new(12, 90f64.to_radians());
        assert!((terms.pixels - 12.0 / 16.0).abs() < 1e-12);
        assert!((terms.stretch - 2.0).abs() < 1e-12);
    }
}
