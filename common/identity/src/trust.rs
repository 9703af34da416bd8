//! Whether what is said is signed by the one who is named.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use crate::certificate::{Certificate, CertificateFault};
use crate::member::Member;
use crate::seal::{Seal, Statement};

/// Certificates that are kept. The authority has signed them all, so only a large swarm that renews
/// often has more.
const MOST_KNOWN: usize = 1_024;

/// Checks signatures, and remembers the certificates that came with them.
#[derive(Debug)]
pub struct Trust {
    member: Arc<Member>,
    known: Mutex<BTreeMap<[u8; 8], Arc<Certificate>>>,
}

/// Why a message is not taken for what it says.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Untrusted {
    /// The report carries no signature.
    #[error("it is not signed")]
    NotSigned,
    /// Its certificate has not come yet; it comes once a second.
    #[error("its certificate is not known yet")]
    NotKnown,
    /// Its certificate does not count.
    #[error("its certificate does not count: {0}")]
    Certificate(#[from] CertificateFault),
    /// Its certificate is revoked.
    #[error("the certificate of '{0}' is revoked")]
    Revoked(String),
    /// Its signer is not on the roster.
    #[error("'{0}' is not on the swarm's roster")]
    NotAMember(String),
    /// Somebody else has signed it.
    #[error("it is signed by '{0}'")]
    Another(String),
    /// The signature does not match: it was changed, or said under another key or to another
    /// question.
    #[error("its signature does not match what it says, or where, or to which question")]
    Signature,
}

impl Trust {
    /// As `member` sees it.
    pub fn of(member: Arc<Member>) -> Self {
        Self { member, known: Mutex::default() }
    }

    /// Whether somebody of this name belongs to the swarm.
    pub fn knows(&self, name: &str) -> bool {
        self.member.roster.has(name)
    }

    /// Whether `observer` has said this, by the attachment that came with it.
    ///
    /// # Errors
    /// Why it is not taken for that.
    pub fn check(
        &self,
        observer: &str,
        said: &Statement<'_>,
        attachment: Option<&[u8]>,
        now_s: i64,
    ) -> Result<(), Untrusted> {
        let seal = attachment.and_then(Seal::read).ok_or(Untrusted::NotSigned)?;
        let certificate = self.certificate(&seal, now_s)?;
        let name = || certificate.name.clone();
        certificate.check_time(now_s)?;
        if self.member.roster.is_revoked(&certificate.serial) {
            return Err(Untrusted::Revoked(name()));
        }
        if !self.member.roster.has(&certificate.name) {
            return Err(Untrusted::NotAMember(name()));
        }
        if !certificate.has_signed(&said.message(), seal.signature) {
            return Err(Untrusted::Signature);
        }
        // Last, so that nobody is named who has not signed.
        if certificate.name != observer {
            return Err(Untrusted::Another(name()));
        }
        Ok(())
    }

    fn certificate(&self, seal: &Seal<'_>, now_s: i64) -> Result<Arc<Certificate>, Untrusted> {
        let known = self
            .known
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get(&seal.fingerprint)
            .cloned();
        let Some(der) = seal.certificate else { return known.ok_or(Untrusted::NotKnown) };
        if let Some(known) = known.filter(|known| known.der == der) {
            return Ok(known);
        }
        let certificate = Arc::new(Certificate::read(der)?);
        certificate.check(&self.member.authority, now_s)?;
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if known.len() == MOST_KNOWN {
            known.clear();
        }
        known.insert(certificate.fingerprint(), certificate.clone());
        Ok(certificate)
    }
}
