//! `flockeye schema`: the JSON Schema of pipeline.yaml, for editors.

use flockeye_cli::Screen;

/// Prints it.
///
/// # Errors
/// The schema cannot be written as JSON.
pub(crate) fn run() -> anyhow::Result<()> {
    let schema = serde_json::to_string_pretty(&flockeye_config::json_schema())?;
    Screen::new().line(&schema);
    Ok(())
}
