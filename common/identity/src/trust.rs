//! Check that messages are signed by the observer in their key.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use crate::certificate::{Certificate, CertificateFault};
use crate::member::Member;
use crate::seal::{Seal, Statement};

/// Maximum certificates that are kept. The authority has signed them all, so only a large swarm
/// with frequent renewals has more.
const MOST_KNOWN: usize = 1_024;

/// Checks signatures, and keeps the certificates that arrive with them.
#[derive(Debug)]
pub struct Trust {
    member: Arc<Member>,
    known: Mutex<BTreeMap<[u8; 8], Arc<Certificate>>>,
}

/// The reason why a message is not trusted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts describe the variants")]
pub enum Untrusted {
    #[error("it is not signed")]
    NotSigned,
    /// Its certificate has not arrived yet; it is sent once a second.
    #[error("its certificate is not known yet")]
    NotKnown,
    #[error("its certificate does not count: {0}")]
    Certificate(#[from] CertificateFault),
    #[error("the certificate of '{0}' is revoked")]
    Revoked(String),
    #[error("'{0}' is not on the swarm's roster")]
    NotAMember(String),
    #[error("it is signed by '{0}'")]
    Another(String),
    /// The signature does not match: the message, its key or its query is another.
    #[error("its signature does not match what it says, or where, or to which question")]
    Signature,
}

impl Trust {
    /// Trust with the roster and authority of `member`.
    pub fn of(member: Arc<Member>) -> Self {
        Self { member, known: Mutex::default() }
    }

    /// Whether this name belongs to the swarm.
    pub fn knows(&self, name: &str) -> bool {
        self.member.roster.has(name)
    }

    /// Checks by the attachment that `observer` has signed this statement.
    ///
    /// # Errors
    /// The reason why it is not trusted.
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
        // The name is compared last, so that errors name only actual signers.
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
