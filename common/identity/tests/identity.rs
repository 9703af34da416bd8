//! An authority, its members, and those who pretend.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use flockeye_identity::{
    Authority, Challenge, IdentityError, Member, MemberFiles, Role, Statement, Trust, Untrusted,
    new_challenge,
};
use proptest::prelude::*;

const HOUR: Duration = Duration::from_secs(3_600);
const KEY: &str = "flockeye/swarm/wren/sees";

fn now_s() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() as i64
}

/// An authority with members of these names, whose folders are beside its own.
fn swarm(folder: &Path, names: &[&str]) -> (Authority, Vec<MemberFiles>) {
    let mut authority = Authority::create(&folder.join("authority"), "swarm").unwrap();
    let mut issue = |name: &str| {
        authority.issue(name, Role::Member, HOUR, &folder.join(name), now_s()).unwrap().1
    };
    let files: Vec<_> = names.iter().map(|name| issue(name)).collect();
    // The roster of now is copied to all, as an operator would.
    for files in &files {
        fs::copy(authority.roster_path(), &files.roster).unwrap();
    }
    (authority, files)
}

fn load(files: &MemberFiles) -> Arc<Member> {
    Arc::new(Member::load(files, now_s()).unwrap())
}

fn said(payload: &[u8], challenge: Challenge) -> Statement<'_> {
    Statement { key: KEY, challenge, payload }
}

#[test]
fn what_a_member_says_is_trusted_and_nothing_else_is() {
    let folder = tempfile::tempdir().unwrap();
    let (_, files) = swarm(folder.path(), &["wren", "kite"]);
    let (wren, kite) = (load(&files[0]), load(&files[1]));
    let trust = Trust::of(kite.clone());
    let published = said(b"pose", Challenge::default());
    let check = |said: &Statement<'_>, seal: &[u8]| trust.check("wren", said, Some(seal), now_s());

    let bare = wren.seal(&published, false);
    assert_eq!(check(&published, &bare), Err(Untrusted::NotKnown));
    check(&published, &wren.seal(&published, true)).unwrap();
    check(&published, &bare).expect("its certificate has come");

    let mut changed = said(b"posh", Challenge::default());
    assert_eq!(check(&changed, &bare), Err(Untrusted::Signature));
    changed = Statement { key: "flockeye/swarm/wren/sees/kite/pose", ..published };
    assert_eq!(check(&changed, &bare), Err(Untrusted::Signature));
    let challenge = new_challenge().unwrap();
    assert_eq!(check(&said(b"pose", challenge), &bare), Err(Untrusted::Signature));
    check(&said(b"pose", challenge), &wren.seal(&said(b"pose", challenge), false)).unwrap();

    let by_kite = kite.seal(&published, true);
    assert_eq!(check(&published, &by_kite), Err(Untrusted::Another("kite".into())));
    assert_eq!(trust.check("wren", &published, None, now_s()), Err(Untrusted::NotSigned));
    let later = trust.check("wren", &published, Some(&bare), now_s() + 3_700);
    assert!(matches!(later, Err(Untrusted::Certificate(_))), "{later:?}");
}

#[test]
fn another_authority_and_the_revoked_are_refused() {
    let [ours, theirs] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let (mut authority, files) = swarm(ours.path(), &["wren", "kite"]);
    let (_, strangers) = swarm(theirs.path(), &["wren"]);
    let (wren, stranger) = (load(&files[0]), load(&strangers[0]));
    let published = said(b"pose", Challenge::default());
    let trust = Trust::of(load(&files[1]));
    let refused = trust.check("wren", &published, Some(&stranger.seal(&published, true)), now_s());
    assert!(matches!(refused, Err(Untrusted::Certificate(_))), "{refused:?}");

    assert_eq!(authority.revoke("wren", now_s()).unwrap(), 1);
    fs::copy(authority.roster_path(), &files[1].roster).unwrap();
    let trust = Trust::of(load(&files[1]));
    let refused = trust.check("wren", &published, Some(&wren.seal(&published, true)), now_s());
    assert_eq!(refused, Err(Untrusted::Revoked("wren".into())));
    fs::copy(authority.roster_path(), &files[0].roster).unwrap();
    let message = Member::load(&files[0], now_s()).unwrap_err().to_string();
    assert!(message.contains("the certificate of 'wren' is revoked"), "{message}");

    // Links are judged by names, so the name is burnt until that certificate has expired.
    let mut issue = |now_s| {
        let into = ours.path().join("wren again");
        authority.issue("wren", Role::Member, HOUR, &into, now_s)
    };
    let message = issue(now_s()).unwrap_err().to_string();
    assert!(message.contains("Cure: another name, or wait"), "{message}");
    let again = issue(now_s() + 3_700).unwrap().1;
    fs::copy(authority.roster_path(), &files[1].roster).unwrap();
    let trust = Trust::of(load(&files[1]));
    let check = |member: &Member| {
        trust.check("wren", &published, Some(&member.seal(&published, true)), now_s())
    };
    check(&load(&again)).unwrap();
    assert!(matches!(check(&wren), Err(Untrusted::Revoked(_))));
    assert!(authority.revoke("robin", now_s()).is_err());
}

#[test]
fn files_that_are_wrong_are_named_with_a_cure() {
    let folder = tempfile::tempdir().unwrap();
    let (authority, files) = swarm(folder.path(), &["wren", "kite"]);
    let [wren, kite] = &files[..] else { unreachable!("two were issued") };
    let refused = |files: &MemberFiles| Member::load(files, now_s()).unwrap_err().to_string();
    assert_eq!(fs::metadata(&wren.key).unwrap().permissions().mode() & 0o777, 0o600);

    fs::set_permissions(&wren.key, fs::Permissions::from_mode(0o640)).unwrap();
    assert!(matches!(Member::load(wren, now_s()), Err(IdentityError::Exposed { mode: 0o640, .. })));
    assert!(refused(wren).contains("chmod 600"), "{}", refused(wren));
    fs::set_permissions(&wren.key, fs::Permissions::from_mode(0o600)).unwrap();

    let mixed = MemberFiles { key: kite.key.clone(), ..wren.clone() };
    assert!(refused(&mixed).contains("it is not the key of"), "{}", refused(&mixed));
    let mixed = MemberFiles { ca: kite.certificate.clone(), ..wren.clone() };
    assert!(refused(&mixed).contains("another authority"), "{}", refused(&mixed));
    let late = Member::load(wren, now_s() + 3_700).unwrap_err().to_string();
    assert!(late.contains("expired") && late.contains("flockeye keys issue"), "{late}");
    let early = Member::load(wren, now_s() - 7_200).unwrap_err().to_string();
    assert!(early.contains("clock"), "{early}");
    let missing = MemberFiles { certificate: folder.path().join("none.pem"), ..wren.clone() };
    assert!(refused(&missing).contains("none.pem: cannot open"), "{}", refused(&missing));

    let roster = fs::read_to_string(&wren.roster).unwrap();
    fs::write(&wren.roster, roster.replace("kite", "hawk")).unwrap();
    assert!(refused(wren).contains("it was changed since"), "{}", refused(wren));
    fs::write(&wren.roster, "members: all").unwrap();
    assert!(refused(wren).contains("no roster"), "{}", refused(wren));
    drop(authority);
    assert!(Authority::create(&folder.path().join("authority"), "swarm").is_err(), "there is one");
    let open = Authority::open(&folder.path().join("authority")).unwrap();
    assert_eq!(open.roster().members, ["kite", "wren"]);
    assert_eq!(open.issued().unwrap().len(), 2);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// Whatever comes as a signature: it is refused, and nothing else happens.
    #[test]
    fn any_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..600), cut in 0..500usize, flip in 0..400usize) {
        thread_local! {
            static SWARM: (tempfile::TempDir, Arc<Member>) = {
                let folder = tempfile::tempdir().unwrap();
                let wren = load(&swarm(folder.path(), &["wren"]).1[0]);
                (folder, wren)
            };
        }
        let wren = SWARM.with(|(_, wren)| wren.clone());
        let trust = Trust::of(wren.clone());
        let published = said(b"pose", Challenge::default());
        prop_assert!(trust.check("wren", &published, Some(&bytes), now_s()).is_err());
        let seal = wren.seal(&published, true);
        let cut = &seal[..cut.min(seal.len() - 1)];
        prop_assert!(trust.check("wren", &published, Some(cut), now_s()).is_err());
        let mut flipped = seal.clone();
        let flip = flip % seal.len();
        flipped[flip] ^= 1;
        // The fingerprint alone is not needed where the certificate comes along.
        if !(65..73).contains(&flip) {
            prop_assert!(trust.check("wren", &published, Some(&flipped), now_s()).is_err());
        }
    }
}
