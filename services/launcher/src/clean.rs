//! `flockeye clean`: removes what dead runs left in shared memory. Running pipelines are not
//! touched.

use anyhow::Context;
use flockeye_cli::Screen;
use flockeye_runtime::instance::{Instance, InstanceError};

/// Removes the files of dead runs, and lists them.
pub(crate) fn run(name: Option<&str>) -> anyhow::Result<()> {
    let instances = match name {
        Some(name) => {
            let all = Instance::all();
            let names = all.iter().map(Instance::name).collect::<Vec<_>>().join(", ");
            let known = if names.is_empty() { "there is none".to_owned() } else { names };
            let found = all.into_iter().find(|instance| instance.name() == name);
            vec![found.with_context(|| format!("no pipeline '{name}' left files here: {known}"))?]
        }
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
            Err(error @ InstanceError::Kept { .. }) => {
                screen.line(&format!("{}: left alone: {error}", instance.name()))
            }
            Err(error) => return Err(error.into()),
        }
    }
    if removed == 0 {
        screen.line("nothing to remove");
    }
    Ok(())
}
