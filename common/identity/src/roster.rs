//! The members of a swarm and its revoked certificates.

use std::path::Path;

use rcgen::{KeyPair, SigningKey};
use serde::{Deserialize, Serialize};

use crate::certificate::{Certificate, hex, unhex};
use crate::error::IdentityError;
use crate::files;

/// Start of the signed bytes, so that the signature is valid for no other purpose.
const CONTEXT: &[u8] = b"flockeye roster 1\0";

/// The members of the swarm, and the revoked certificates. The file contains them with the
/// authority's signature.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Roster {
    /// The swarm's name.
    pub swarm: String,
    /// Increases with each change.
    pub number: u64,
    /// Drones and onlookers, by name.
    pub members: Vec<String>,
    /// Routers, which pass on the messages of others, by name.
    pub routers: Vec<String>,
    /// Serial numbers of certificates that are revoked and have not expired, hexadecimal.
    pub revoked: Vec<String>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Signed {
    roster: Roster,
    /// Ed25519, by the authority, hexadecimal.
    signature: String,
}

impl Roster {
    /// Whether this name belongs to the swarm.
    pub fn has(&self, name: &str) -> bool {
        self.members.iter().chain(&self.routers).any(|known| known == name)
    }

    /// Whether the certificate with this serial number is revoked.
    pub fn is_revoked(&self, serial: &str) -> bool {
        self.revoked.iter().any(|revoked| revoked == serial)
    }

    fn message(&self) -> Result<Vec<u8>, serde_json::Error> {
        Ok([CONTEXT, &serde_json::to_vec(self)?].concat())
    }

    /// Reads the file, and checks that `authority` has signed it.
    pub(crate) fn read(path: &Path, authority: &Certificate) -> Result<Self, IdentityError> {
        let wrong = |reason: String| IdentityError::Content { path: path.into(), reason };
        let text = files::read(path)?;
        let Signed { roster, signature } = serde_json::from_str(&text)
            .map_err(|error| wrong(format!("it is no roster of a swarm: {error}")))?;
        let message = roster.message().map_err(|error| wrong(error.to_string()))?;
        if !unhex(&signature).is_some_and(|signature| authority.has_signed(&message, &signature)) {
            return Err(wrong(
                "the swarm's authority has not signed this, or it was changed since. Cure: copy the roster \
                 from the authority's folder again"
                    .into(),
            ));
        }
        Ok(roster)
    }

    /// Writes the file, signed with the authority's key.
    pub(crate) fn write(&self, path: &Path, key: &KeyPair) -> Result<(), IdentityError> {
        let failed = |reason: String| IdentityError::Make { what: "the roster", reason };
        let message = self.message().map_err(|error| failed(error.to_string()))?;
        let signature = key.sign(&message).map_err(|error| failed(error.to_string()))?;
        let signed = Signed { roster: self.clone(), signature: hex(&signature) };
        let text = serde_json::to_string_pretty(&signed);
        files::write(path, &(text.map_err(|error| failed(error.to_string()))? + "\n"))
    }
}
