//! Programs in Python that tests run.

use std::path::PathBuf;
use std::process::{Child, Command};

/// Python that can import `packages`, separated by commas; `make python` makes it. Where it is
/// absent, says so and returns `None`; the test ends there.
///
/// # Panics
/// Where it is absent but [`REQUIRE`](crate::REQUIRE) names it.
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

/// A program that is killed when this is dropped, so that a failed test leaves none behind.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        self.0.kill().ok();
        self.0.wait().ok();
    }
}
