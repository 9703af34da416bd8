//! Instances: folder, shared memory and owner of each pipeline.
//!
//! Each instance has its own folder and its own prefix in /dev/shm. The folder holds the resolved
//! configuration, iceoryx2's files and a lock. Instances, tests and leftovers of dead runs never
//! share a name.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use anyhow::{Context, anyhow};
use iceoryx2::prelude::*;
use rustix::fs::{FlockOperation, flock};

use flockeye_config::{ConfigError, FLOW, Pipeline, RESOLVED, Resolved, is_instance_name};

use crate::kept::{self, KeptProcess};
use crate::resolved_file;
use crate::whole_file::write_whole;

/// Environment variable with the instance's folder; every stage gets it.
pub const FOLDER_VARIABLE: &str = "FLOCKEYE_INSTANCE_DIR";
/// Environment variable with the stage's name.
pub const STAGE_VARIABLE: &str = "FLOCKEYE_STAGE";
/// Environment variable with the number of the worker, from 0.
pub const REPLICA_VARIABLE: &str = "FLOCKEYE_REPLICA";
/// Environment variable with the number of times the process was replaced.
pub const GENERATION_VARIABLE: &str = "FLOCKEYE_GENERATION";

const SHM_FOLDER: &str = "/dev/shm";

/// `RuntimeDirectory=` of the unit.
const SERVICE_FOLDER: &str = "/run/flockeye";

/// Bytes of a socket's path (unix(7), without the zero at its end).
const LONGEST_SOCKET_PATH: usize = 107;

/// Bytes that iceoryx2 adds to a prefix for a socket's name: a number of up to 33 digits, `.event`.
const SOCKET_NAME: usize = 39;

/// Error of taking or reading an instance.
#[expect(missing_docs, reason = "the texts name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum InstanceError {
    /// Another pipeline uses the name.
    #[error(
        "a pipeline called '{name}' is running already (process {pid}). Cure: stop it, or give this \
         one another name with --set instance=NAME"
    )]
    Taken { name: String, pid: String },
    /// Its launcher has ended, and its stages fly on.
    #[error(
        "the stages of '{name}' fly on without a launcher ({pids}). Cure: `flockeye up --keep` takes them \
         over, `flockeye stop --instance {name}` ends them"
    )]
    Kept { name: String, pids: String },
    /// The name would not lead to a folder of its own.
    #[error("'{name}' cannot be an instance's name: use 1 to 31 letters, digits, '-' and '_'")]
    Name { name: String },
    /// A file of the instance cannot be read or written.
    #[error("{path}: {error}")]
    File { path: PathBuf, error: io::Error },
    /// The folder's path is too long or has characters that iceoryx2 does not accept.
    #[error(
        "iceoryx2 cannot keep its files in {path}; set TMPDIR to a short, plain path, or shorten the \
         instance's name"
    )]
    Path { path: PathBuf },
    /// The folder is not this user's alone: others could put their own sockets and settings there.
    #[error(
        "{path} belongs to user {owner} and has mode {mode:o}: others can write to it. Cure: remove it, \
         or set TMPDIR to a folder of your own"
    )]
    Foreign { path: PathBuf, owner: u32, mode: u32 },
    /// The launcher's files are missing.
    #[error(
        "{FOLDER_VARIABLE} is not set: stages are started by `flockeye up`, or by hand with the \
         folder of a running instance in it"
    )]
    NoFolder,
    /// The resolved configuration cannot be read back.
    #[error("{path} is not the configuration of this version: {error}")]
    Resolved { path: PathBuf, error: ConfigError },
}

/// A pipeline on this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Instance {
    name: String,
    folder: PathBuf,
}

impl Instance {
    /// The instance of this name; nothing is created yet.
    pub fn named(name: &str) -> Self {
        Self { name: name.to_owned(), folder: all_folder().join(name) }
    }

    /// The instance of which this process is a stage.
    ///
    /// # Errors
    /// [`InstanceError::NoFolder`] where the launcher's variable is missing.
    pub(crate) fn of_this_process() -> Result<Self, InstanceError> {
        let folder = std::env::var_os(FOLDER_VARIABLE).ok_or(InstanceError::NoFolder)?;
        let folder = PathBuf::from(folder);
        let name = folder.file_name().map(|name| name.to_string_lossy().into_owned());
        Ok(Self { name: name.ok_or(InstanceError::NoFolder)?, folder })
    }

    /// All instances with files on this machine.
    pub fn all() -> Vec<Self> {
        let entries = std::fs::read_dir(all_folder()).into_iter().flatten().flatten();
        let mut names: Vec<_> =
            entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names.iter().map(|name| Self::named(name)).collect()
    }

    /// Whether a launcher owns it, or its stages fly on without one.
    pub fn is_running(&self) -> bool {
        self.has_launcher() || !kept::living(&self.folder).is_empty()
    }

    /// Whether a living launcher owns it.
    pub fn has_launcher(&self) -> bool {
        // Only the owner keeps the lock for longer than this check.
        File::open(self.folder.join("lock"))
            .is_ok_and(|lock| flock(&lock, FlockOperation::NonBlockingLockShared).is_err())
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Prefix of the names of its shared memory.
    ///
    /// It is a digest of the folder's path, which contains the user's number and the instance's
    /// name. All prefixes have the same length, for two reasons. A socket's path contains folder
    /// and prefix and has 107 bytes at most. No instance's prefix may be the beginning of
    /// another's.
    pub fn prefix(&self) -> String {
        // FNV-1a (Fowler, Noll, Vo), the same in every process and release.
        let bytes = self.folder.as_os_str().as_encoded_bytes();
        let digest = bytes.iter().fold(0x811c_9dc5_u32, |digest, &byte| {
            (digest ^ u32::from(byte)).wrapping_mul(0x0100_0193)
        });
        format!("flock_{digest:08x}_")
    }

    /// iceoryx2's configuration for it. Foreign stages get the same as a file
    /// (`iceoryx2.toml` in the folder).
    ///
    /// # Errors
    /// [`InstanceError::Path`] where the folder has no room for iceoryx2's files.
    pub fn iceoryx2(&self) -> Result<Config, InstanceError> {
        let bad_path = || InstanceError::Path { path: self.folder.clone() };
        let socket_path = self.folder.as_os_str().len() + 1 + self.prefix().len() + SOCKET_NAME;
        if socket_path > LONGEST_SOCKET_PATH {
            return Err(bad_path());
        }
        let mut config = Config::default();
        let root = iceoryx2::prelude::Path::new(self.folder.to_string_lossy().as_bytes());
        config.global.set_root_path(&root.map_err(|_| bad_path())?);
        config.global.prefix = FileName::new(self.prefix().as_bytes()).map_err(|_| bad_path())?;
        Ok(config)
    }

    /// A node of iceoryx2 in this instance. Where there is no room, or no permission, the error
    /// begins with `failure`.
    ///
    /// # Errors
    /// As [`Instance::iceoryx2`], or iceoryx2's reason.
    pub fn create_node(&self, name: &str, failure: &str) -> anyhow::Result<Rc<Node<ipc::Service>>> {
        let node = NodeBuilder::new()
            .name(&NodeName::new(name).context("node name")?)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .config(&self.iceoryx2()?)
            .create::<ipc::Service>()
            .map_err(|error| anyhow!("{failure}: {error:?}"))?;
        Ok(Rc::new(node))
    }

    /// Takes the instance for this process and clears what a dead run left behind.
    ///
    /// # Errors
    /// [`InstanceError::Taken`] if a running process has it, [`InstanceError::Kept`] if stages fly
    /// on in it; [`InstanceError::Name`] for a name that would lead to files of others.
    pub fn take(&self) -> Result<Ownership, InstanceError> {
        let (ownership, kept) = self.take_over()?;
        if kept.is_empty() {
            return Ok(ownership);
        }
        let living = kept.iter().filter(|process| process.is_alive(&self.folder));
        let pids: Vec<_> =
            living.map(|process| format!("{}: process {}", process.stage, process.pid)).collect();
        Err(InstanceError::Kept { name: self.name.clone(), pids: pids.join(", ") })
    }

    /// Takes the instance for this process, together with the stages that fly on in it. Without
    /// such stages, leftovers of a dead run are removed. With some, all recorded processes are
    /// returned, and nothing is removed.
    ///
    /// # Errors
    /// As [`Instance::take`], but for [`InstanceError::Kept`].
    pub fn take_over(&self) -> Result<(Ownership, Vec<KeptProcess>), InstanceError> {
        if !is_instance_name(&self.name) {
            return Err(InstanceError::Name { name: self.name.clone() });
        }
        let file_error = |path: &Path| {
            let path = path.to_owned();
            move |error| InstanceError::File { path, error }
        };
        for folder in [all_folder(), self.folder.clone()] {
            make_own(&folder)?;
        }
        let path = self.folder.join("lock");
        let mut lock = OpenOptions::new()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&path)
            .map_err(file_error(&path))?;
        if flock(&lock, FlockOperation::NonBlockingLockExclusive).is_err() {
            let mut pid = String::new();
            lock.read_to_string(&mut pid).map_err(file_error(&path))?;
            return Err(InstanceError::Taken {
                name: self.name.clone(),
                pid: pid.trim().to_owned(),
            });
        }
        let kept = match kept::living(&self.folder).is_empty() {
            true => {
                self.remove_leftovers().map_err(file_error(&self.folder))?;
                Vec::new()
            }
            false => kept::all(&self.folder),
        };
        lock.set_len(0)
            .and_then(|()| lock.rewind())
            .and_then(|()| writeln!(lock, "{}", std::process::id()))
            .map_err(file_error(&path))?;
        Ok((Ownership { instance: self.clone(), _lock: lock }, kept))
    }

    /// Writes the files that stages read at their start: the resolved configuration, and iceoryx2's
    /// for foreign stages.
    ///
    /// # Errors
    /// The files cannot be written.
    pub fn write_configuration(&self, resolved: &Resolved) -> Result<(), InstanceError> {
        let failed = |error: io::Error| InstanceError::File { path: self.pipeline_file(), error };
        let mut written =
            serde_json::to_value(&resolved.pipeline).map_err(|error| failed(error.into()))?;
        written[FLOW] = resolved.pipeline.flow().name().into();
        written[RESOLVED] = resolved_file::section(resolved);
        let json = serde_json::to_vec_pretty(&written).map_err(|error| failed(error.into()))?;
        // A stage that starts now reads the old file or the new one, and never half of it.
        write_whole(&self.pipeline_file(), &json).map_err(failed)?;
        let toml = format!(
            "# For stages in other languages: load this file as iceoryx2's global configuration.\n\
             [global]\nroot-path = {:?}\nprefix = {:?}\n",
            self.folder.to_string_lossy(),
            self.prefix()
        );
        let path = self.folder.join("iceoryx2.toml");
        std::fs::write(&path, toml).map_err(|error| InstanceError::File { path, error })
    }

    /// Reads the configuration that the launcher resolved.
    ///
    /// # Errors
    /// The file is not there or of another version.
    pub fn pipeline(&self) -> Result<Pipeline, InstanceError> {
        let path = self.pipeline_file();
        let json = std::fs::read(&path)
            .map_err(|error| InstanceError::File { path: path.clone(), error })?;
        Pipeline::from_json(&json).map_err(|error| InstanceError::Resolved { path, error })
    }

    fn pipeline_file(&self) -> PathBuf {
        self.folder.join("pipeline.json")
    }

    /// Files of this instance in /dev/shm.
    pub fn shared_memory(&self) -> Vec<PathBuf> {
        let prefix = self.prefix();
        let entries = std::fs::read_dir(SHM_FOLDER).into_iter().flatten().flatten();
        entries
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
            .map(|entry| entry.path())
            .collect()
    }

    /// Removes everything but the lock. Only the owner may call it.
    fn remove_leftovers(&self) -> io::Result<()> {
        for path in self.shared_memory() {
            ignore_missing(std::fs::remove_file(path))?;
        }
        for entry in std::fs::read_dir(&self.folder)?.flatten() {
            let path = entry.path();
            if entry.file_name() == "lock" {
                continue;
            }
            ignore_missing(if path.is_dir() {
                std::fs::remove_dir_all(&path)
            } else {
                std::fs::remove_file(&path)
            })?;
        }
        Ok(())
    }
}

/// Ownership of an instance, until it is dropped or the process dies. Dropping it removes all files
/// of the instance, unless stages fly on in it.
#[derive(Debug)]
pub struct Ownership {
    instance: Instance,
    _lock: File,
}

impl Drop for Ownership {
    fn drop(&mut self) {
        if !kept::living(&self.instance.folder).is_empty() {
            return;
        }
        if let Err(error) = self.instance.remove_leftovers() {
            tracing::warn!("leftovers in {}: {error}", self.instance.folder.display());
        }
        // The lock is removed last: until then the name is not free for others.
        if let Err(error) = std::fs::remove_dir_all(&self.instance.folder) {
            tracing::warn!("leftovers in {}: {error}", self.instance.folder.display());
        }
    }
}

/// Creates a folder for this user alone, or checks that it is one.
fn make_own(folder: &Path) -> Result<(), InstanceError> {
    let file_error = |error| InstanceError::File { path: folder.to_owned(), error };
    let mut builder = std::fs::DirBuilder::new();
    match builder.mode(0o700).create(folder) {
        Ok(()) => return Ok(()),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
        Err(error) => return Err(file_error(error)),
    }
    // A link would lead to a folder that another user chose.
    let found = std::fs::symlink_metadata(folder).map_err(file_error)?;
    let mode = found.mode() & 0o7777;
    let is_own = found.uid() == rustix::process::getuid().as_raw();
    if found.is_dir() && is_own && mode & 0o022 == 0 {
        return Ok(());
    }
    Err(InstanceError::Foreign { path: folder.to_owned(), owner: found.uid(), mode })
}

/// Folder of all instances of this user. For the service's user it is the folder that systemd
/// creates, so that tools find the service's pipeline.
fn all_folder() -> PathBuf {
    let user = rustix::process::getuid().as_raw();
    let base = match service_user() {
        Some(owner) if owner == user => PathBuf::from(SERVICE_FOLDER),
        _ => std::env::temp_dir(),
    };
    base.join(format!("flockeye-{user}"))
}

/// The user whose pipeline systemd runs here (deploy/systemd/flockeye.service), if it has been
/// started.
pub fn service_user() -> Option<u32> {
    let found = std::fs::symlink_metadata(SERVICE_FOLDER).ok()?;
    found.is_dir().then(|| found.uid())
}

fn ignore_missing(result: io::Result<()>) -> io::Result<()> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_leads_to_others_files_is_refused() {
        let folder = std::env::temp_dir().join(format!("not-flockeyes-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a temporary folder can be made");
        for name in ["..", ".", "", "a/b", &folder.to_string_lossy()] {
            let error = Instance::named(name).take().expect_err("refused");
            assert!(matches!(error, InstanceError::Name { .. }), "{name}: {error}");
        }
        assert!(folder.is_dir(), "it is still there");
        std::fs::remove_dir(&folder).expect("it is still empty");
        assert!(is_instance_name("drone-1_b"));
    }

    #[test]
    fn a_folder_that_others_can_write_to_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = std::env::temp_dir().join(format!("flock-open-{}", std::process::id()));
        make_own(&folder).expect("it is new");
        make_own(&folder).expect("it is this user's alone");
        std::fs::set_permissions(&folder, std::fs::Permissions::from_mode(0o777))
            .expect("it is this user's");
        let error = make_own(&folder).expect_err("others can write").to_string();
        assert!(error.contains("mode 777: others can write"), "{error}");
        std::fs::remove_dir(&folder).expect("it is empty");
        std::os::unix::fs::symlink(std::env::temp_dir(), &folder).expect("links can be made");
        assert!(matches!(make_own(&folder), Err(InstanceError::Foreign { .. })));
        std::fs::remove_file(&folder).expect("it is a link");
    }

    #[test]
    fn the_longest_name_leaves_room_for_sockets_and_a_long_folder_is_refused() {
        // As in /tmp of a user with a number of four digits.
        let long = "n".repeat(31);
        let folder = PathBuf::from(format!("/tmp/flockeye-1000/{long}"));
        let instance = Instance { name: long.clone(), folder };
        assert!(instance.iceoryx2().is_ok());
        let folder = PathBuf::from(format!("/tmp/some-folder-deep-down/flockeye-1000/{long}"));
        let error = Instance { name: long, folder }.iceoryx2().expect_err("too long");
        assert!(error.to_string().contains("set TMPDIR to a short"), "{error}");
    }

    #[test]
    fn no_instances_memory_is_anothers() {
        let [one, other] = ["a", "a_b"].map(|name| Instance::named(name).prefix());
        assert!(!other.starts_with(&one), "{one} {other}");
    }
}
