//! Client side of the control channel.

use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use anyhow::{Context, bail};
use flockeye_runtime::instance::Instance;
use serde_json::Value;

use super::{ControlRequest, Reply, socket_path};

/// Timeout of a launcher that sends nothing. A swap sends a line at each step.
const PATIENCE: Duration = Duration::from_secs(120);

/// Sends `request` to the launcher of `instance`, and passes its progress to `show`. Returns the
/// last reply as text and as a value.
///
/// # Errors
/// The launcher cannot be reached, or it has not done the request; the message is its reason.
pub fn ask(
    instance: &Instance,
    request: &ControlRequest,
    mut show: impl FnMut(&str),
) -> anyhow::Result<(String, Value)> {
    let path = socket_path(instance.folder());
    if !instance.has_launcher() {
        bail!(
            "the stages of '{}' fly on without a launcher. Cure: `flockeye up --keep` takes them over, \
             `flockeye stop` ends them",
            instance.name()
        );
    }
    let mut stream = UnixStream::connect(&path).with_context(|| {
        format!("the pipeline '{}' does not answer at {}", instance.name(), path.display())
    })?;
    stream.set_read_timeout(Some(PATIENCE)).context("the control channel")?;
    let mut line = serde_json::to_vec(request).context("the request")?;
    line.push(b'\n');
    stream.write_all(&line).context("the request cannot be sent")?;
    for line in BufReader::new(stream).lines() {
        let line = match line {
            Ok(line) => line,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                bail!("the launcher has said nothing for {} s", PATIENCE.as_secs())
            }
            Err(error) => return Err(error).context("the control channel broke"),
        };
        match serde_json::from_str(&line).context("the launcher's answer")? {
            Reply::Progress(text) => show(&text),
            Reply::Done { text, report } => return Ok((text, report)),
            Reply::Failed(reason) => bail!(reason),
        }
    }
    bail!("the launcher has ended before it was done")
}
