//! Identities of a swarm's members: certificates, the roster, and signatures of reports.
//!
//! A swarm has one [`Authority`]: a key and a certificate that signs all others. It issues each
//! member a certificate with the member's name, and keeps the [`Roster`]: who belongs to the swarm
//! and which certificates are revoked, signed by the authority. A [`Member`] is what a drone holds:
//! its own certificate and key, the authority's certificate and the roster.
//!
//! The certificates protect the links (mutual TLS). Behind a router every link bears the router's
//! name, so each report carries a signature of its observer too, made with the same key
//! ([`Member::seal`]); [`Trust`] checks it. All keys are Ed25519. TLS 1.3 and reports sign texts
//! that begin differently, so a signature of one is never one of the other.
//!
//! `docs/SECURITY.md` describes all of it for operators, and the form of a signature for other
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
