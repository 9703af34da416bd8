//! `flockeye bodies`: the configured marker bodies.

use flockeye_cli::text_table::TextTable;
use flockeye_cli::{Configuration, Screen};
use flockeye_config::Resolved;
use flockeye_runtime::resolved_file;

pub(crate) fn run(configuration: &Configuration, json: bool) -> anyhow::Result<()> {
    let resolved = Resolved::of(configuration.load()?)?;
    let mut screen = Screen::new();
    if json {
        screen.line(&serde_json::to_string_pretty(&resolved_file::bodies(&resolved))?);
        return Ok(());
    }
    let mut table = TextTable::new(
        2,
        &["body", "markers", "target", "first id", "last id", "smallest side m", "facets"],
    );
    for (target, body) in resolved.bodies.iter().enumerate() {
        let ids = body.markers.iter().map(|marker| marker.id);
        let side_m = body.markers.iter().map(|marker| marker.side()).fold(f64::MAX, f64::min);
        table.row([
            body.name.clone(),
            body.markers.len().to_string(),
            target.to_string(),
            ids.clone().min().unwrap_or_default().to_string(),
            ids.max().unwrap_or_default().to_string(),
            format!("{side_m:.4}"),
            body.facets().len().to_string(),
        ]);
    }
    screen.line(&format!("dictionary {}", resolved.bodies.dictionary));
    screen.table(&table.text());
    Ok(())
}
