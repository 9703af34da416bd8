//! The signature that a report carries as its attachment.
//!
//! | bytes | what |
//! | --- | --- |
//! | 1 | 1: the form |
//! | 64 | Ed25519 signature of the [`Statement`] |
//! | 8 | fingerprint of the certificate: the first bytes of its SHA-256 |
//! | the rest | the certificate itself as DER, once a second and in answers; otherwise empty |

use ring::rand::{SecureRandom, SystemRandom};

/// Random bytes of a query for the last values. The answer's signature covers them, so no old
/// answer fits a new query. They are zero in published reports.
pub type Challenge = [u8; 16];

/// Start of the signed bytes, so that the signature is valid for no other purpose.
const CONTEXT: &[u8] = b"flockeye report 1\0";
const FORM: u8 = 1;
const SIGNATURE_BYTES: usize = 64;
const FINGERPRINT_BYTES: usize = 8;

/// The content of a signature.
#[derive(Debug, Clone, Copy)]
pub struct Statement<'s> {
    /// The Zenoh key of the message.
    pub key: &'s str,
    /// The challenge of the query that it answers.
    pub challenge: Challenge,
    /// The message's payload.
    pub payload: &'s [u8],
}

impl Statement<'_> {
    /// The signed bytes: a fixed start, the key's length and the key, the challenge, the payload.
    pub(crate) fn message(&self) -> Vec<u8> {
        let key_bytes = (self.key.len() as u32).to_be_bytes();
        [CONTEXT, &key_bytes, self.key.as_bytes(), &self.challenge, self.payload].concat()
    }
}

/// The parts of an attachment.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seal<'a> {
    pub(crate) signature: &'a [u8],
    pub(crate) fingerprint: [u8; FINGERPRINT_BYTES],
    pub(crate) certificate: Option<&'a [u8]>,
}

impl<'a> Seal<'a> {
    pub(crate) fn read(bytes: &'a [u8]) -> Option<Self> {
        let (&form, rest) = bytes.split_first()?;
        let (signature, rest) = rest.split_at_checked(SIGNATURE_BYTES)?;
        let (fingerprint, rest) = rest.split_at_checked(FINGERPRINT_BYTES)?;
        (form == FORM).then_some(Self {
            signature,
            fingerprint: fingerprint.try_into().ok()?,
            certificate: (!rest.is_empty()).then_some(rest),
        })
    }

    pub(crate) fn to_bytes(self) -> Vec<u8> {
        let certificate = self.certificate.unwrap_or_default();
        [&[FORM], self.signature, &self.fingerprint, certificate].concat()
    }
}

/// An unpredictable challenge; none where the system has no random bytes.
pub fn new_challenge() -> Option<Challenge> {
    let mut challenge = Challenge::default();
    SystemRandom::new().fill(&mut challenge).ok()?;
    Some(challenge)
}
