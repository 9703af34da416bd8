//! `flockeye markers`: a body's facets on paper at true scale, to print, cut out and glue.

mod layout;
mod page;
mod pdf;
mod piece;
mod svg;

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use flockeye_cli::{Configuration, Screen};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::Body;

use page::{Paper, PaperDrawing};

/// Arguments of `markers`.
#[derive(Debug, Args)]
pub(crate) struct MarkersArguments {
    /// Which configuration: the bodies and their dictionary are taken from it.
    #[command(flatten)]
    pub configuration: Configuration,
    /// The body whose facets are drawn.
    #[arg(long, value_name = "NAME")]
    pub body: String,
    /// The sheets: one PDF, or an SVG for each sheet.
    #[arg(long, value_name = "FILE.pdf|.svg")]
    pub out: PathBuf,
    /// Size of the sheets.
    #[arg(long, default_value = "a4")]
    pub paper: Paper,
}

/// Writes the sheets.
///
/// # Errors
/// The configuration is wrong, the body is unknown, a facet is larger than the paper, or a file
/// cannot be written.
pub(crate) fn run(arguments: &MarkersArguments) -> anyhow::Result<()> {
    let bodies = flockeye_config::bodies(&arguments.configuration.load()?.bodies)?;
    let dictionary = Dictionary::of(&bodies)?;
    let body = bodies.iter().find(|body| body.name == arguments.body).with_context(|| {
        let names: Vec<_> = bodies.iter().map(|body| body.name.as_str()).collect();
        format!("there is no body '{}'; there are {}", arguments.body, names.join(", "))
    })?;
    let pages = sheets(body, &dictionary, arguments.paper)?;
    let path = &arguments.out;
    let mut screen = Screen::new();
    let mut write = |path: &Path, bytes: &[u8]| {
        std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
        screen.line(&path.display().to_string());
        anyhow::Ok(())
    };
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("pdf") => write(path, &pdf::document(&pages))?,
        // An SVG file holds one page.
        Some("svg") if pages.len() == 1 => write(path, svg::document(&pages[0]).as_bytes())?,
        Some("svg") => {
            for (index, page) in pages.iter().enumerate() {
                write(&numbered(path, index + 1), svg::document(page).as_bytes())?;
            }
        }
        _ => anyhow::bail!("{} must end in .pdf or .svg", path.display()),
    }
    screen.line(&format!("{} sheets: print them at 100 %, and check the ruler", pages.len()));
    Ok(())
}

/// `alpha.svg` as `alpha-2.svg`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}-{number}.svg"))
}

/// The sheets of a body, with each facet once. Facets with markers are first.
fn sheets(body: &Body, dictionary: &Dictionary, paper: Paper) -> anyhow::Result<Vec<PaperDrawing>> {
    let pieces: anyhow::Result<Vec<_>> =
        body.facets().iter().map(|facet| piece::piece(facet, body, dictionary)).collect();
    let sides = body.markers.iter().map(|marker| marker.side());
    let smallest = sides.clone().fold(f64::INFINITY, f64::min);
    let sizes = match body.largest_side() {
        largest if largest - smallest < 1e-6 => format!("{:.3} mm", largest * 1e3),
        largest => format!("{:.3} and {:.3} mm", largest * 1e3, smallest * 1e3),
    };
    let title = format!(
        "{}: {} markers of {}, black squares of {sizes}, {} facets",
        body.name,
        body.markers.len(),
        dictionary.name(),
        body.facets().len()
    );
    layout::pages(&pieces?, &title, paper)
}
