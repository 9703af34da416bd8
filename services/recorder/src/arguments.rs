//! The command line.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::{Parser, ValueEnum};
use flockeye_cli::duration;
use flockeye_cli::running::PipelineChoice;

/// Record a running pipeline's messages to an MCAP file.
#[derive(Debug, Parser)]
#[command(name = "flockeye record")]
pub struct RecordArguments {
    /// The recording. An existing file is not overwritten.
    #[arg(value_name = "OUT.mcap", required_unless_present = "now")]
    pub out: Option<PathBuf>,
    /// Which pipeline.
    #[command(flatten)]
    pub running: PipelineChoice,
    /// Pictures: none, views (the pixels of all views), camera (its own H.264 or H.265, as it
    /// came), or "every N" (each Nth frame, JPEG).
    #[arg(long, value_name = "WHICH", default_value = "none")]
    pub frames: FramesChoice,
    /// How long to record: 20s, 5m, 1h. Without it: until the pipeline ends.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Begin another file after so much: 500MB, 1GB.
    #[arg(long, value_name = "SIZE", value_parser = size)]
    pub split: Option<u64>,
    /// Write only what came before something, a file each time: lost (a neighbour's track), or
    /// request (--now).
    #[arg(long, value_name = "WHEN", conflicts_with = "split")]
    pub trigger: Option<Trigger>,
    /// With --trigger: how much of the past is kept.
    #[arg(long, value_name = "DURATION", value_parser = duration, default_value = "30s")]
    pub past: Duration,
    /// Ask the running recorders with --trigger to write what they have.
    #[arg(long, conflicts_with_all = ["out", "trigger", "recover"])]
    pub now: bool,
    /// Make a whole recording, OUT.mcap, of what can be read of a broken one.
    #[arg(long, value_name = "BROKEN.mcap", conflicts_with_all = ["frames", "duration", "split", "trigger"])]
    pub recover: Option<PathBuf>,
}

/// When a recorder that keeps the past writes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Trigger {
    /// A neighbour's track is lost; also on request.
    Lost,
    /// On request alone.
    Request,
}

/// Choice of the recorded pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FramesChoice {
    /// No pictures: headers alone.
    None,
    /// The pixels of all views.
    Views,
    /// The source's own coded pictures.
    Camera,
    /// Each frame whose number is a multiple of this, as JPEG.
    Every(u64),
}

impl FromStr for FramesChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("'{text}' is not none, views, camera, or \"every N\" with N from 1");
        match text {
            "none" => Ok(Self::None),
            "views" => Ok(Self::Views),
            "camera" => Ok(Self::Camera),
            _ => {
                let count = text.strip_prefix("every ").ok_or_else(wrong)?;
                let count = count.parse().map_err(|_| wrong())?;
                if count == 0 { Err(wrong()) } else { Ok(Self::Every(count)) }
            }
        }
    }
}

/// Reads a size such as `500MB` or `1GB`, in bytes.
fn size(text: &str) -> Result<u64, String> {
    let wrong = || format!("'{text}' is no size; write 500MB or 1GB, 1MB at least");
    let digits = text.find(|character: char| !character.is_ascii_digit()).unwrap_or(text.len());
    let number: u64 = text[..digits].parse().map_err(|_| wrong())?;
    let unit = match text[digits..].trim() {
        "MB" => 1_000_000,
        "GB" => 1_000_000_000,
        _ => return Err(wrong()),
    };
    number.checked_mul(unit).filter(|&bytes| bytes > 0).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_well_formed() {
        RecordArguments::command().debug_assert();
    }

    #[test]
    fn sizes_and_pictures_are_read_and_others_refused() {
        assert_eq!(size("1GB"), Ok(1_000_000_000));
        assert_eq!(size("500 MB"), Ok(500_000_000));
        for wrong in ["", "0MB", "1", "GB", "-1GB", "99999999999999999999GB", "1 GiB"] {
            assert!(size(wrong).unwrap_err().contains("write 500MB or 1GB"), "{wrong}");
        }
        assert_eq!("every 10".parse(), Ok(FramesChoice::Every(10)));
        assert_eq!("camera".parse(), Ok(FramesChoice::Camera));
        for wrong in ["every", "every3", "every=3", "every 0", "every -1", "all", ""] {
            assert!(wrong.parse::<FramesChoice>().is_err(), "{wrong}");
        }
    }
}
