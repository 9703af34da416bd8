//! Measures the time of a frame from one process to the next by the pipeline's own ports. For
//! comparison the same bytes go through a Unix domain socket and through Zenoh on loopback. They
//! also go through dora-rs if `FLOCKEYE_DORA` is dora's command and `FLOCKEYE_DORA_HOP` the program
//! of `tests/peers/dora`.
//!
//! There are two processes: this one sends, and starts itself again as the receiver. A frame is
//! written before the clock starts, so only the transport is measured. One time ends at the wake-up
//! of the consumer, the other when it has read each cache line. Zenoh wakes its consumer after a
//! whole message, the socket after the first bytes.

use std::hint::black_box;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::rc::Rc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{FrameHeader, FrameStamp, Frames};
use flockeye_geometry::statistics::{median, quantile};
use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, create_services};
use flockeye_tests::{Scratch, unique};
use iceoryx2::prelude::{Node, NodeBuilder, SignalHandlingMode, ipc};
use zenoh::Wait;
use zenoh::qos::CongestionControl;

/// Number of messages of each size and transport, after those for the warm-up.
const MESSAGES: usize = 400;
const WARM_UP: usize = 40;
const PERIOD: Duration = Duration::from_millis(10);
/// Size of the header of messages through the socket and Zenoh: time of sending and length.
const HEADER: usize = 16;
/// Key of the messages through Zenoh.
const KEY: &str = "flockeye/hop";
/// Timeout for the receiver of messages through Zenoh.
const PATIENCE: Duration = Duration::from_secs(10);
/// The frames' sizes: 1 KB, and a whole sphere.
const SIZES: [(u32, u32); 2] = [(32, 32), (3840, 1920)];

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.get(1).map(String::as_str) {
        Some("receive-frames") => receive_frames(&arguments[2]),
        Some("receive-bytes") => receive_bytes(Path::new(&arguments[2])),
        Some("receive-samples") => receive_samples(&arguments[2]),
        _ => measure(),
    }
}

/// Median and 99 % quantile of both points in time, microseconds.
struct Hop {
    woken_us: [f64; 2],
    read_us: [f64; 2],
}

fn measure() -> anyhow::Result<()> {
    println!(
        "\n{MESSAGES} messages of each size, {} a second; microseconds; {}\n",
        1000 / PERIOD.as_millis(),
        load_average()
    );
    println!(
        "{:<28} {:>10} {:>10} {:>10} {:>12} {:>10}",
        "way", "bytes", "woken 50 %", "99 %", "all read 50 %", "99 %"
    );
    let mut rows = Vec::new();
    for (width, height) in SIZES {
        let bytes = width as usize * height as usize;
        let ports = through_ports(width, height)?;
        let mut peers =
            vec![("a Unix socket", through_socket(bytes)?), ("Zenoh", through_zenoh(bytes)?)];
        peers.extend(through_dora(bytes)?.map(|hop| ("dora", hop)));
        let show = |way: &str, hop: &Hop| {
            println!(
                "{way:<28} {bytes:>10} {:>10.0} {:>10.0} {:>12.0} {:>10.0}",
                hop.woken_us[0], hop.woken_us[1], hop.read_us[0], hop.read_us[1]
            );
        };
        show("the frame topic", &ports);
        peers.iter().for_each(|(way, hop)| show(way, hop));
        rows.push((bytes, ports, peers));
    }
    println!();
    for (bytes, ports, peers) in &rows {
        for (peer, hop) in peers {
            println!(
                "{bytes} bytes all read: {peer} takes {:.2} times as long as the topic (median), {:.2} times (99 %)",
                hop.read_us[0] / ports.read_us[0],
                hop.read_us[1] / ports.read_us[1]
            );
        }
    }
    let [(_, small, _), (_, large, _)] = &rows[..] else { return Ok(()) };
    println!(
        "wake-up by the topic: a frame of 7.4 MB takes {:.2} times as long as one of 1 KB (median)",
        large.woken_us[0] / small.woken_us[0]
    );
    println!("{}", load_average());
    Ok(())
}

/// The instance's limits: those of the default pipeline.
fn budget() -> anyhow::Result<Budget> {
    Ok(Budget::for_views_of(&Resolved::of(Pipeline::default())?, 1024))
}

fn node_of(instance: &Instance) -> anyhow::Result<Rc<Node<ipc::Service>>> {
    let builder = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&instance.iceoryx2()?)
        .create::<ipc::Service>();
    Ok(Rc::new(builder.map_err(|error| anyhow::anyhow!("{error:?}"))?))
}

/// Starts this program again as the receiving end.
fn receiver(role: &str, of: &str) -> anyhow::Result<Child> {
    let own = std::env::current_exe().context("this program has a path")?;
    Command::new(own)
        .args([role, of])
        .stdout(Stdio::piped())
        .spawn()
        .context("this program can be started again")
}

/// The receiver's output as latencies.
fn result_of(child: Child) -> anyhow::Result<Hop> {
    let output = child.wait_with_output()?;
    ensure!(output.status.success(), "the receiver failed: {}", output.status);
    hop_of(&String::from_utf8(output.stdout)?)
}

/// Parses a line for each message, with both latencies in nanoseconds.
fn hop_of(text: &str) -> anyhow::Result<Hop> {
    let arrived = text.lines().count();
    ensure!(arrived > (MESSAGES + WARM_UP) * 9 / 10, "only {arrived} messages arrived");
    let mut columns = [Vec::new(), Vec::new()];
    for line in text.lines().skip(WARM_UP) {
        for (column, number) in columns.iter_mut().zip(line.split(' ')) {
            column.push(number.parse::<i64>()? as f64 * 1e-3);
        }
    }
    let [woken_us, read_us] = columns.map(|mut column| {
        column.sort_unstable_by(f64::total_cmp);
        Some([median(&column)?, quantile(&column, 0.99)?])
    });
    let missing = "a receiver wrote no latencies";
    Ok(Hop { woken_us: woken_us.context(missing)?, read_us: read_us.context(missing)? })
}

/// Waits for the line that a receiver prints when it is ready.
fn wait_until_ready(child: &mut Child) -> anyhow::Result<()> {
    let stdout = child.stdout.as_mut().context("it is piped")?;
    let mut line = [0; 6];
    stdout.read_exact(&mut line)?;
    ensure!(&line == b"ready\n", "the receiver is not ready");
    Ok(())
}

fn through_ports(width: u32, height: u32) -> anyhow::Result<Hop> {
    let instance = Instance::named(&unique("hop"));
    let ownership = instance.take()?;
    let node = node_of(&instance)?;
    let services = create_services::<Frames>(&node, budget()?.topic::<Frames>())?;
    let ports = Ports::new(node, budget()?, SharedCounters::default());
    let publisher = ports.publisher::<Frames>()?;
    let mut child = receiver("receive-frames", instance.name())?;
    wait_until_ready(&mut child)?;
    let bytes = width as usize * height as usize;
    for sequence in 0..(MESSAGES + WARM_UP) as u64 {
        let mut loan = publisher.loan(bytes)?;
        loan.items_mut().fill(sequence as u8);
        let stamp = FrameStamp { sequence, published_ns: monotonic_ns(), ..FrameStamp::default() };
        let header = FrameHeader { stamp, width, height, stride: width, ..FrameHeader::default() };
        publisher.send_loan(loan, header)?;
        std::thread::sleep(PERIOD);
    }
    // The last frame has a size of its own, which ends the receiver.
    let end = FrameHeader { width: 1, height: 1, stride: 1, ..Default::default() };
    publisher.send_loan(publisher.loan(1)?, end)?;
    let hop = result_of(child)?;
    drop((publisher, ports, services, ownership));
    Ok(hop)
}

fn receive_frames(instance: &str) -> anyhow::Result<()> {
    let instance = Instance::named(instance);
    let mut ports = Ports::new(node_of(&instance)?, budget()?, SharedCounters::default());
    let mut frames = ports.subscriber::<Frames>()?;
    println!("ready");
    let mut latencies = Vec::with_capacity(MESSAGES + WARM_UP);
    let mut is_over = false;
    ports.attend(|| {
        while let Some(message) = frames.receive()? {
            let woken_ns = monotonic_ns();
            is_over |= message.header.width == 1;
            if !is_over {
                touch(message.items());
                let sent_ns = message.header.stamp.published_ns;
                latencies.push((woken_ns - sent_ns, monotonic_ns() - sent_ns));
            }
        }
        Ok((!is_over).then_some(Duration::from_secs(1)))
    })?;
    report(&latencies);
    Ok(())
}

fn through_socket(bytes: usize) -> anyhow::Result<Hop> {
    let scratch = Scratch::new("hop");
    let path = scratch.path("socket");
    let listener = UnixListener::bind(&path)?;
    let mut child = receiver("receive-bytes", path.to_str().context("a plain path")?)?;
    let (mut stream, _) = listener.accept()?;
    wait_until_ready(&mut child)?;
    let mut message = vec![0; HEADER + bytes];
    for sequence in 0..MESSAGES + WARM_UP {
        message[HEADER..].fill(sequence as u8);
        message[..8].copy_from_slice(&monotonic_ns().to_le_bytes());
        message[8..HEADER].copy_from_slice(&bytes.to_le_bytes());
        stream.write_all(&message)?;
        std::thread::sleep(PERIOD);
    }
    drop(stream);
    result_of(child)
}

fn receive_bytes(path: &Path) -> anyhow::Result<()> {
    let mut stream = UnixStream::connect(path)?;
    println!("ready");
    let mut latencies = Vec::with_capacity(MESSAGES + WARM_UP);
    let mut header = [0; HEADER];
    let mut pixels = Vec::new();
    while stream.read_exact(&mut header).is_ok() {
        let woken_ns = monotonic_ns();
        let (sent, length) = header.split_at(8);
        let sent_ns = i64::from_le_bytes(sent.try_into()?);
        pixels.resize(usize::from_le_bytes(length.try_into()?), 0);
        stream.read_exact(&mut pixels)?;
        touch(&pixels);
        latencies.push((woken_ns - sent_ns, monotonic_ns() - sent_ns));
    }
    report(&latencies);
    Ok(())
}

/// A session between processes of this machine only.
fn session(listen: &[&str], connect: &[&str]) -> anyhow::Result<zenoh::Session> {
    let config = serde_json::json!({
        "mode": "peer",
        "listen": {"endpoints": listen},
        "connect": {"endpoints": connect},
        "scouting": {"multicast": {"enabled": false}},
    });
    let failed = |error: zenoh::Error| anyhow::anyhow!("{error}");
    let config = zenoh::Config::from_json5(&config.to_string()).map_err(failed)?;
    zenoh::open(config).wait().map_err(failed)
}

fn through_zenoh(bytes: usize) -> anyhow::Result<Hop> {
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let failed = |error: zenoh::Error| anyhow::anyhow!("{error}");
    let session = session(&[&endpoint], &[])?;
    let publisher = session
        .declare_publisher(KEY)
        .congestion_control(CongestionControl::Block)
        .wait()
        .map_err(failed)?;
    let mut child = receiver("receive-samples", &endpoint)?;
    wait_until_ready(&mut child)?;
    let start = Instant::now();
    while !publisher.matching_status().wait().map_err(failed)?.matching() {
        ensure!(start.elapsed() < PATIENCE, "nobody listens on Zenoh");
        std::thread::sleep(PERIOD);
    }
    for sequence in 0..MESSAGES + WARM_UP {
        let mut message = vec![sequence as u8; HEADER + bytes];
        message[8..HEADER].copy_from_slice(&bytes.to_le_bytes());
        message[..8].copy_from_slice(&monotonic_ns().to_le_bytes());
        publisher.put(message).wait().map_err(failed)?;
        std::thread::sleep(PERIOD);
    }
    // An empty message ends the receiver.
    publisher.put(Vec::new()).wait().map_err(failed)?;
    let hop = result_of(child)?;
    session.close().wait().map_err(failed)?;
    Ok(hop)
}

fn receive_samples(endpoint: &str) -> anyhow::Result<()> {
    let failed = |error: zenoh::Error| anyhow::anyhow!("{error}");
    let session = session(&[], &[endpoint])?;
    let samples = session.declare_subscriber(KEY).wait().map_err(failed)?;
    println!("ready");
    let mut latencies = Vec::with_capacity(MESSAGES + WARM_UP);
    loop {
        let sample = samples.recv().map_err(failed)?;
        let woken_ns = monotonic_ns();
        let message = sample.payload().to_bytes();
        let Some((header, pixels)) = message.split_at_checked(HEADER) else { break };
        let sent_ns = i64::from_le_bytes(header[..8].try_into()?);
        touch(pixels);
        latencies.push((woken_ns - sent_ns, monotonic_ns() - sent_ns));
    }
    report(&latencies);
    Ok(())
}

/// The latencies through dora-rs; `None` if it is not installed.
fn through_dora(bytes: usize) -> anyhow::Result<Option<Hop>> {
    let program = |variable| std::env::var_os(variable).map(PathBuf::from);
    let (Some(dora), Some(node)) = (program("FLOCKEYE_DORA"), program("FLOCKEYE_DORA_HOP")) else {
        return Ok(None);
    };
    let scratch = Scratch::new("hop");
    let (dataflow, result) = (scratch.path("dataflow.yml"), scratch.path("latencies"));
    let (messages, period_ms) = (MESSAGES + WARM_UP, PERIOD.as_millis());
    let nodes = serde_json::json!({"nodes": [
        {
            "id": "sender",
            "path": node,
            "args": format!("send {bytes} {messages} {period_ms}"),
            "outputs": ["frame"],
            // The default pool has memory for one frame, and a second one would be copied.
            "shared_memory_pool_size": 64 << 20,
        },
        {
            "id": "receiver",
            "path": node,
            "args": format!("receive {}", result.display()),
            "inputs": {"frame": {"source": "sender/frame", "queue_size": 16}},
        },
    ]});
    // JSON is YAML.
    std::fs::write(&dataflow, nodes.to_string())?;
    let output = Command::new(&dora)
        .arg("run")
        .arg(&dataflow)
        .current_dir(scratch.path("."))
        .output()
        .with_context(|| format!("{} cannot be started", dora.display()))?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "dora failed: {}\n{said}", output.status);
    let text = std::fs::read_to_string(&result).with_context(|| format!("dora says:\n{said}"))?;
    hop_of(&text).map(Some)
}

/// Reads one byte of each cache line.
fn touch(bytes: &[u8]) {
    black_box(bytes.iter().step_by(64).fold(0u8, |sum, &byte| sum.wrapping_add(byte)));
}

fn report(latencies: &[(i64, i64)]) {
    for (woken_ns, read_ns) in latencies {
        println!("{woken_ns} {read_ns}");
    }
}

fn load_average() -> String {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load: Vec<&str> = text.split_whitespace().take(3).collect();
    format!("load average {}", load.join(" "))
}
