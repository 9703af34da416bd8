//! Shared helpers of tests: optional resources of a machine (the reference recordings, a Vulkan
//! device), and sockets of the [`loopback`] interface.
//!
//! A test prints a message and skips if its resource is absent.
//! `FLOCKEYE_REQUIRE=recordings,vulkan` lists required resources. If one of them is absent, the
//! test fails instead of skipping. Other names are:
//!
//! - `namespaces`: mount namespaces
//! - `radio`: network namespaces with /dev/net/tun
//! - `python`, `c`: tools for stages in these languages
//! - `browser`: Chromium
//! - `fault-points`: a launcher that was built with them

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

pub mod loopback;
pub mod python;

/// The environment variable with the required resources, separated by commas.
pub const REQUIRE: &str = "FLOCKEYE_REQUIRE";

/// The name of the reference recordings in [`REQUIRE`].
pub const RECORDINGS: &str = "recordings";
/// The name of a Vulkan device in [`REQUIRE`], hardware or software.
pub const VULKAN: &str = "vulkan";

/// The name of Python with the package of `clients/python` in [`REQUIRE`].
pub const PYTHON: &str = "python";

/// The environment variable that names the folder of the reference recordings. A relative path
/// begins at the repository; left out: [`DEFAULT_DATA`].
pub const DATA: &str = "FLOCKEYE_DATA";

/// The default of [`DATA`].
pub const DEFAULT_DATA: &str = "../shared/data";

/// The folder of the reference recordings. If it is absent, prints a message and returns `None`;
/// the test then ends.
///
/// # Panics
/// The folder is absent but required by [`REQUIRE`], or the folder in [`DATA`] does not exist.
pub fn recordings() -> Option<PathBuf> {
    let named = std::env::var_os(DATA).filter(|named| !named.is_empty());
    let folder = data_folder(named.as_deref());
    if folder.is_dir() {
        return Some(folder);
    }
    let shown = folder.display();
    assert!(
        named.is_none(),
        "{DATA} names {shown}, which is no folder. Cure: name another one, or unset it"
    );
    absent(RECORDINGS, &format!("the reference recordings, {shown} (set {DATA} to their folder)"));
    None
}

fn data_folder(named: Option<&OsStr>) -> PathBuf {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    // An absolute path stays as it is.
    repository.join(named.unwrap_or(OsStr::new(DEFAULT_DATA)))
}

/// Prints that a test skips because `what` is absent.
///
/// # Panics
/// [`REQUIRE`] contains `name`.
pub fn absent(name: &str, what: &str) {
    let required = std::env::var(REQUIRE).unwrap_or_default();
    assert!(!has(&required, name), "{what}: absent, but {REQUIRE} names '{name}'");
    println!("SKIPPED, absent: {what}");
}

fn has(required: &str, name: &str) -> bool {
    required.split(',').any(|required| required.trim() == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_lie_where_the_variable_says_or_beside_the_repository() {
        let folder = |named: Option<&str>| data_folder(named.map(OsStr::new));
        assert_eq!(folder(Some("/srv/flights")), Path::new("/srv/flights"));
        assert!(folder(Some("flights")).ends_with("tests/require/../../flights"));
        assert!(folder(None).ends_with("tests/require/../../../shared/data"));
    }

    #[test]
    fn names_are_separated_by_commas() {
        assert!(has("recordings,vulkan", VULKAN) && has(" vulkan ", VULKAN));
        assert!(!has("", VULKAN) && !has("vulkan2", VULKAN));
    }
}
