//! The swarm's authority, which issues the members' keys and certificates.

use std::fs::File;
use std::path::{Path, PathBuf};

use flockeye_contract::wire::is_name;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, PKCS_ED25519, SerialNumber,
};
use serde::{Deserialize, Serialize};
use time::{Duration, OffsetDateTime};

use crate::certificate::hex;
use crate::error::IdentityError;
use crate::files;
use crate::member::{MemberFiles, certificate};
use crate::roster::Roster;
use crate::seal::new_challenge;

/// Time before its issue from which a certificate is valid, so that a drone's clock may be slow.
const BEFORE: Duration = Duration::hours(1);
/// Validity of the authority's own certificate.
const AUTHORITY_HOLDS: Duration = Duration::days(3_650);

/// The authority's folder.
#[derive(Debug)]
pub struct Authority {
    folder: PathBuf,
    roster: Roster,
    /// Lock against other programs that change the folder.
    _lock: File,
}

/// The role of a certificate's owner in the swarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// A drone, or an onlooker.
    Member,
    /// A router, which passes on the reports of others.
    Router,
}

/// An issued certificate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Issued {
    /// The name of its owner.
    pub name: String,
    /// Its serial number, hexadecimal.
    pub serial: String,
    /// Its last valid second, since 1970-01-01 UTC.
    pub not_after_s: i64,
}

impl Authority {
    /// Creates the authority of a new swarm in a folder.
    ///
    /// # Errors
    /// The name is invalid, an authority exists already, or the folder cannot be written.
    pub fn create(folder: &Path, swarm: &str) -> Result<Self, IdentityError> {
        check_name(swarm)?;
        files::make_folder(folder)?;
        let authority = Self {
            folder: folder.into(),
            _lock: files::lock_folder(folder)?,
            roster: Roster {
                swarm: swarm.into(),
                number: 1,
                members: Vec::new(),
                routers: Vec::new(),
                revoked: Vec::new(),
            },
        };
        if authority.key_path().exists() {
            return Err(IdentityError::Exists(folder.into()));
        }
        let key = new_key()?;
        let mut params = params(&format!("{swarm} authority"), AUTHORITY_HOLDS)?;
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
        let certificate = params.self_signed(&key).map_err(failed("the certificate"))?;
        files::write(&authority.ca_path(), &certificate.pem())?;
        authority.roster.write(&authority.roster_path(), &key)?;
        // The key is written last: only with it the folder counts as an authority.
        files::write_private(&authority.key_path(), &key.serialize_pem())?;
        Ok(authority)
    }

    /// Opens the authority in a folder.
    ///
    /// # Errors
    /// There is none, its files are invalid, or others can read its key.
    pub fn open(folder: &Path) -> Result<Self, IdentityError> {
        let lock = files::lock_folder(folder)?;
        let ca = certificate(&folder.join("ca.pem"))?;
        let roster = Roster::read(&folder.join("roster.json"), &ca)?;
        let authority = Self { folder: folder.into(), roster, _lock: lock };
        authority.key()?;
        Ok(authority)
    }

    /// The members of the swarm.
    pub fn roster(&self) -> &Roster {
        &self.roster
    }

    /// All issued certificates.
    ///
    /// # Errors
    /// The list cannot be read.
    pub fn issued(&self) -> Result<Vec<Issued>, IdentityError> {
        let path = self.issued_path();
        if !path.exists() {
            return Ok(Vec::new());
        }
        let lines = files::read_lines(&path)?;
        let issued = lines.iter().map(|line| serde_json::from_str(line));
        issued.collect::<Result<_, _>>().map_err(|error| IdentityError::Content {
            path,
            reason: format!("it is no list of certificates: {error}"),
        })
    }

    /// Creates a key and a certificate that is valid for `holds`. Writes them to the folder `into`,
    /// with all files that a member needs, and enters the name in the roster.
    ///
    /// # Errors
    /// The name is invalid, or is used in another role. Or it has a revoked certificate that is
    /// still valid at `now_s`, seconds since 1970-01-01 UTC. Or a file cannot be written.
    pub fn issue(
        &mut self,
        name: &str,
        role: Role,
        holds: std::time::Duration,
        into: &Path,
        now_s: i64,
    ) -> Result<(Issued, MemberFiles), IdentityError> {
        check_name(name)?;
        self.check_not_burnt(name, now_s)?;
        let (ours, others) = match role {
            Role::Member => (&mut self.roster.members, &self.roster.routers),
            Role::Router => (&mut self.roster.routers, &self.roster.members),
        };
        if others.iter().any(|other| other == name) {
            let reason = format!("'{name}' is there in another role. Cure: another name");
            return Err(IdentityError::Content { path: self.roster_path(), reason });
        }
        let is_new = !ours.iter().any(|known| known == name);
        if is_new {
            ours.push(name.into());
        }
        let authority_key = self.key()?;
        let ca_pem = files::read(&self.ca_path())?;
        let issuer = Issuer::from_ca_cert_pem(&ca_pem, &authority_key)
            .map_err(failed("certificates with this authority"))?;
        let holds = Duration::try_from(holds).unwrap_or(AUTHORITY_HOLDS).min(AUTHORITY_HOLDS);
        let mut params = params(name, holds)?;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
        let mut serial = new_challenge().ok_or_else(no_random)?;
        // These bits make the number positive and its hexadecimal form constant in length.
        serial[0] = serial[0] & 0x7f | 0x40;
        params.serial_number = Some(SerialNumber::from_slice(&serial));
        let key = new_key()?;
        let certificate = params.signed_by(&key, &issuer).map_err(failed("the certificate"))?;
        let issued = Issued {
            name: name.into(),
            serial: hex(&serial),
            not_after_s: params.not_after.unix_timestamp(),
        };
        // The note comes before the certificate's file, so that every certificate can be revoked.
        self.note(&issued)?;
        if is_new {
            self.change(&authority_key)?;
        }
        files::make_folder(into)?;
        let files = MemberFiles {
            ca: into.join("ca.pem"),
            certificate: into.join("certificate.pem"),
            key: into.join("key.pem"),
            roster: into.join("roster.json"),
        };
        files::write_private(&files.key, &key.serialize_pem())?;
        files::write(&files.certificate, &certificate.pem())?;
        files::write(&files.ca, &ca_pem)?;
        self.roster.write(&files.roster, &authority_key)?;
        Ok((issued, files))
    }

    /// Removes a name from the roster, and revokes all its certificates that are still valid.
    /// `now_s`: seconds since 1970-01-01 UTC. Returns their number.
    ///
    /// # Errors
    /// The name is unknown, or a file cannot be written.
    pub fn revoke(&mut self, name: &str, now_s: i64) -> Result<usize, IdentityError> {
        let issued = self.issued()?;
        if !issued.iter().any(|issued| issued.name == name) {
            let members = [&*self.roster.members, &*self.roster.routers].concat().join(", ");
            return Err(IdentityError::Unknown { name: name.into(), members });
        }
        let holds = |serial: &str| {
            issued.iter().any(|issued| issued.serial == serial && issued.not_after_s >= now_s)
        };
        let Roster { members, routers, revoked, .. } = &mut self.roster;
        members.retain(|member| member != name);
        routers.retain(|router| router != name);
        revoked.retain(|serial| holds(serial));
        let before = revoked.len();
        for issued in issued.iter().filter(|issued| issued.name == name && holds(&issued.serial)) {
            if !revoked.contains(&issued.serial) {
                revoked.push(issued.serial.clone());
            }
        }
        let count = revoked.len() - before;
        self.change(&self.key()?)?;
        Ok(count)
    }

    /// Refuses a name with a revoked certificate that is still valid. Links are judged by names, so
    /// this certificate would be accepted again.
    fn check_not_burnt(&self, name: &str, now_s: i64) -> Result<(), IdentityError> {
        let burnt = self.issued()?.into_iter().filter(|issued| {
            issued.name == name
                && issued.not_after_s >= now_s
                && self.roster.is_revoked(&issued.serial)
        });
        match burnt.map(|issued| issued.not_after_s).max() {
            Some(not_after_s) => Err(IdentityError::Burnt {
                name: name.into(),
                hours: (not_after_s - now_s) / 3_600 + 1,
            }),
            None => Ok(()),
        }
    }

    fn change(&mut self, key: &KeyPair) -> Result<(), IdentityError> {
        self.roster.number += 1;
        self.roster.members.sort();
        self.roster.routers.sort();
        self.roster.write(&self.roster_path(), key)
    }

    fn note(&self, issued: &Issued) -> Result<(), IdentityError> {
        let line = serde_json::to_string(issued)
            .map_err(|error| IdentityError::Make { what: "a note", reason: error.to_string() })?;
        files::append(&self.issued_path(), &line)
    }

    fn key(&self) -> Result<KeyPair, IdentityError> {
        let path = self.key_path();
        KeyPair::from_pem(&files::read_private(&path)?).map_err(|error| IdentityError::Content {
            path,
            reason: format!("it is no private key: {error}"),
        })
    }

    fn ca_path(&self) -> PathBuf {
        self.folder.join("ca.pem")
    }

    fn key_path(&self) -> PathBuf {
        self.folder.join("ca.key")
    }

    fn issued_path(&self) -> PathBuf {
        self.folder.join("issued.jsonl")
    }

    /// The swarm's roster.
    pub fn roster_path(&self) -> PathBuf {
        self.folder.join("roster.json")
    }
}

fn check_name(name: &str) -> Result<(), IdentityError> {
    if is_name(name) { Ok(()) } else { Err(IdentityError::Name(name.into())) }
}

fn no_random() -> IdentityError {
    IdentityError::Make { what: "a serial number", reason: "the system has no random bytes".into() }
}

fn failed(what: &'static str) -> impl FnOnce(rcgen::Error) -> IdentityError {
    move |error| IdentityError::Make { what, reason: error.to_string() }
}

fn new_key() -> Result<KeyPair, IdentityError> {
    KeyPair::generate_for(&PKCS_ED25519).map_err(failed("a key"))
}

/// The contents of a certificate: its name and its time of validity.
fn params(name: &str, holds: Duration) -> Result<CertificateParams, IdentityError> {
    let mut params = CertificateParams::new(Vec::new()).map_err(failed("the certificate"))?;
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    let now = OffsetDateTime::now_utc();
    (params.not_before, params.not_after) = (now - BEFORE, now + holds);
    Ok(params)
}
