//! Golden tracks: the lossless poses of recordings and simulated flights, written from one commit
//! and compared with those of another.
//!
//! ```sh
//! make golden         # writes target/golden with this build
//! make golden-check   # flies the same with this build, and names the first row that differs
//! ```
//!
//! A change that only moves, renames or splits code keeps every row byte for byte. The column of
//! latencies is left out, because only it depends on time. Both builds should have the same profile
//! and run on the same machine.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

use anyhow::{Context as _, bail, ensure};
use flockeye_tests::{flockeye, recordings, unique};

/// Four bodies that differ in their markers' ids.
const FOUR_BODIES: &str = "bodies.list=[{name: alpha}, {name: bravo, first_id: 17}, \
     {name: charlie, first_id: 34}, {name: delta, first_id: 51}]";

/// A golden flight: its name and the arguments of `flockeye up`.
struct Flight {
    name: &'static str,
    /// Folder and file of a recording below `FLOCKEYE_DATA`; `None`: simulated.
    recording: Option<&'static str>,
    set: &'static [&'static str],
}

const FLIGHTS: &[Flight] = &[
    Flight { name: "flight1", recording: Some("flight1/flight1.mp4"), set: &[] },
    Flight { name: "flight4", recording: Some("flight4/flight4.mp4"), set: &[] },
    Flight { name: "stills", recording: Some("stills/images"), set: &["profile=stills"] },
    Flight {
        name: "one-neighbour",
        recording: None,
        set: &["simulator.seed=11", "simulator.frames=90"],
    },
    Flight {
        name: "four-neighbours",
        recording: None,
        set: &["simulator.seed=12", "simulator.frames=60", "simulator.neighbours=4", FOUR_BODIES],
    },
    Flight {
        name: "out-to-4-m",
        recording: None,
        set: &["simulator.seed=903", "simulator.frames=200", "simulator.distance_m=[0.6, 4.0]"],
    },
    Flight {
        name: "behind-airframes",
        recording: None,
        set: &[
            "simulator.seed=61",
            "simulator.frames=60",
            "bodies.list=[{name: alpha, preset: truncated}]",
        ],
    },
    Flight {
        name: "fast-yaw",
        recording: None,
        set: &["simulator.seed=15", "simulator.frames=60", "simulator.yaw_deg_s=80"],
    },
    Flight {
        name: "two-lenses-and-mounts",
        recording: None,
        set: &[
            "simulator.seed=16",
            "simulator.frames=60",
            "camera.lens_distance_m=0.016",
            "observer.observer_from_camera.position=[0.1, 0.0, 0.2]",
            "observer.observer_from_camera.orientation=[0.0, 0.0, 0.6, 0.8]",
        ],
    },
    Flight {
        name: "optimized-search",
        recording: None,
        set: &["simulator.seed=17", "simulator.frames=60", "search.mode=optimized"],
    },
    Flight {
        name: "corners-alone",
        recording: None,
        set: &["simulator.seed=18", "simulator.frames=60", "fusion.align=false"],
    },
];

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("golden: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let usage = "golden write|compare FOLDER [FLIGHT...]";
    let [action, folder, names @ ..] = arguments.as_slice() else { bail!("usage: {usage}") };
    let folder = Path::new(folder);
    let known: Vec<&str> = FLIGHTS.iter().map(|flight| flight.name).collect();
    for name in names {
        ensure!(known.contains(&name.as_str()), "no flight '{name}': there are {known:?}");
    }
    let is_wanted = |flight: &&Flight| names.is_empty() || names.iter().any(|n| n == flight.name);
    let mut different = 0;
    for flight in FLIGHTS.iter().filter(is_wanted) {
        let golden = folder.join(format!("{}.csv", flight.name));
        let Some(rows) = fly(flight)? else { continue };
        match action.as_str() {
            "write" => {
                std::fs::create_dir_all(folder).context("the golden folder")?;
                std::fs::write(&golden, rows.join("\n") + "\n")
                    .with_context(|| format!("cannot write {}", golden.display()))?;
                println!("{}: {} rows", flight.name, rows.len() - 1);
            }
            "compare" => {
                let before = std::fs::read_to_string(&golden).with_context(|| {
                    format!("cannot read {}. Cure: make golden", golden.display())
                })?;
                let before: Vec<String> = before.lines().map(str::to_owned).collect();
                match first_difference(&before, &rows) {
                    None => println!("{}: {} rows, the same", flight.name, rows.len() - 1),
                    Some(difference) => {
                        different += 1;
                        println!("{}: {difference}", flight.name);
                    }
                }
            }
            _ => bail!("usage: {usage}"),
        }
    }
    ensure!(different == 0, "{different} flights differ");
    Ok(())
}

/// Runs a flight without loss. Returns its poses as rows without the latency, or `None` if its
/// recording is absent.
fn fly(flight: &Flight) -> anyhow::Result<Option<Vec<String>>> {
    let poses = std::env::temp_dir().join(format!("{}.csv", unique(flight.name)));
    let mut command = Command::new(flockeye());
    command.current_dir(std::env::temp_dir());
    command.args(["up", "--profile", "repeat", "--poses"]).arg(&poses);
    if let Some(recording) = flight.recording {
        let Some(data) = recordings() else { return Ok(None) };
        let data: PathBuf = data.canonicalize().context("the recordings' folder")?;
        command.arg("--source").arg(data.join(recording));
        command.arg("--bodies").arg(data.join("bodies.json"));
    }
    let instance = format!("instance={}", unique("golden"));
    for assignment in flight.set.iter().copied().chain(["gateway.enabled=false", &instance]) {
        command.args(["--set", assignment]);
    }
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    let ended = command.output().context("cannot start flockeye")?;
    let said = String::from_utf8_lossy(&ended.stderr);
    ensure!(ended.status.success(), "{} did not end well:\n{said}", flight.name);
    let text = std::fs::read_to_string(&poses).context("the poses were not recorded")?;
    std::fs::remove_file(&poses).context("the recorded poses")?;
    without_latency(&text).map(Some)
}

/// The rows of a table of poses without their column `latency_ms`.
fn without_latency(text: &str) -> anyhow::Result<Vec<String>> {
    let header = text.lines().next().context("the table of poses is empty")?;
    let column = header.split(',').position(|name| name == "latency_ms");
    let column = column.context("the table of poses has no column latency_ms")?;
    let row = |line: &str| {
        let cells = line.split(',').enumerate().filter(|(number, _)| *number != column);
        cells.map(|(_, cell)| cell).collect::<Vec<_>>().join(",")
    };
    Ok(text.lines().map(row).collect())
}

/// The first difference between two tables, as text.
fn first_difference(before: &[String], now: &[String]) -> Option<String> {
    let row = before.iter().zip(now).position(|(before, now)| before != now);
    match row {
        Some(row) => {
            let is_changed = |row: usize| before[row] != now[row];
            let shared = before.len().min(now.len());
            let count = (row..shared).filter(|&row| is_changed(row)).count();
            Some(format!(
                "row {row} differs, and {count} of {shared} do\n  before {}\n  now    {}",
                before[row], now[row]
            ))
        }
        None if before.len() != now.len() => {
            Some(format!("{} rows before, {} now", before.len() - 1, now.len() - 1))
        }
        None => None,
    }
}
