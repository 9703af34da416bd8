//! `flockeye partition`: partitions of the sphere as a table, as JSON and as drawings.
//!
//! `common/geometry/data/partitions.json` is the output of `flockeye partition --compute --json`.

mod arguments;
mod figure;
mod picture;
pub(crate) mod table;

use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use flockeye_cli::Screen;
use flockeye_geometry::partition::{Partition, PartitionError};

pub(crate) use arguments::PartitionArguments;
use table::PartitionTable;

/// Prints the table, and writes the requested drawings.
pub(crate) fn run(arguments: &PartitionArguments) -> anyhow::Result<()> {
    let partitions = arguments.counts.iter().map(|&count| find(arguments, count));
    let partitions = partitions.collect::<Result<Vec<_>, _>>()?;
    let table = PartitionTable::of(arguments, &partitions)?;
    if let Some(path) = &arguments.svg {
        write(path, &figure::draw(arguments)?)?;
    }
    Screen::new().line(&if arguments.json { table.to_json()? } else { table.to_string() });
    if let Some(path) = &arguments.picture {
        // Uses the first partition that has views with this margin. If none has, the first error is
        // reported.
        let mut pictures =
            partitions.iter().map(|p| picture::draw(p, arguments.margin.to_radians()));
        let first = pictures.next().context("there is no partition to draw")?;
        let drawn = first.or_else(|error| pictures.find_map(Result::ok).ok_or(error))?;
        write(path, &drawn)?;
    }
    Ok(())
}

/// The requested partition of `count` views. Logs the time if it is computed.
fn find(arguments: &PartitionArguments, count: usize) -> Result<Partition, PartitionError> {
    let method = arguments.method;
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
