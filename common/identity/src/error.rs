//! Errors of keys, certificates and the roster.

use std::path::PathBuf;

use crate::certificate::CertificateFault;

/// An error of keys, certificates and the roster.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum IdentityError {
    /// A file cannot be read or written.
    #[error("{}: cannot {what} it: {source}", path.display())]
    File { path: PathBuf, what: &'static str, source: std::io::Error },
    /// A private key that others can read.
    #[error(
        "{}: others can read this private key (mode {mode:03o}). Cure: chmod 600 {}, and issue another \
         if somebody may have read it",
        path.display(), path.display()
    )]
    Exposed { path: PathBuf, mode: u32 },
    /// A file with invalid content.
    #[error("{}: {reason}", path.display())]
    Content { path: PathBuf, reason: String },
    /// A certificate that cannot be used.
    #[error("{}: {fault}", path.display())]
    Certificate { path: PathBuf, fault: CertificateFault },
    /// An invalid name.
    #[error("'{0}' is no name: letters, digits, '-', '_' or '.'")]
    Name(String),
    /// The folder has an authority already.
    #[error("{}: there is an authority already. Cure: another folder", .0.display())]
    Exists(PathBuf),
    /// A name with a revoked certificate that is still valid.
    #[error(
        "a certificate of '{name}' is revoked and holds for {hours} h: with it somebody could link as '{name}' again. \
         Cure: another name, or wait"
    )]
    Burnt { name: String, hours: i64 },
    /// The swarm has no such member.
    #[error("'{name}' does not belong to the swarm. It has: {members}")]
    Unknown { name: String, members: String },
    /// Keys or certificates cannot be created.
    #[error("cannot make {what}: {reason}")]
    Make { what: &'static str, reason: String },
}
