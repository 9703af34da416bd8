//! Means, medians and quantiles: one definition for everything that is reported.

/// The mean. `None` without values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The median of values in rising order: the mean of the middle two if their number is even. `None`
/// without values.
pub fn median(rising: &[f64]) -> Option<f64> {
    let upper = rising.get(rising.len() / 2)?;
    let lower = rising[(rising.len() - 1) / 2];
    Some((lower + upper) / 2.0)
}

/// The value that at least `share` of the values do not exceed (nearest rank). The values are in
/// rising order. `None` without values.
pub fn quantile(rising: &[f64], share: f64) -> Option<f64> {
    let rank = (share * rising.len() as f64).ceil() as usize;
    rising.get(rank.saturating_sub(1)).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_of_an_even_number_is_between_the_middle_two() {
        assert_eq!(
            (median(&[1.0, 2.0, 9.0]), median(&[7.0]), median(&[])),
            (Some(2.0), Some(7.0), None)
        );
        assert_eq!(median(&[1.0, 2.0, 4.0, 9.0]), Some(3.0));
    }

    #[test]
    fn quantiles_are_nearest_ranks() {
        let rising: Vec<f64> = (1..=100).map(f64::from).collect();
        assert_eq!((quantile(&rising, 0.95), quantile(&rising, 0.99)), (Some(95.0), Some(99.0)));
        assert_eq!((quantile(&rising, 0.0), quantile(&[], 0.5)), (Some(1.0), None));
    }

    #[test]
    fn the_mean_of_nothing_is_none() {
        assert_eq!((mean(&[1.0, 4.0]), mean(&[])), (Some(2.5), None));
    }
}
