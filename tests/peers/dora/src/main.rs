//! The two ends of a hop through dora-rs: `dora-hop send BYTES MESSAGES PERIOD_MS` and `dora-hop
//! receive FILE`. dora starts both as the nodes of a dataflow. The file gets a line for each
//! message with two latencies from sending, nanoseconds. They end at the receiver's wake-up, and
//! when it has read each cache line.

use std::fs::File;
use std::hint::black_box;
use std::io::Write as _;
use std::time::Duration;

use dora_node_api::{DoraNode, Event, MetadataParameters};
use eyre::{OptionExt as _, bail};
use rustix::time::{ClockId, clock_gettime};

/// Size of the header of each message, the time of sending.
const HEADER: usize = 8;

fn main() -> eyre::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["send", bytes, messages, period_ms] => {
            let period = Duration::from_millis(period_ms.parse()?);
            send(bytes.parse()?, messages.parse()?, period)
        }
        ["receive", file] => receive(file),
        _ => bail!("usage: dora-hop send BYTES MESSAGES PERIOD_MS | dora-hop receive FILE"),
    }
}

fn send(bytes: usize, messages: usize, period: Duration) -> eyre::Result<()> {
    let (mut node, _events) = DoraNode::init_from_env()?;
    for sequence in 0..messages {
        let parameters = MetadataParameters::default();
        // The payload is written in shared memory before the clock starts.
        node.send_output_raw("frame".to_owned().into(), parameters, HEADER + bytes, |message| {
            message[HEADER..].fill(sequence as u8);
            message[..HEADER].copy_from_slice(&monotonic_ns().to_le_bytes());
        })?;
        std::thread::sleep(period);
    }
    Ok(())
}

fn receive(file: &str) -> eyre::Result<()> {
    let (_node, mut events) = DoraNode::init_from_env()?;
    let mut latencies = Vec::new();
    while let Some(event) = events.recv() {
        match event {
            Event::Input { data, .. } => {
                let woken_ns = monotonic_ns();
                let message = <&[u8]>::try_from(&data)?;
                let (sent, pixels) = message.split_first_chunk().ok_or_eyre("no header")?;
                touch(pixels);
                let sent_ns = i64::from_le_bytes(*sent);
                latencies.push((woken_ns - sent_ns, monotonic_ns() - sent_ns));
            }
            Event::InputClosed { .. } | Event::Stop(_) => break,
            Event::Error(error) => bail!(error),
            _ => {}
        }
    }
    let mut file = File::create(file)?;
    for (woken_ns, read_ns) in latencies {
        writeln!(file, "{woken_ns} {read_ns}")?;
    }
    Ok(())
}

/// Reads one byte of each cache line.
fn touch(bytes: &[u8]) {
    black_box(bytes.iter().step_by(64).fold(0u8, |sum, &byte| sum.wrapping_add(byte)));
}

fn monotonic_ns() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}
