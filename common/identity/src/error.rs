//! What can be wrong with keys, certificates and the roster.

use std::path::PathBuf;

use crate::certificate::CertificateFault;

/// What can be wrong with keys, certificates and the roster.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    /// A file cannot be read or written.
    #[error("{}: cannot {what} it: {source}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// What the system says.
        source: std::io::Error,
    },
    /// A private key that others can read.
    #[error(
        "{}: others can read this private key (mode {mode:03o}). Cure: chmod 600 {}, and issue another \
         if somebody may have read it",
        path.display(), path.display()
    )]
    Exposed {
        /// The key's file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// A file that does not hold what it should.
    #[error("{}: {reason}", path.display())]
    Content {
        /// Which.
        path: PathBuf,
        /// What is wrong, and the cure.
        reason: String,
    },
    /// A certificate that cannot be used.
    #[error("{}: {fault}", path.display())]
    Certificate {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        fault: CertificateFault,
    },
    /// A name that cannot be one.
    #[error("'{0}' is no name: letters, digits, '-', '_' or '.'")]
    Name(String),
    /// A swarm's authority is there already.
    #[error("{}: there is an authority already. Cure: another folder", .0.display())]
    Exists(PathBuf),
    /// A name whose revoked certificate still holds.
    #[error(
        "a certificate of '{name}' is revoked and holds for {hours} h: with it somebody could link as '{name}' again. \
         Cure: another name, or wait"
    )]
    Burnt {
        /// Which.
        name: String,
        /// Until it has expired.
        hours: i64,
    },
    /// The swarm has no such member.
    #[error("'{name}' does not belong to the swarm. It has: {members}")]
    Unknown {
        /// Name that was asked for.
        name: String,
        /// Names of all members.
        members: String,
    },
    /// Keys or certificates cannot be made.
    #[error("cannot make {what}: {reason}")]
    Make {
        /// What.
        what: &'static str,
        /// Why.
        reason: String,
    },
}
