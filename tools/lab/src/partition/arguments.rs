//! Arguments of `partition`.

use std::path::PathBuf;

use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use flockeye_geometry::partition::{Criterion, FEWEST, MOST, Method, PartitionError, STORED_SEED};

/// Arguments of `partition`.
#[derive(Debug, Args)]
pub(crate) struct PartitionArguments {
    /// Numbers of views, from 4 to 128: 12, 6,12,24 or 4..32 (inclusive).
    #[arg(long, default_value = "4..32", value_parser = counts)]
    pub counts: ViewCounts,
    /// covering: the smallest circles. paper: spread points, then grow circles.
    #[arg(long, default_value = "covering", value_parser = methods())]
    pub method: Method,
    /// Weights of the number of views, their pixels and their distortion in the cost.
    #[arg(long, value_name = "A1,A2,A3", value_parser = weights)]
    pub weights: Option<Criterion>,
    /// Anything up to this width lies wholly in one view, degrees; a marker of 5 cm at 40 cm is
    /// 7.15.
    #[arg(long, value_name = "DEGREES", default_value_t = 7.15)]
    pub margin: f64,
    /// Pixels in a row of the sphere image.
    #[arg(long, value_name = "PIXELS", default_value_t = 3840, value_parser = clap::value_parser!(u32).range(64..=16384))]
    pub width: u32,
    /// Another random start; coverings by up to 32 circles are stored for 1.
    #[arg(long, default_value_t = STORED_SEED)]
    pub seed: u64,
    /// Compute stored partitions again.
    #[arg(long)]
    pub compute: bool,
    /// JSON with directions and rolls instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Draw the paper's figure: number of views against pixels, both methods.
    #[arg(long, value_name = "FILE.svg")]
    pub svg: Option<PathBuf>,
    /// Draw the (first) partition's circles and views on the sphere and on the sphere image.
    #[arg(long, value_name = "FILE.svg")]
    pub picture: Option<PathBuf>,
}

/// Numbers of views. clap would treat a plain `Vec` field as an option with several values.
pub(super) type ViewCounts = Vec<usize>;

/// Parser of the method that finds the directions of a partition.
fn methods() -> impl TypedValueParser<Value = Method> {
    let names = [
        PossibleValue::new("covering").help("The smallest circles"),
        PossibleValue::new("paper").help("Spread points, then grow circles"),
    ];
    PossibleValuesParser::new(names).map(|name| match name.as_str() {
        "paper" => Method::Paper,
        _ => Method::Covering,
    })
}

/// Parses numbers of views: `12`, `6,12,24`, `4..32`.
pub(super) fn counts(text: &str) -> Result<ViewCounts, String> {
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
    Ok(counts)
}

/// Parses weights: `0.2,0.02,0.78`.
pub(super) fn weights(text: &str) -> Result<Criterion, String> {
    let numbers = text.split(',').map(|part| part.trim().parse::<f64>());
    let numbers = numbers.collect::<Result<Vec<_>, _>>().ok();
    let numbers = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    let numbers =
        numbers.ok_or_else(|| format!("'{text}' must be three numbers, as in 0.2,0.02,0.78"))?;
    Criterion::new(numbers).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn counts_are_numbers_lists_and_ranges() {
        assert_eq!(counts("12").unwrap(), [12]);
        assert_eq!(counts("6, 12,24").unwrap(), [6, 12, 24]);
        assert_eq!(counts("4..6,128").unwrap(), [4, 5, 6, 128]);
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
        assert_eq!(weights("0.2, 0.02, 0.78").unwrap(), Criterion::default());
        assert!(weights("0.2,0.8").unwrap_err().contains("three numbers"));
        assert!(weights("a,b,c").unwrap_err().contains("three numbers"));
        assert!(weights("0.5,0.5,0.5").unwrap_err().contains("sum to 1"));
    }
}
