//! `flockeye clean`: removes what dead runs left in shared memory. Running pipelines are not touched.

use clap::Args;
use flockeye_cli::Screen;
use flockeye_runtime::instance::{Instance, InstanceError};

/// Arguments of `clean`.
#[derive(Debug, Args)]
pub struct CleanArguments {
    /// Only this instance.
    #[arg(long, value_name = "NAME")]
    pub instance: Option<String>,
}

/// Removes the files of dead runs, and lists them.
///
/// # Errors
/// The files cannot be removed.
pub fn run(arguments: &CleanArguments) -> anyhow::Result<()> {
    let instances = match &arguments.instance {
        Some(name) => vec![Instance::named(name)],
        None => Instance::all(),
    };
    let mut screen = Screen::new();
    let mut removed = 0;
    for instance in instances {
        let files = instance.shared_memory().len();
        match instance.take() {
            Ok(ownership) => {
                drop(ownership);
                removed += 1;
                screen.line(&format!(
                    "{}: removed, with {files} files of shared memory",
                    instance.name()
                ));
            }
            Err(InstanceError::Taken { name, pid }) => {
                screen.line(&format!("{name}: running (process {pid}), left alone"))
            }
            Err(error) => return Err(error.into()),
        }
    }
    if removed == 0 {
        screen.line("nothing to remove");
    }
    Ok(())
}
