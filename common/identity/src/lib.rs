//! Identities of a swarm's members: certificates, the roster, and signatures of reports.
//!
//! A swarm has one [`Authority`]: a key and a certificate that signs all others. It issues each
//! member a certificate with the member's name, and keeps the [`Roster`]. The roster lists the
//! members and the revoked certificates, and is signed by the authority. A [`Member`] has its own
//! certificate and key, the authority's certificate and the roster.
//!
//! The certificates protect the links (mutual TLS). Behind a router every link has the router's
//! name. So each report also carries a signature of its observer, made with the same key
//! ([`Member::seal`]). [`Trust`] checks it. All keys are Ed25519. Signed texts of TLS 1.3 and of
//! reports begin differently, so neither signature is valid as the other.
//!
//! `docs/SECURITY.md` describes this for operators, and the format of a signature for other
//! languages.

mod authority;
mod certificate;
mod error;
mod files;
mod member;
mod roster;
mod seal;
mod trust;

pub use authority::{Authority, Issued, Role};
pub use certificate::{Certificate, CertificateFault};
pub use error::IdentityError;
pub use member::{Member, MemberFiles};
pub use roster::Roster;
pub use seal::{Challenge, Statement, new_challenge};
pub use trust::{Trust, Untrusted};
