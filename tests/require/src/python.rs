//! Python programs for tests.

use std::path::PathBuf;
use std::process::{Child, Command};

/// A Python that can import `packages`, separated by commas; `make python` installs it. If it is
/// absent, prints a message and returns `None`; the test then ends.
///
/// # Panics
/// Python is absent but required by [`REQUIRE`](crate::REQUIRE).
pub fn python(packages: &str) -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    // target/PROFILE/deps/PROGRAM
    let python = program.ancestors().nth(3)?.join("python/bin/python");
    let has_packages = Command::new(&python)
        .args(["-c", &format!("import {packages}")])
        .env("GIT_PYTHON_REFRESH", "quiet")
        .output()
        .is_ok_and(|output| output.status.success());
    if has_packages {
        return Some(python);
    }
    let what = format!("target/python with {packages}, which `make python` makes");
    crate::absent(crate::PYTHON, &what);
    None
}

/// A program that is killed when the value is dropped, so that a failed test leaves no process.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        // An error is ignored: the program may have ended by itself.
        self.0.kill().ok();
        self.0.wait().ok();
    }
}
