//! Secure sessions on the loopback interface, members of a swarm and those who are not.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use flockeye_contract::wire::{FRAME_SCHEMA, FrameReport, alive_key, frame_key};
use flockeye_identity::{Authority, Challenge, Member, MemberFiles, Role, Statement};
use flockeye_network::{Listener, Network, NetworkMode, NetworkParameters, PeerState, Refused};
use flockeye_require::loopback::{free_port, until, watched};
use flockeye_runtime::clock::utc_s;
use zenoh::{Session, Wait};

const SWARM: &str = "safe";
const DAY: Duration = Duration::from_secs(86_400);

/// A swarm's authority and the files of its members.
struct Swarm {
    folder: tempfile::TempDir,
    authority: Authority,
}

impl Swarm {
    fn new(members: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let authority = Authority::create(&folder.path().join("authority"), SWARM).unwrap();
        let mut swarm = Self { folder, authority };
        for name in members {
            swarm.issue(name, Role::Member, DAY);
        }
        swarm.issue("base", Role::Router, DAY);
        swarm
    }

    fn issue(&mut self, name: &str, role: Role, holds: Duration) {
        let folder = self.folder.path().join(name);
        self.authority.issue(name, role, holds, &folder, utc_s()).unwrap();
    }

    /// The files of a member, with the roster of now.
    fn files(&self, name: &str) -> MemberFiles {
        let path = |file: &str| -> PathBuf { self.folder.path().join(name).join(file) };
        fs::copy(self.authority.roster_path(), path("roster.json")).unwrap();
        MemberFiles {
            ca: path("ca.pem"),
            certificate: path("certificate.pem"),
            key: path("key.pem"),
            roster: path("roster.json"),
        }
    }

    fn parameters(&self, name: &str, listen: &[u16], connect: &[u16]) -> NetworkParameters {
        NetworkParameters {
            swarm: SWARM.into(),
            observer: name.into(),
            listen: listen.iter().copied().map(tls).collect(),
            connect: connect.iter().copied().map(tls).collect(),
            security: Some(self.files(name)),
            ..Default::default()
        }
    }

    fn open(&self, name: &str, listen: &[u16], connect: &[u16]) -> Network {
        Network::open(&self.parameters(name, listen, connect)).unwrap()
    }

    /// A drone that has a link with a router alone.
    fn client(&self, name: &str, router: u16) -> Network {
        let mode = NetworkMode::Client;
        let parameters = NetworkParameters { mode, ..self.parameters(name, &[], &[router]) };
        Network::open(&parameters).unwrap()
    }

    fn router(&self, port: u16) -> Network {
        let mode = NetworkMode::Router;
        let parameters = NetworkParameters { mode, ..self.parameters("base", &[port], &[]) };
        Network::open(&parameters).unwrap()
    }

    fn member(&self, name: &str) -> Arc<Member> {
        Arc::new(Member::load(&self.files(name), utc_s()).unwrap())
    }
}

fn tls(port: u16) -> String {
    format!("tls/127.0.0.1:{port}")
}

/// A session of somebody's own program, with these files or none.
fn own_program(files: Option<&MemberFiles>, connect: &str) -> Session {
    let mut config = serde_json::json!({
        "mode": "peer",
        "listen": { "endpoints": [] },
        "connect": { "endpoints": [connect], "exit_on_failure": false, "timeout_ms": -1 },
        "scouting": { "multicast": { "enabled": false } },
    });
    if let Some(files) = files {
        config["transport"] = serde_json::json!({ "link": { "tls": {
            "root_ca_certificate": files.ca,
            "enable_mtls": true,
            "connect_private_key": files.key,
            "connect_certificate": files.certificate,
            "verify_name_on_connect": false,
        }}});
    }
    zenoh::open(zenoh::Config::from_json5(&config.to_string()).unwrap()).wait().unwrap()
}

fn now_utc_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    i64::try_from(since.as_nanos()).unwrap()
}

fn report(observer: &str, frame: u64) -> FrameReport {
    let target = serde_json::json!({
        "target": "robin", "state": "confirmed", "measured_by": "aligned", "markers": 3, "unseen_s": 0.0,
        "position": [1.5, 0.2, 0.1], "orientation": [0, 0, 0, 1], "covariance": vec![0.0; 21],
        "linear_velocity": [0, 0, 0], "angular_velocity": [0, 0, 0],
    });
    serde_json::from_value(serde_json::json!({
        "schema": FRAME_SCHEMA, "observer": observer, "frame": frame, "epoch": 0,
        "stamp_utc_ns": now_utc_ns(), "clock_synchronised": false, "stream_s": 0.0,
        "latency_ms": 0.0, "targets": [target],
    }))
    .unwrap()
}

fn peer(listener: &Listener, name: &str) -> Option<PeerState> {
    listener.snapshot().observers.get(name).cloned()
}

fn refused(listener: &Listener, name: &str) -> Refused {
    peer(listener, name).map(|peer| peer.refused).unwrap_or_default()
}

/// The frame that `listener` has from an observer.
fn frame_of(listener: &Listener, name: &str) -> Option<u64> {
    peer(listener, name)?.targets.get("robin").map(|received| received.report.frame)
}

/// Reports until `listener` has it.
fn report_until_heard(network: &Network, name: &str, listener: &Listener) {
    let reporter = network.reporter().unwrap();
    let mut frame = 0;
    until(|| {
        frame += 1;
        reporter.report(report(name, frame)).unwrap();
        std::thread::sleep(Duration::from_millis(20));
        frame_of(listener, name)
    });
}

/// Somebody's own program says a report in a name, signed by a member or not.
fn say(session: &Session, observer: &str, frame: u64, signer: Option<&Member>) {
    let key = frame_key(SWARM, observer);
    let payload = report(observer, frame).to_json().unwrap();
    let said = Statement { key: &key, challenge: Challenge::default(), payload: &payload };
    let seal = signer.map(|signer| signer.seal(&said, true));
    session.put(&key, payload.clone()).attachment(seal).wait().unwrap();
}

/// The rules as they are shipped: denying all but what is named is easily too much.
#[test]
fn members_hear_each_other_directly_and_through_a_router() {
    watched(|| {
        let swarm = Swarm::new(&["wren", "kite"]);
        let port = free_port();
        let wren = swarm.open("wren", &[port], &[]);
        let kite = swarm.open("kite", &[], &[port]);
        let [wren_hears, kite_hears] = [&wren, &kite].map(|network| network.listener().unwrap());
        report_until_heard(&wren, "wren", &kite_hears);
        report_until_heard(&kite, "kite", &wren_hears);
        drop((wren_hears, kite_hears, wren, kite));

        let port = free_port();
        let _base = swarm.router(port);
        let wren = swarm.client("wren", port);
        let kite = swarm.client("kite", port);
        let kite_hears = kite.listener().unwrap();
        let reporter = wren.reporter().unwrap();
        until(|| peer(&kite_hears, "wren").filter(|peer| peer.alive));
        // Whoever comes late has the last report, though nothing more is said.
        reporter.report(report("wren", 7)).unwrap();
        until(|| frame_of(&kite_hears, "wren"));
        let late = swarm.client("kite", port);
        let late = late.listener().unwrap();
        assert_eq!(until(|| frame_of(&late, "wren")), 7);
        assert_eq!(refused(&late, "wren").total() + refused(&kite_hears, "wren").total(), 0);
    });
}

#[test]
fn strangers_get_no_link_and_members_hear_on() {
    watched(|| {
        flockeye_runtime::logs::init();
        let mut swarm = Swarm::new(&["wren", "kite"]);
        let others = Swarm::new(&["kite"]);
        swarm.issue("late", Role::Member, Duration::from_secs(1));
        let (late, expires) = (swarm.files("late"), SystemTime::now() + Duration::from_secs(2));
        let port = free_port();
        let wren = swarm.open("wren", &[port], &[]);
        let listener = wren.listener().unwrap();
        let until_expired = expires.duration_since(SystemTime::now()).unwrap_or_default();
        std::thread::sleep(until_expired);
        let member = swarm.member("kite");
        let strangers = [
            own_program(None, &format!("tcp/127.0.0.1:{port}")),
            own_program(None, &tls(port)),
            own_program(Some(&others.files("kite")), &tls(port)),
            own_program(Some(&late), &tls(port)),
        ];
        let kite = swarm.open("kite", &[], &[port]);
        let kite_hears = kite.listener().unwrap();
        for frame in 1_000..1_020 {
            for stranger in &strangers {
                say(stranger, "kite", frame, Some(&member));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        report_until_heard(&kite, "kite", &listener);
        report_until_heard(&wren, "wren", &kite_hears);
        assert!(frame_of(&listener, "kite").unwrap() < 1_000, "no stranger's report came");
        let (count, why) = wren.refused_links();
        assert!(count >= 3, "{count} links were refused");
        assert!(!why.contains("Hint"), "{why}");
    });
}

#[test]
fn the_revoked_are_heard_no_more() {
    watched(|| {
        let mut swarm = Swarm::new(&["wren", "kite"]);
        let (kite, files) = (swarm.member("kite"), swarm.files("kite"));
        swarm.authority.revoke("kite", utc_s()).unwrap();
        let port = free_port();
        let wren = swarm.open("wren", &[port], &[]);
        let listener = wren.listener().unwrap();
        // It still has its certificate, and links.
        let session = own_program(Some(&files), &tls(port));
        let heard = session.declare_subscriber(format!("flockeye/{SWARM}/wren/**")).wait().unwrap();
        let reporter = wren.reporter().unwrap();
        until(|| {
            say(&session, "kite", 1, Some(&kite));
            reporter.report(report("wren", 1)).unwrap();
            std::thread::sleep(Duration::from_millis(20));
            (listener.snapshot().refused > 2).then_some(())
        });
        assert_eq!(peer(&listener, "kite").map(|peer| peer.alive), None, "it is not on the roster");
        assert!(heard.try_recv().unwrap().is_none(), "and it hears nothing");
    });
}

/// Speaks in the name of wren, whom kite hears, by the link at `port`.
fn assert_no_other_name_helps(
    swarm: &Swarm,
    port: u16,
    kite: &Network,
    wren: &Network,
) -> Listener {
    let listener = kite.listener().unwrap();
    report_until_heard(wren, "wren", &listener);
    let session = own_program(Some(&swarm.files("robin")), &tls(port));
    let robin = swarm.member("robin");
    let mut total = refused(&listener, "wren").total();
    for signer in [Some(&*robin), None] {
        until(|| {
            say(&session, "wren", 1_000, signer);
            std::thread::sleep(Duration::from_millis(20));
            let refused = refused(&listener, "wren");
            assert_eq!(refused.total(), refused.untrusted, "{refused:?}");
            (refused.total() > total + 2).then_some(())
        });
        total = refused(&listener, "wren").total();
    }
    assert_ne!(frame_of(&listener, "wren"), Some(1_000));
    // Its own name is its own.
    until(|| {
        say(&session, "robin", 1_000, Some(&robin));
        std::thread::sleep(Duration::from_millis(20));
        peer(&listener, "robin")
    });
    listener
}

#[test]
fn nobody_speaks_in_anothers_name() {
    watched(|| {
        let swarm = Swarm::new(&["wren", "kite", "robin"]);
        let port = free_port();
        let kite = swarm.open("kite", &[port], &[]);
        let wren = swarm.open("wren", &[], &[port]);
        let listener = assert_no_other_name_helps(&swarm, port, &kite, &wren);
        // A token in another's name does not even come in.
        let session = own_program(Some(&swarm.files("robin")), &tls(port));
        drop(wren);
        until(|| peer(&listener, "wren").filter(|peer| !peer.alive));
        let _token = session.liveliness().declare_token(alive_key(SWARM, "wren")).wait().unwrap();
        let _own = session.liveliness().declare_token(alive_key(SWARM, "robin")).wait().unwrap();
        until(|| peer(&listener, "robin").filter(|peer| peer.alive));
        assert!(!peer(&listener, "wren").unwrap().alive);
    });
}

#[test]
fn nobody_speaks_in_anothers_name_through_a_router() {
    watched(|| {
        let swarm = Swarm::new(&["wren", "kite", "robin"]);
        let port = free_port();
        let _base = swarm.router(port);
        let [kite, wren] = ["kite", "wren"].map(|name| swarm.client(name, port));
        assert_no_other_name_helps(&swarm, port, &kite, &wren);
    });
}

#[test]
fn what_was_recorded_is_not_believed_while_its_drone_is_here_nor_when_it_is_gone() {
    watched(|| {
        let swarm = Swarm::new(&["wren", "kite", "robin"]);
        let port = free_port();
        let kite = swarm.open("kite", &[port], &[]);
        let listener = kite.listener().unwrap();
        let recorder = own_program(Some(&swarm.files("robin")), &tls(port));
        let wren_port = free_port();
        let wren = swarm.open("wren", &[wren_port], &[port]);
        let robin = own_program(Some(&swarm.files("robin")), &tls(wren_port));
        let recorded = robin.declare_subscriber(frame_key(SWARM, "wren")).wait().unwrap();
        report_until_heard(&wren, "wren", &listener);
        let reporter = wren.reporter().unwrap();
        let sample = until(|| {
            reporter.report(report("wren", 500)).unwrap();
            std::thread::sleep(Duration::from_millis(20));
            recorded
                .try_recv()
                .unwrap()
                .filter(|sample| sample.attachment().is_some_and(|seal| seal.len() > 200))
        });
        let play = || {
            let put = recorder.put(sample.key_expr(), sample.payload().clone());
            put.attachment(sample.attachment().cloned()).wait().unwrap();
            std::thread::sleep(Duration::from_millis(20));
        };
        // Newer than what is recorded.
        until(|| {
            reporter.report(report("wren", 600)).unwrap();
            std::thread::sleep(Duration::from_millis(20));
            frame_of(&listener, "wren").filter(|frame| *frame == 600)
        });
        let before = refused(&listener, "wren");
        until(|| {
            play();
            (refused(&listener, "wren").total() > before.total() + 2).then_some(())
        });
        drop(reporter);
        drop(wren);
        until(|| peer(&listener, "wren").filter(|peer| !peer.alive));
        let before = refused(&listener, "wren");
        until(|| {
            play();
            (refused(&listener, "wren").untrusted > before.untrusted + 2).then_some(())
        });
        assert_eq!(frame_of(&listener, "wren"), Some(600));
    });
}

#[test]
fn what_cannot_be_secure_is_refused_before_it_opens() {
    let swarm = Swarm::new(&["wren", "kite"]);
    let refused = |change: &dyn Fn(&mut NetworkParameters)| {
        let mut parameters = swarm.parameters("wren", &[free_port()], &[]);
        change(&mut parameters);
        Network::open(&parameters).expect_err("refused").to_string()
    };
    let message = refused(&|p| p.listen = vec!["tcp/127.0.0.1:0".into()]);
    assert!(message.contains("listen[0]") && message.contains("Cure: tls/"), "{message}");
    let message = refused(&|p| p.security = None);
    assert!(message.contains("needs certificates"), "{message}");
    let message = refused(&|p| p.observer = "kite".into());
    assert!(message.contains("is 'wren', and not 'kite'"), "{message}");
    let message = refused(&|p| p.swarm = "other".into());
    assert!(message.contains("is 'safe', and not 'other'"), "{message}");
    let message = refused(&|p| p.scout_interface = Some("lo".into()));
    assert!(message.contains("multicast"), "{message}");
}
