//! Pipelines as separate processes, each a `flockeye up`.

use std::ffi::OsString;
use std::fs::File;
use std::net::TcpListener;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use flockeye_cli::program;
use flockeye_runtime::instance::Instance;
use rustix::process::{Pid, Signal, kill_process};

/// Time for a pipeline to end after SIGTERM.
const END_TIME: Duration = Duration::from_secs(15);
/// Number of a failed pipeline's last lines that are shown.
const SHOWN_LINES: usize = 15;

/// Running pipelines. Dropping the value ends them.
#[derive(Debug)]
pub(crate) struct Fleet {
    pipelines: Vec<FleetProcess>,
    /// Folder of the pipelines' output.
    pub(crate) folder: PathBuf,
}

#[derive(Debug)]
struct FleetProcess {
    instance: Instance,
    log: PathBuf,
    child: Child,
}

impl FleetProcess {
    fn last_lines(&self) -> String {
        let text = std::fs::read_to_string(&self.log).unwrap_or_default();
        let lines: Vec<&str> = text.lines().collect();
        lines[lines.len().saturating_sub(SHOWN_LINES)..].join("\n")
    }
}

impl Fleet {
    /// Starts a pipeline for each instance name, with these arguments of `flockeye up`. Their
    /// output goes to files in [`Fleet::folder`].
    pub(crate) fn start(pipelines: &[(String, Vec<OsString>)]) -> anyhow::Result<Self> {
        let program = program::find("flockeye")?;
        let folder = std::env::temp_dir().join(format!("flockeye-swarm-{}", std::process::id()));
        std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        let mut fleet = Self { pipelines: Vec::new(), folder };
        for (name, arguments) in pipelines {
            let instance = Instance::named(name);
            let log = fleet.folder.join(format!("{name}.log"));
            let output = File::create(&log).with_context(|| log.display().to_string())?;
            let mut command = Command::new("/proc/self/exe");
            // The pipeline ends with this process.
            command.args(["exec-stage", "--parent", &std::process::id().to_string()]);
            command.arg(&program).arg("up").args(arguments);
            command.stdin(Stdio::null()).stdout(output.try_clone()?).stderr(output);
            let child = command.spawn().with_context(|| format!("the pipeline {name}"))?;
            fleet.pipelines.push(FleetProcess { instance, log, child });
        }
        Ok(fleet)
    }

    /// Checks that all pipelines run.
    ///
    /// # Errors
    /// A pipeline has ended. The error contains its last lines.
    pub(crate) fn check(&mut self) -> anyhow::Result<()> {
        for pipeline in &mut self.pipelines {
            if let Some(status) = pipeline.child.try_wait()? {
                bail!(
                    "the pipeline {} ended, {status}:\n{}\nAll that it wrote: {}",
                    pipeline.instance.name(),
                    pipeline.last_lines(),
                    pipeline.log.display()
                );
            }
        }
        Ok(())
    }

    /// The last lines that each pipeline wrote.
    pub(crate) fn last_lines(&self) -> String {
        let lines: Vec<_> = self.pipelines.iter().map(FleetProcess::last_lines).collect();
        lines.join("\n")
    }

    /// Ends all pipelines, and removes their output.
    pub(crate) fn end(mut self) {
        self.stop();
        // An error is ignored: only a few kilobytes stay in a temporary folder.
        drop(std::fs::remove_dir_all(&self.folder));
    }

    fn stop(&mut self) {
        for pipeline in &self.pipelines {
            // An error is ignored: the pipeline may have ended.
            kill_process(Pid::from_child(&pipeline.child), Signal::TERM).ok();
        }
        let end = Instant::now() + END_TIME;
        for pipeline in &mut self.pipelines {
            while matches!(pipeline.child.try_wait(), Ok(None)) {
                if Instant::now() >= end {
                    pipeline.child.kill().ok();
                    pipeline.child.wait().ok();
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        self.pipelines.clear();
    }
}

impl Drop for Fleet {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Free TCP ports of the loopback interface. If another program takes one meanwhile, the gateway
/// reports that.
pub(crate) fn free_ports(count: usize) -> anyhow::Result<Vec<u16>> {
    let listeners: Vec<TcpListener> = (0..count)
        .map(|_| TcpListener::bind(("127.0.0.1", 0)))
        .collect::<Result<_, _>>()
        .context("a free port on 127.0.0.1")?;
    let ports = listeners.iter().map(|listener| Ok(listener.local_addr()?.port()));
    ports.collect()
}
