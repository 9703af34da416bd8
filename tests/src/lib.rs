//! Helpers for whole-pipeline tests: pipelines of real processes under a watchdog.
//!
//! Each test has its own instance name, so that tests run in parallel. It must leave nothing in
//! /dev/shm ([`Flight::assert_nothing_left`]).

pub mod air;
pub mod autopilot;
pub mod browser;
pub mod drone;
pub mod onlooker;
pub mod told;

use std::io::{BufRead, BufReader, Read};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context as _;
pub use flockeye_require::{VULKAN, absent, recordings};
use flockeye_runtime::instance::Instance;
use rustix::process::{Pid, Signal, kill_process};

/// Timeout of a single wait in a test. It is long, because a loaded machine is slow.
pub const WATCHDOG: Duration = Duration::from_secs(120);

/// The `flockeye` command that was built with these tests.
pub fn flockeye() -> PathBuf {
    let own = std::env::current_exe().expect("a test has a path");
    // target/release/deps/test-0123 or target/release/golden -> target/release/flockeye
    let folders = own.ancestors().skip(1).take(2);
    let path = folders.map(|folder| folder.join("flockeye")).find(|path| path.exists());
    path.unwrap_or_else(|| panic!("no flockeye near {}: build the workspace first", own.display()))
}

/// A name that is unique among all tests in all processes.
pub fn unique(name: &str) -> String {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    format!("t{}-{count}-{name}", std::process::id())
}

/// A folder that is removed when the value is dropped.
#[derive(Debug)]
pub struct Scratch(PathBuf);

impl Scratch {
    /// A new, empty folder.
    pub fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("flockeye-test-{}", unique(name)));
        std::fs::create_dir_all(&path).expect("a temporary folder can be made");
        Self(path)
    }

    /// A path in it.
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // An error is ignored: the system cleans up temporary folders.
        drop(std::fs::remove_dir_all(&self.0));
    }
}

/// Settings of a small simulated flight for any machine: 1024x512, with one near neighbour.
pub const SMALL_FLIGHT: &[&str] = &[
    "camera.width=1024",
    "camera.height=512",
    "simulator.distance_m=[0.45, 0.6]",
    "simulator.yaw_deg_s=5",
    "gateway.enabled=false",
];

/// Text in the output once the neighbour is tracked.
pub const POSES_FLOW: &str = "alpha confirmed";

/// The settings of a small flight, and more.
pub fn small_flight<'a>(more: &[&'a str]) -> Vec<&'a str> {
    SMALL_FLIGHT.iter().chain(more).copied().collect()
}

/// `flockeye up` in a process of its own.
pub struct Flight {
    /// Its instance.
    pub instance: Instance,
    child: Child,
    output: Arc<Mutex<Vec<String>>>,
    collectors: Vec<JoinHandle<()>>,
}

impl Flight {
    /// Starts `flockeye up` under a unique instance name, with these arguments and `--set`s.
    pub fn start(name: &str, arguments: &[&str], set: &[&str]) -> Self {
        Self::start_as(&unique(name), arguments, set)
    }

    /// Starts a flight like [`Flight::start`], and waits until the neighbour is tracked.
    pub fn with_poses(name: &str, arguments: &[&str], set: &[&str]) -> Self {
        let mut flight = Self::start(name, arguments, set);
        flight.wait_for(POSES_FLOW);
        flight
    }

    /// Starts a flight like [`Flight::start`], under a given instance name.
    pub fn start_as(instance: &str, arguments: &[&str], set: &[&str]) -> Self {
        let mut command = Command::new(flockeye());
        command.arg("up").args(arguments);
        for assignment in set {
            command.args(["--set", assignment]);
        }
        command.args(["--set", &format!("instance={instance}")]);
        Self::launch(instance, command)
    }

    /// Starts `command` as the launcher of an instance.
    pub fn launch(instance: &str, mut command: Command) -> Self {
        // This folder has no pipeline.yaml, so the defaults are used.
        command.current_dir(std::env::temp_dir());
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("flockeye can be started");
        let output = Arc::new(Mutex::new(Vec::new()));
        let collectors = vec![
            collect(child.stdout.take().expect("it is piped"), output.clone()),
            collect(child.stderr.take().expect("it is piped"), output.clone()),
        ];
        Self { instance: Instance::named(instance), child, output, collectors }
    }

    /// Process number of the launcher.
    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Everything written so far.
    pub fn output(&self) -> String {
        self.output.lock().unwrap_or_else(PoisonError::into_inner).join("\n")
    }

    /// Waits until the output contains `text`.
    pub fn wait_for(&mut self, text: &str) {
        let start = Instant::now();
        while !self.output().contains(text) {
            let ended = self.child.try_wait().expect("it is our child");
            assert!(
                start.elapsed() < WATCHDOG
                    && (ended.is_none() || self.settled_output().contains(text)),
                "waited for {text:?} in vain:\n{}",
                self.output()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The output after the last lines have arrived.
    fn settled_output(&self) -> String {
        self.settle();
        self.output()
    }

    /// Waits for the last lines of a process that has ended.
    fn settle(&self) {
        let start = Instant::now();
        // A remaining child process may still hold the pipe, so the wait has a timeout.
        while !self.collectors.iter().all(JoinHandle::is_finished)
            && start.elapsed() < Duration::from_secs(5)
        {
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Process numbers of the stages of this instance, by the name of their program.
    pub fn stages(&self, program: &str) -> Vec<Pid> {
        let folder = self.instance.folder().to_string_lossy().into_owned();
        let wanted = format!("FLOCKEYE_INSTANCE_DIR={folder}\0");
        let entries = std::fs::read_dir("/proc").expect("there is /proc").flatten();
        entries
            .filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok())
            .filter(|pid| {
                let file =
                    |name: &str| std::fs::read(format!("/proc/{pid}/{name}")).unwrap_or_default();
                let command = file("cmdline");
                let first = command.split(|&byte| byte == 0).next().unwrap_or_default();
                let first = String::from_utf8_lossy(first).into_owned();
                let environment = file("environ");
                first.ends_with(program) && String::from_utf8_lossy(&environment).contains(&wanted)
            })
            .filter_map(Pid::from_raw)
            .collect()
    }

    /// Sends the launcher a signal.
    pub fn signal(&self, signal: Signal) {
        kill_process(self.pid(), signal).expect("the launcher can be signalled");
    }

    /// Whether the process has ended.
    pub fn has_ended(&mut self) -> bool {
        self.child.try_wait().expect("it is our child").is_some()
    }

    /// Waits for the end.
    pub fn wait(&mut self) -> ExitStatus {
        self.wait_for_end(WATCHDOG)
    }

    /// Waits for the end, with a timeout for long flights.
    pub fn wait_for_end(&mut self, watchdog: Duration) -> ExitStatus {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("it is our child") {
                self.settle();
                return status;
            }
            if start.elapsed() > watchdog {
                self.signal(Signal::KILL);
                panic!("the pipeline does not end:\n{}", self.output());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Waits for the end, which must be successful and leave nothing.
    #[track_caller]
    pub fn assert_ends_well(&mut self) {
        assert!(self.wait().success(), "{}", self.output());
        self.assert_nothing_left();
    }

    /// Sends the launcher a signal, which must end the pipeline successfully.
    #[track_caller]
    pub fn end_by(&mut self, signal: Signal) {
        self.signal(signal);
        self.assert_ends_well();
    }

    /// Runs a command of `flockeye` on this instance. Returns whether it succeeded, and its output.
    pub fn ask(&self, arguments: &[&str]) -> (bool, String) {
        ask(self.instance.name(), arguments)
    }

    /// Ends the pipeline by `flockeye stop`.
    #[track_caller]
    pub fn stop(mut self) {
        let (succeeded, output) = self.ask(&["stop"]);
        assert!(succeeded && output.contains("the pipeline ends"), "{output}");
        self.assert_ends_well();
    }

    /// Fails if the instance left a file in shared memory or in its folder.
    #[track_caller]
    pub fn assert_nothing_left(&self) {
        let left = self.instance.shared_memory();
        assert!(left.is_empty(), "left in /dev/shm: {left:?}\n{}", self.output());
        assert!(!self.instance.folder().exists(), "{} is left", self.instance.folder().display());
    }
}

impl Drop for Flight {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            // After a failed test the launcher is killed, which ends all stages, and its files are
            // removed.
            drop(self.child.kill());
            drop(self.child.wait());
            for stage in self.stages("") {
                kill_process(stage, Signal::KILL).ok();
            }
            let start = Instant::now();
            while !self.stages("").is_empty() && start.elapsed() < Duration::from_secs(5) {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        if self.instance.folder().exists() {
            drop(self.instance.take());
        }
    }
}

/// A process that is killed when the value is dropped, also if the test fails.
#[derive(Debug)]
pub struct Beside(Child);

impl Beside {
    /// Starts it.
    pub fn start(mut command: Command) -> Self {
        Self(command.stdin(Stdio::null()).spawn().expect("it can be started"))
    }

    /// Whether the process has ended by itself.
    pub fn has_ended(&mut self) -> bool {
        !matches!(self.0.try_wait(), Ok(None))
    }

    /// Kills it now.
    pub fn kill(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Runs `flockeye` with these arguments to its end. Returns whether it succeeded, and its output.
pub fn run(arguments: &[&str]) -> (bool, String) {
    let mut command = Command::new(flockeye());
    command.args(arguments);
    let mut flight = Flight::launch(&unique("run"), command);
    let status = flight.wait();
    (status.success(), flight.output())
}

/// User and system time of a process, clock ticks.
pub fn ticks_of(pid: u32) -> anyhow::Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat"))?;
    // Fields after the name, which may contain blanks. User and system time are the 12th and 13th.
    let fields = stat.rsplit_once(')').context("no such line")?.1;
    let ticks = fields.split_whitespace().skip(11).take(2).map(str::parse::<f64>);
    Ok(ticks.sum::<Result<f64, _>>()?)
}

/// Runs a command of `flockeye` on an instance. Returns whether it succeeded, and its output.
pub fn ask(instance: &str, arguments: &[&str]) -> (bool, String) {
    let (command, rest) = arguments.split_first().expect("a command");
    run(&[&[*command, "--instance", instance], rest].concat())
}

/// Runs `flockeye` with these arguments, which must succeed, and returns its output.
#[track_caller]
pub fn succeeds(arguments: &[&str]) -> String {
    let (succeeded, output) = run(arguments);
    assert!(succeeded, "{output}");
    output
}

fn collect(stream: impl Read + Send + 'static, lines: Arc<Mutex<Vec<String>>>) -> JoinHandle<()> {
    std::thread::spawn(move || {
        for line in BufReader::new(stream).split(b'\n').map_while(Result::ok) {
            let text = String::from_utf8_lossy(&line).into_owned();
            lines.lock().unwrap_or_else(PoisonError::into_inner).push(text);
        }
    })
}
