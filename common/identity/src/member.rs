//! A member's certificate, key and roster.

use std::path::{Path, PathBuf};

use ring::signature::{Ed25519KeyPair, KeyPair};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivatePkcs8KeyDer};

use crate::certificate::{Certificate, CertificateFault};
use crate::error::IdentityError;
use crate::files;
use crate::roster::Roster;
use crate::seal::{Seal, Statement};

/// Paths of a member's files; `flockeye keys issue` writes them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemberFiles {
    /// The certificate of the swarm's authority, PEM.
    pub ca: PathBuf,
    /// The member's certificate, PEM.
    pub certificate: PathBuf,
    /// The member's private key, PEM (PKCS #8), readable by its owner alone.
    pub key: PathBuf,
    /// The roster, signed by the authority.
    pub roster: PathBuf,
}

/// A member of the swarm, with the key that signs in its name.
#[derive(Debug)]
pub struct Member {
    /// The authority's certificate.
    pub authority: Certificate,
    /// The member's own certificate.
    pub certificate: Certificate,
    /// The members of the swarm.
    pub roster: Roster,
    key: Ed25519KeyPair,
}

impl Member {
    /// Reads the files, and checks that they belong together and are valid at `now_s`, seconds
    /// since 1970-01-01 UTC.
    ///
    /// # Errors
    /// A file is missing or invalid, or can be read by others. Or it is not signed by the
    /// authority, has expired or is revoked.
    pub fn load(files: &MemberFiles, now_s: i64) -> Result<Self, IdentityError> {
        let authority = certificate(&files.ca)?;
        let certificate = certificate(&files.certificate)?;
        let faulty = |fault| IdentityError::Certificate { path: files.certificate.clone(), fault };
        certificate.check(&authority, now_s).map_err(faulty)?;
        let roster = Roster::read(&files.roster, &authority)?;
        let wrong =
            |path: &PathBuf, reason: String| IdentityError::Content { path: path.clone(), reason };
        if roster.is_revoked(&certificate.serial) {
            let reason = format!("the certificate of '{}' is revoked", certificate.name);
            return Err(wrong(&files.roster, reason));
        }
        if !roster.has(&certificate.name) {
            let reason = format!(
                "'{}' is not on it. Cure: copy roster.json from the authority's folder",
                certificate.name
            );
            return Err(wrong(&files.roster, reason));
        }
        let pem = files::read_private(&files.key)?;
        let key = PrivatePkcs8KeyDer::from_pem_slice(pem.as_bytes()).ok().and_then(|der| {
            Ed25519KeyPair::from_pkcs8_maybe_unchecked(der.secret_pkcs8_der()).ok()
        });
        let key = key.ok_or_else(|| wrong(&files.key, "it is no Ed25519 private key".into()))?;
        if !certificate.has_key(key.public_key().as_ref()) {
            let reason = format!("it is not the key of {}", files.certificate.display());
            return Err(wrong(&files.key, reason));
        }
        Ok(Self { authority, certificate, roster, key })
    }

    /// The attachment that signs a statement; with the certificate, for receivers that lack it.
    pub fn seal(&self, said: &Statement<'_>, with_certificate: bool) -> Vec<u8> {
        let signature = self.key.sign(&said.message());
        Seal {
            signature: signature.as_ref(),
            fingerprint: self.certificate.fingerprint(),
            certificate: with_certificate.then_some(&self.certificate.der),
        }
        .to_bytes()
    }
}

/// Reads the certificate in a PEM file.
pub(crate) fn certificate(path: &Path) -> Result<Certificate, IdentityError> {
    let pem = files::read(path)?;
    let der = CertificateDer::from_pem_slice(pem.as_bytes());
    let read = der.map_err(|_| CertificateFault::Malformed).and_then(|der| Certificate::read(&der));
    read.map_err(|fault| IdentityError::Certificate { path: path.into(), fault })
}
