//! Measures how soon two drones receive each other's reports after a cut of the radio: `radio-cuts
//! [COUNT] [SECONDS]` prints a table.
//!
//! Before each cut the radio loses 20 % of the packets and delays the others by 100 to 150 ms.
//! After the cut it is clear, or as bad as before.

use std::time::Duration;

use anyhow::Context;
use flockeye_geometry::statistics::median;
use flockeye_tests::air::{Air, Weather};
use flockeye_tests::drone::{cut, end, pair};
use flockeye_tests::unique;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let count = arguments.next().map_or(Ok(20), |text| text.parse())?;
    let seconds = arguments.next().map_or(Ok(30), |text| text.parse())?;
    let air = Air::between(2).context("network namespaces are needed")?;
    let drones = pair(&air, &unique("cuts"));
    let mut lines = Vec::new();
    for (name, after) in [("clear", Weather::CLEAR), ("as bad as before", Weather::BAD)] {
        let recoveries: Vec<_> =
            (0..count).map(|_| cut(&air, &drones, Duration::from_secs(seconds), after)).collect();
        let mut heard: Vec<f64> =
            recoveries.iter().map(|recovery| recovery.heard_after.as_secs_f64()).collect();
        heard.sort_by(f64::total_cmp);
        let worst = heard.last().copied().unwrap_or(f64::NAN);
        let pauses = recoveries.iter().map(|recovery| recovery.fusion_pause);
        lines.push(format!(
            "{name:<20} {count:>4} {:>14.2} {worst:>13.2} {:>28.0}",
            median(&heard).unwrap_or(f64::NAN),
            pauses.max().unwrap_or_default().as_secs_f64() * 1e3,
        ));
    }
    end(drones);
    println!(
        "radio after the cut  cuts  heard after: median s    worst s   longest pause of fusion, ms"
    );
    lines.iter().for_each(|line| println!("{line}"));
    Ok(())
}
