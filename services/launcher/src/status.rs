//! Status of a pipeline's processes, as a table and as JSON.

use std::fmt;

use flockeye_cli::text_table::TextTable;
use serde::Serialize;

use crate::control::WorkerName;

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PipelineStatus {
    pub instance: String,
    pub launcher_pid: u32,
    /// Running time, seconds.
    pub running_s: f64,
    /// Frames that were searched to their end.
    pub frames: u64,
    /// The worker that is being swapped.
    pub swapping: Option<WorkerName>,
    /// Each worker, in the order of the dataflow.
    pub workers: Vec<WorkerStatus>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct WorkerStatus {
    pub worker: WorkerName,
    /// starting, ready, degraded, draining, finished, stopped, given up, is restarted, rests, waits
    /// for the others.
    pub state: String,
    /// Number of its process while it runs.
    pub pid: Option<u32>,
    /// Number of replacements so far.
    pub generation: u32,
    /// Running time of its process, seconds.
    pub age_s: Option<f64>,
    pub command: Vec<String>,
}

impl fmt::Display for PipelineStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} runs for {:.0} s (process {}), {} frames",
            self.instance, self.running_s, self.launcher_pid, self.frames
        )?;
        let mut table =
            TextTable::new(2, &["worker", "state", "process", "generation", "for s", "command"]);
        for worker in &self.workers {
            table.row([
                worker.worker.to_string(),
                worker.state.clone(),
                worker.pid.map_or_else(String::new, |pid| pid.to_string()),
                worker.generation.to_string(),
                worker.age_s.map_or_else(String::new, |age_s| format!("{age_s:.0}")),
                worker.command.join(" "),
            ]);
        }
        f.write_str(table.text().trim_end())?;
        match self.swapping {
            Some(worker) => write!(f, "\n{worker} is being swapped"),
            None => Ok(()),
        }
    }
}
