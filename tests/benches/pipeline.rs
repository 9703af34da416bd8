//! Measures the default pipeline in 20 seconds of the default simulated flight, with the processor
//! time of each stage.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use flockeye_contract::{Health, Healths};
use flockeye_tests::Flight;
use flockeye_tests::onlooker::{join, subscribe};

/// Timeout for start, flight and end on a loaded machine.
const WATCHDOG: Duration = Duration::from_secs(180);

fn main() {
    let load = load_average();
    let mut flight = Flight::start("bench", &["--for", "20s"], &["gateway.enabled=false"]);
    let mut ports = join(&mut flight);
    let mut healths = subscribe::<Healths>(&mut flight, &mut ports);
    // Each process's first report once frames flow, and its last.
    let mut reports: BTreeMap<(String, u32), (Health, Health)> = BTreeMap::new();
    let start = Instant::now();
    let outcome = ports.attend(|| {
        while let Some(message) = healths.receive()? {
            let health = message.header;
            if health.taken + health.published > 0 {
                let key = (health.stage.to_string(), health.replica);
                reports.entry(key).or_insert((health, health)).1 = health;
            }
        }
        let is_over = flight.has_ended() || start.elapsed() > WATCHDOG;
        Ok((!is_over).then_some(Duration::from_millis(100)))
    });
    outcome.expect("messages can be waited for");
    drop((healths, ports));
    let status = flight.wait();
    let output = flight.output();
    assert!(status.success(), "{output}");

    let summary = output.lines().skip_while(|line| !line.contains("frames searched"));
    println!("\n20 s of the default simulated flight in real time");
    summary.for_each(|line| println!("{line}"));
    println!(
        "\n{:<16} {:>8} {:>8} {:>8} {:>11} {:>9}",
        "stage", "in/s", "out/s", "dropped", "processor", "MB"
    );
    let mut sum = 0.0;
    for ((stage, replica), (first, last)) in &reports {
        let seconds = (last.sent_ns - first.sent_ns) as f64 * 1e-9;
        let rate = |of: fn(&Health) -> u64| (of(last) - of(first)) as f64 / seconds;
        let share = rate(|health| health.processor_ns) * 1e-9;
        sum += share;
        println!(
            "{:<16} {:>8.1} {:>8.1} {:>8} {:>9.1} % {:>9.1}",
            format!("{stage}.{replica}"),
            rate(|health| health.taken),
            rate(|health| health.published),
            last.dropped,
            share * 100.0,
            last.resident_bytes as f64 / 1e6
        );
    }
    println!("{:<16} {:>8} {:>8} {:>8} {:>9.1} %", "all", "", "", "", sum * 100.0);
    println!("\n100 % is one core of {}; {}", cores(), load);
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// The load of the machine, because results of a busy machine are not comparable.
fn load_average() -> String {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load: Vec<&str> = text.split_whitespace().take(3).collect();
    format!("load average before it began: {}", load.join(" "))
}
