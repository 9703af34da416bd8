//! A member's certificate, with the parts that this crate uses.

use ring::digest::{SHA256, digest};
use ring::signature::{ED25519, UnparsedPublicKey};
use rustls_pki_types::{CertificateDer, UnixTime};
use std::time::Duration;
use webpki::{EndEntityCert, KeyUsage, anchor_from_trusted_cert};
use x509_parser::prelude::{FromDer, X509Certificate};

/// Maximum size of a certificate, bytes; the authority issues only smaller ones.
const MOST_BYTES: usize = 2_048;
/// Bytes of an Ed25519 public key (RFC 8032).
const KEY_BYTES: usize = 32;

/// A certificate of a member or of the authority. Its signature is unverified until
/// [`check`](Self::check).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Certificate {
    /// The certificate as DER.
    pub der: Vec<u8>,
    /// Name of its owner: the subject's common name.
    pub name: String,
    /// Its serial number, hexadecimal.
    pub serial: String,
    /// First valid second, since 1970-01-01 UTC.
    pub not_before_s: i64,
    /// Last valid second, since 1970-01-01 UTC.
    pub not_after_s: i64,
    public_key: [u8; KEY_BYTES],
}

/// The reason why a certificate is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts describe the variants")]
pub enum CertificateFault {
    #[error("it is no certificate with a name and an Ed25519 key")]
    Malformed,
    /// Another authority signed it, or it has another purpose.
    #[error("another authority has signed it")]
    AnotherAuthority,
    #[error("it has expired. Cure: flockeye keys issue")]
    Expired,
    /// Its validity has not begun: one of the clocks is wrong.
    #[error("it does not hold yet: this machine's clock or the authority's is wrong")]
    NotYet,
}

impl Certificate {
    /// Reads a certificate as DER.
    ///
    /// # Errors
    /// [`CertificateFault::Malformed`].
    pub fn read(der: &[u8]) -> Result<Self, CertificateFault> {
        Self::parse(der).ok_or(CertificateFault::Malformed)
    }

    fn parse(der: &[u8]) -> Option<Self> {
        if der.len() > MOST_BYTES {
            return None;
        }
        let (rest, certificate) = X509Certificate::from_der(der).ok()?;
        let mut names = certificate.subject.iter_common_name();
        let name = names.next()?.as_str().ok()?.to_owned();
        let key = &certificate.public_key().subject_public_key.data;
        let is_plain = rest.is_empty() && names.next().is_none();
        let validity = certificate.validity();
        is_plain.then_some(Self {
            der: der.into(),
            name,
            serial: hex(certificate.raw_serial()),
            not_before_s: validity.not_before.timestamp(),
            not_after_s: validity.not_after.timestamp(),
            public_key: key.as_ref().try_into().ok()?,
        })
    }

    /// Checks that `authority` has signed it and that it is valid at `now_s`, seconds since
    /// 1970-01-01 UTC.
    ///
    /// # Errors
    /// The reason why it is not accepted.
    pub fn check(&self, authority: &Self, now_s: i64) -> Result<(), CertificateFault> {
        let checked = self.check_chain(authority, self.not_before_s);
        checked.ok_or(CertificateFault::AnotherAuthority)?;
        self.check_time(now_s)
    }

    /// Checks that the certificate is valid at `now_s`, seconds since 1970-01-01 UTC.
    ///
    /// # Errors
    /// The reason why it is not accepted.
    pub fn check_time(&self, now_s: i64) -> Result<(), CertificateFault> {
        if now_s < self.not_before_s {
            return Err(CertificateFault::NotYet);
        }
        if now_s > self.not_after_s {
            return Err(CertificateFault::Expired);
        }
        Ok(())
    }

    /// Checks the signature at a given time. The validity is checked separately, for clearer
    /// errors.
    fn check_chain(&self, authority: &Self, at_s: i64) -> Option<()> {
        let (der, root) = (CertificateDer::from(&*self.der), CertificateDer::from(&*authority.der));
        let anchor = anchor_from_trusted_cert(&root).ok()?;
        let certificate = EndEntityCert::try_from(&der).ok()?;
        let at = UnixTime::since_unix_epoch(Duration::from_secs(at_s.try_into().ok()?));
        let algorithms = &[webpki::ring::ED25519];
        let usage = KeyUsage::client_auth();
        certificate.verify_for_usage(algorithms, &[anchor], &[], at, usage, None, None).ok()?;
        Some(())
    }

    pub(crate) fn has_signed(&self, message: &[u8], signature: &[u8]) -> bool {
        UnparsedPublicKey::new(&ED25519, self.public_key).verify(message, signature).is_ok()
    }

    pub(crate) fn has_key(&self, public_key: &[u8]) -> bool {
        self.public_key == public_key
    }

    /// The first eight bytes of its SHA-256. They identify a known certificate, and prove nothing.
    pub(crate) fn fingerprint(&self) -> [u8; 8] {
        let digest = digest(&SHA256, &self.der);
        std::array::from_fn(|k| digest.as_ref()[k])
    }
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub(crate) fn unhex(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u32> = text.chars().map(|c| c.to_digit(16)).collect::<Option<_>>()?;
    let pairs = digits.chunks_exact(2);
    pairs.remainder().is_empty().then(|| pairs.map(|pair| (pair[0] * 16 + pair[1]) as u8).collect())
}
