//! The command line of `explain`.

use std::path::PathBuf;

use anyhow::{Context as _, bail};
use clap::Parser;

/// Arguments of `explain`.
#[derive(Debug, Parser)]
#[command(
    after_help = "A recording with its views from the first frame on tells all (recording.folder, recording.frames: views). \
                  Of others it is said what the messages tell. docs/RECORDING.md has an example."
)]
pub(crate) struct ExplainArguments {
    /// The recording.
    #[arg(value_name = "FILE.mcap")]
    pub file: PathBuf,
    /// The neighbour: the name of its body.
    #[arg(long, value_name = "NAME")]
    pub target: String,
    /// The last frame exposed by then: time since the recording began (lossless: since the stream
    /// began), as 12.3s, 900ms or 2min.
    #[arg(long, value_name = "TIME", conflicts_with = "frame", required_unless_present = "frame")]
    pub at: Option<String>,
    /// The frame with this number; the view's page names frames by SOURCE.EPOCH.NUMBER, which is
    /// unique.
    #[arg(long, value_name = "NUMBER")]
    pub frame: Option<String>,
    /// Also draws what was seen there to this file.
    #[arg(long, value_name = "OUT.png")]
    pub image: Option<PathBuf>,
    /// Prints the answer as JSON.
    #[arg(long)]
    pub json: bool,
}

/// The way in which a frame is named.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum When {
    /// The last frame that was exposed at or before this time, seconds since the recording began.
    At(f64),
    /// The first frame with this number.
    Frame(u64),
    /// The frame with this number, of this process and stream of the source.
    Exactly {
        /// `source_generation` of the frame's stamp.
        source: u32,
        /// `epoch` of the frame's stamp.
        epoch: u32,
        /// `sequence` of the frame's stamp.
        number: u64,
    },
}

impl ExplainArguments {
    /// The requested frame.
    pub(crate) fn when(&self) -> anyhow::Result<When> {
        Ok(match (&self.at, &self.frame) {
            (_, Some(frame)) => named(frame)?,
            (Some(at), None) => When::At(seconds(at)?),
            (None, None) => bail!("neither --at nor --frame is given"),
        })
    }
}

/// Parses a frame: its number, or source, epoch and number.
fn named(text: &str) -> anyhow::Result<When> {
    let parts: Vec<&str> = text.trim().split('.').collect();
    let read = || match parts[..] {
        [number] => number.parse().ok().map(When::Frame),
        [source, epoch, number] => Some(When::Exactly {
            source: source.parse().ok()?,
            epoch: epoch.parse().ok()?,
            number: number.parse().ok()?,
        }),
        _ => None,
    };
    read().with_context(|| format!("--frame {text}: is no frame. Cure: 38, or 1.0.38"))
}

/// Parses a time such as 12.3s, 900ms or 2min, in seconds.
fn seconds(text: &str) -> anyhow::Result<f64> {
    let text = text.trim();
    let units = [("ms", 1e-3), ("min", 60.0), ("s", 1.0), ("", 1.0)];
    let (number, unit_s) = units
        .into_iter()
        .find_map(|(unit, unit_s)| Some((text.strip_suffix(unit)?, unit_s)))
        .unwrap_or((text, 1.0));
    let refused = || format!("--at {text}: is no time. Cure: 12.3s, 900ms or 2min");
    let number: f64 = number.trim().parse().with_context(refused)?;
    if !(number.is_finite() && number >= 0.0) {
        bail!(refused());
    }
    Ok(number * unit_s)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_well_formed() {
        ExplainArguments::command().debug_assert();
        let parse = |more: &[&str]| {
            let words = [&["explain", "a.mcap", "--target", "alpha"][..], more].concat();
            ExplainArguments::try_parse_from(words)
        };
        assert!(parse(&[]).is_err(), "which frame?");
        assert!(parse(&["--at", "1s", "--frame", "3"]).is_err());
        assert_eq!(parse(&["--frame", "3"]).unwrap().when().unwrap(), When::Frame(3));
        let exactly = When::Exactly { source: 1, epoch: 0, number: 38 };
        assert_eq!(parse(&["--frame", "1.0.38"]).unwrap().when().unwrap(), exactly);
        for wrong in ["", "x", "-1", "1.2", "1.2.3.4", "1..3"] {
            let refused = parse(&[&format!("--frame={wrong}")]).unwrap().when().unwrap_err();
            assert!(refused.to_string().contains("is no frame. Cure"), "{wrong}: {refused}");
        }
        assert_eq!(parse(&["--at", "1.5s"]).unwrap().when().unwrap(), When::At(1.5));
    }

    #[test]
    fn times_are_read_as_people_write_them() {
        for (text, wanted) in [("12.3s", 12.3), ("900ms", 0.9), ("2min", 120.0), (" 4 ", 4.0)] {
            assert!((seconds(text).unwrap() - wanted).abs() < 1e-12, "{text}");
        }
        for text in ["", "s", "-1s", "1h", "nan", "inf s", "soon"] {
            assert!(seconds(text).unwrap_err().to_string().contains("is no time"), "{text}");
        }
    }
}
