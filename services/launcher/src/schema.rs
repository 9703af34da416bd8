//! `flockeye schema`: the JSON Schema of pipeline.yaml, for editors.

/// Prints it.
///
/// # Errors
/// Standard output is closed.
pub fn run() -> anyhow::Result<()> {
    println!("{}", serde_json::to_string_pretty(&flockeye_runtime::config::json_schema())?);
    Ok(())
}
