//! Other programs of Flockeye: their paths and their commands.

use std::path::{Path, PathBuf};

use anyhow::Context;

/// A command of `flockeye` that another program runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CommandInfo {
    /// Its name on the command line.
    pub name: &'static str,
    /// Its description in one line.
    pub about: &'static str,
}

/// Finds a program beside the running one, else on the PATH.
///
/// # Errors
/// It is in neither place; the message contains the cure.
pub fn find(name: &str) -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe().context("cannot find the running program")?;
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = own.parent().map(Path::to_owned).into_iter().chain(std::env::split_paths(&path));
    let mut candidates = folders.map(|folder| folder.join(name));
    candidates.find(|candidate| candidate.is_file()).with_context(|| {
        format!(
            "the program {name} is neither beside {} nor on the PATH. Cure: build the whole \
             workspace (cargo build --release --workspace), or install {name} beside it",
            own.display()
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn programs_on_the_path_are_found_and_others_are_refused_with_the_cure() {
        assert!(find("sh").expect("every system has one").is_absolute());
        let error = find("flockeye-nonexistent").expect_err("there is none").to_string();
        assert!(error.contains("flockeye-nonexistent is neither beside"), "{error}");
        assert!(error.contains("Cure: build the whole workspace"), "{error}");
    }
}
