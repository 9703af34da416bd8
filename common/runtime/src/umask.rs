//! The umask of a thread that binds sockets.

use std::sync::Mutex;

use rustix::thread::{UnshareFlags, unshare_unsafe};

use crate::lock::lock;

/// Runs `bind`, which changes the umask for a moment, as iceoryx2 does while it binds a listener's
/// socket.
///
/// All threads of a process share one umask. In that moment, files of another thread, or of a
/// process that it starts, would get fewer rights. Two threads that change and restore it at once
/// may even leave the wrong one for good. So the calling thread first gets its own umask, working
/// folder and root (unshare(2), `CLONE_FS`). Threads that it starts later share them again, until
/// the next call. Some containers refuse that. Then only one thread at a time changes the umask.
pub(crate) fn with_own_umask<T>(bind: impl FnOnce() -> T) -> T {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let _one = lock(&ONE_AT_A_TIME);
    // SAFETY: file descriptors stay shared. The call copies only this thread's umask, working
    // folder and root.
    if let Err(error) = unsafe { unshare_unsafe(UnshareFlags::FS) } {
        tracing::debug!("the umask stays the process's: {error}");
    }
    bind()
}
