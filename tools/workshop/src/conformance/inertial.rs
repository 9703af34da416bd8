//! Test of an inertial stage: its samples, while its own source sends them.

use std::time::{Duration, Instant};

use flockeye_config::Resolved;
use flockeye_contract::Imus;
use flockeye_runtime::clock;
use nalgebra::Vector3;

use super::bench::Bench;

const PAGE: &str = "Inertial sensor (to imu)";

/// Samples of one test.
const SAMPLES: usize = 200;
/// Timeout for each further message.
const PATIENCE: Duration = Duration::from_secs(2);
/// Largest difference of a sample's time from the present time, nanoseconds. A larger one means a
/// wrong clock.
const NEAR_NS: i64 = 1_000_000_000;

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let first = Duration::from_secs_f64(resolved.pipeline.supervision.start_s);
    let mut imus = bench.ports.subscriber::<Imus>()?;
    let (mut last, mut begun) = (None, None);
    let (mut periods_ms, mut delays_ms, mut forces) = (Vec::new(), Vec::new(), Vec::new());
    while forces.len() < SAMPLES {
        let patience = if last.is_none() { first } else { PATIENCE };
        let what = "messages pass the contract's check";
        let Some((header, samples)) = bench.next(&mut imus, what, patience)? else { break };
        begun.get_or_insert_with(Instant::now);
        let now_ns = clock::monotonic_ns();
        bench.report.field("messages say whose they are", PAGE, "generation", header.generation, 0);
        for sample in samples {
            if let Some((epoch, at_ns)) = last.replace((header.epoch, sample.at_ns)) {
                let rises = (header.epoch, sample.at_ns) > (epoch, at_ns);
                bench.report.holds(
                    "each sample comes once, in the order of time",
                    PAGE,
                    rises,
                    || {
                        format!(
                            "at_ns {} of epoch {} came after {at_ns} of {epoch}",
                            sample.at_ns, header.epoch
                        )
                    },
                );
                if epoch == header.epoch {
                    periods_ms.push((sample.at_ns - at_ns) as f64 * 1e-6);
                }
            }
            let is_near = (now_ns - sample.at_ns).abs() < NEAR_NS;
            bench.report.holds("times are of CLOCK_MONOTONIC", PAGE, is_near, || {
                format!("at_ns is {} where the clock says {now_ns}", sample.at_ns)
            });
            delays_ms.push((now_ns - sample.at_ns) as f64 * 1e-6);
            forces.push(Vector3::from(sample.specific_force).norm());
        }
    }
    bench.report.holds("samples come", PAGE, forces.len() >= SAMPLES, || {
        format!(
            "{} came, then none in {} s. Does the sensor send?",
            forces.len(),
            PATIENCE.as_secs()
        )
    });
    let seconds = begun.map_or(f64::NAN, |begun| begun.elapsed().as_secs_f64());
    let longest_ms = periods_ms.into_iter().fold(f64::NAN, f64::max);
    bench.report.figure("samples", forces.len() as f64 / seconds, "per second");
    bench.report.figure("longest gap", longest_ms, "ms");
    bench.report.median("from the sample to here, median", delays_ms, "ms");
    bench.report.median("specific force, median", forces, "m/s^2 (9.8 at rest)");
    Ok(())
}
