//! `flockeye clean`: removes what dead runs left in shared memory. Living ones are left alone.

use flockeye_runtime::instance::{Instance, InstanceError};

use crate::cli::Clean;

/// Removes it, and says what.
///
/// # Errors
/// The files cannot be removed.
pub fn run(arguments: &Clean) -> anyhow::Result<()> {
    let instances = match &arguments.instance {
        Some(name) => vec![Instance::named(name)],
        None => Instance::all(),
    };
    let mut removed = 0;
    for instance in instances {
        let files = instance.shared_memory().len();
        match instance.take() {
            Ok(ownership) => {
                drop(ownership);
                removed += 1;
                println!("{}: removed, with {files} files of shared memory", instance.name());
            }
            Err(InstanceError::Taken { name, pid }) => {
                println!("{name}: running (process {pid}), left alone")
            }
            Err(error) => return Err(error.into()),
        }
    }
    if removed == 0 {
        println!("nothing to remove");
    }
    Ok(())
}
