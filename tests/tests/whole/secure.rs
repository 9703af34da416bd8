//! A secure swarm, made with the commands that its operator uses.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use flockeye_require::loopback::free_port;
use flockeye_runtime::lock::lock;
use flockeye_tests::{Beside, Flight, Scratch, flockeye, run, succeeds, told, unique};
use rustix::process::Signal;

use crate::python::{example, python};

/// The keys that an operator has made before the flight.
struct Keys {
    folder: Scratch,
}

impl Keys {
    /// An authority, two drones and a router.
    fn new() -> Self {
        let keys = Self { folder: Scratch::new("keys") };
        keys.run(&["init", "--swarm", "alps"]);
        for name in ["wren", "kite", "ground"] {
            let said = keys.run(&["issue", name, "--into", &keys.path(name)]);
            assert!(
                said.contains("security:") && said.contains("The roster has changed"),
                "{said}"
            );
        }
        keys.run(&["issue", "base", "--router", "--into", &keys.path("base"), "--for", "2h"]);
        keys.hand_out();
        keys
    }

    fn path(&self, name: &str) -> String {
        self.folder.path(name).display().to_string()
    }

    fn run(&self, arguments: &[&str]) -> String {
        let authority = self.path("authority");
        let whole = [&["keys"], arguments, &["--authority", &authority]].concat();
        succeeds(&whole)
    }

    /// Copies the roster of now to all.
    fn hand_out(&self) {
        let roster = self.folder.path("authority/roster.json");
        for name in ["wren", "kite", "ground", "base"] {
            fs::copy(&roster, self.folder.path(name).join("roster.json")).expect("copied");
        }
    }

    /// Starts the router with the configuration that was made for it, on another port.
    fn router(&self, port: u16) -> Router {
        fs::write(Path::new(&self.path("base")).join("zenohd.json5"), self.run(&["rules"]))
            .expect("written");
        let config: PathBuf = self.folder.path("base/zenohd.json5");
        let text = fs::read_to_string(&config).expect("it was written");
        let text = text.replace("tls/[::]:7447", &format!("tls/127.0.0.1:{port}"));
        fs::write(&config, text).expect("written");
        Router::start(self.path("base").into())
    }

    /// Starts a drone that links with the router.
    fn fly(&self, name: &str, sees: &str, router: u16) -> Flight {
        let mut set = told::settings(50, &[sees]);
        set.extend([
            format!("observer.name={name}"),
            "observer.swarm=alps".to_owned(),
            "gateway.mode=client".to_owned(),
            "gateway.listen=[]".to_owned(),
            format!("gateway.connect=[tls/127.0.0.1:{router}]"),
        ]);
        let files = ["ca.pem", "certificate.pem", "key.pem", "roster.json"];
        let path = |file| format!("{}/{file}", self.path(name));
        let [ca, certificate, key, roster] = files.map(path);
        set.push(format!(
            "gateway.security={{ca: {ca}, certificate: {certificate}, key: {key}, roster: {roster}}}"
        ));
        let set: Vec<&str> = set.iter().map(String::as_str).collect();
        Flight::start(name, &[], &set)
    }
}

/// A router that is started again when it dies, as docs/SECURITY.md asks for: Zenoh's TLS links may
/// end their process.
struct Router {
    process: Arc<Mutex<Beside>>,
    is_over: Arc<AtomicBool>,
    keeper: Option<JoinHandle<()>>,
}

impl Router {
    /// Largest number of starts. A router that cannot start must not be tried for ever.
    const STARTS: usize = 10;

    /// With the configuration in `folder`.
    fn start(folder: PathBuf) -> Self {
        let start = move || {
            let mut command = Command::new(flockeye().with_file_name("zenoh-router"));
            command.arg("zenohd.json5").current_dir(&folder);
            Beside::start(command)
        };
        let process = Arc::new(Mutex::new(start()));
        let is_over = Arc::new(AtomicBool::new(false));
        let keeper = std::thread::spawn({
            let (process, is_over) = (process.clone(), is_over.clone());
            move || {
                let mut starts = 1;
                while !is_over.load(Relaxed) && starts < Self::STARTS {
                    let mut process = lock(&process);
                    if process.has_ended() {
                        println!("the router is started again");
                        *process = start();
                        starts += 1;
                    }
                    drop(process);
                    std::thread::sleep(Duration::from_millis(50));
                }
            }
        });
        Self { process, is_over, keeper: Some(keeper) }
    }

    /// Lets it die.
    fn kill(&self) {
        lock(&self.process).kill();
    }
}

impl Drop for Router {
    fn drop(&mut self) {
        self.is_over.store(true, Relaxed);
        // A keeper that panicked has said so.
        self.keeper.take().map(JoinHandle::join);
    }
}

/// Looks on from the place of a drone.
fn look_on(flight: &Flight) -> Flight {
    let mut command = Command::new(flockeye());
    command.args(["peers", "--json", "--instance", flight.instance.name()]);
    Flight::launch(&unique("look"), command)
}

#[test]
fn drones_with_certificates_hear_each_other_until_one_is_revoked() {
    let keys = Keys::new();
    let port = free_port();
    let _router = keys.router(port);
    let wren = keys.fly("wren", "kite", port);
    let mut kite = keys.fly("kite", "wren", port);
    // A gateway reports its neighbours once it runs.
    kite.wait_for("wren confirmed");
    let mut look = look_on(&kite);
    look.wait_for("\"observer\":\"wren\"");
    drop(look);

    let said = keys.run(&["revoke", "wren"]);
    assert!(said.contains("1 of its certificates"), "{said}");
    assert!(keys.run(&["list"]).contains("revoked"));
    keys.hand_out();
    succeeds(&["restart", "gateway", "--instance", kite.instance.name()]);
    // The router does not know it yet, and passes on what wren says; its signature tells.
    kite.wait_for("the certificate of 'wren' is revoked");
    for mut flight in [wren, kite] {
        flight.signal(Signal::TERM);
        flight.wait();
        flight.assert_nothing_left();
    }
}

#[test]
fn drones_link_again_with_a_router_that_died() {
    let keys = Keys::new();
    let port = free_port();
    let router = keys.router(port);
    let mut wren = keys.fly("wren", "kite", port);
    let mut kite = keys.fly("kite", "wren", port);
    kite.wait_for("wren confirmed");
    look_on(&kite).wait_for("\"observer\":\"wren\"");
    router.kill();
    // An onlooker starts with nothing, so what it hears has come through the new router.
    look_on(&kite).wait_for("\"observer\":\"wren\"");
    look_on(&wren).wait_for("\"observer\":\"kite\"");
    for flight in [&mut wren, &mut kite] {
        flight.signal(Signal::TERM);
        flight.wait();
        flight.assert_nothing_left();
    }
}

/// The module for peers checks signatures too.
#[test]
fn a_program_in_python_hears_members_alone() {
    let Some(python) = python() else { return };
    let keys = Keys::new();
    let port = free_port();
    let _router = keys.router(port);
    let mut wren = keys.fly("wren", "kite", port);
    let hear = |folder: &str| {
        let mut command = Command::new(&python);
        command.arg(example("peers.py")).args([&format!("tls/127.0.0.1:{port}"), "alps", folder]);
        Flight::launch(&unique("hear"), command)
    };
    hear(&keys.path("ground")).wait_for("wren sees kite at 1.000 0.000 0.000 m");
    let refused = Command::new(&python).args(["-c", UNTRUSTED_IN_PYTHON, &keys.path("")]).output();
    let refused = refused.expect("Python runs");
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(refused.status.success(), "{said}");
    wren.signal(Signal::TERM);
    wren.wait();
    wren.assert_nothing_left();
}

const UNTRUSTED_IN_PYTHON: &str = r#"
import random, sys
from pathlib import Path
from flockeye_trust import Presence, Security, Trust, Untrusted
folder = Path(sys.argv[1])
trust = Trust(Security.of_folder(folder / "ground"))
key = "flockeye/alps/wren/sees"
random.seed(1)
for k in range(2000):
    seal = bytes([1]) + random.randbytes(random.randrange(600))
    try:
        trust.check(key, b"pose", seal if k % 9 else None)
        raise SystemExit("taken")
    except Untrusted:
        pass
roster = folder / "ground" / "roster.json"
roster.write_text(roster.read_text().replace("kite", "hawk"))
try:
    Trust(Security.of_folder(folder / "ground"))
    raise SystemExit("a changed roster was taken")
except Untrusted:
    pass
presence, second = Presence(), 1_000_000_000
assert not presence.believes("wren", 5 * second, 0) and presence.needs_question("wren", 0)
assert not presence.needs_question("wren", 0.1), "it was asked just now"
presence.answered("wren", 10 * second, 0)
assert not presence.believes("wren", 9 * second, 0.3), "recorded before the answer"
assert presence.believes("wren", 11 * second, 1) and not presence.believes("wren", 11 * second, 1.1), "said twice"
assert not presence.believes("wren", 12 * second, 3.5), "held back"
assert not presence.believes("wren", 15 * second, 5) and presence.needs_question("wren", 5), "silent"
presence.answered("wren", 3 * second, 5.1)
assert presence.believes("wren", 4 * second, 6.1), "its clock was set back"
"#;

/// Keys that do not hold ground nobody: the rest of the pipeline flies, and the gateway waits for
/// better ones.
#[test]
fn an_expired_certificate_costs_the_network_alone() {
    let keys = Keys::new();
    keys.run(&["issue", "wren", "--into", &keys.path("wren"), "--for", "1s"]);
    std::thread::sleep(Duration::from_secs(2));
    let mut wren = keys.fly("wren", "kite", free_port());
    wren.wait_for("it has expired");
    wren.wait_for("kite confirmed");
    wren.signal(Signal::TERM);
    wren.wait();
    wren.assert_nothing_left();
}

#[test]
fn a_gateway_without_valid_keys_says_so_before_the_flight() {
    let keys = Keys::new();
    let files = ["ca", "certificate", "roster"].map(|file| {
        let end = if file == "roster" { "json" } else { "pem" };
        format!("{file}: {}/{file}.{end}", keys.path("wren"))
    });
    let check = |key: &str, name: &str| {
        let security = format!("gateway.security={{{}, key: {key}}}", files.join(", "));
        let name = format!("observer.name={name}");
        let set = [&*security, &*name, "observer.swarm=alps", "gateway.listen=[tls/127.0.0.1:0]"];
        let arguments: Vec<&str> = set.iter().flat_map(|set| ["--set", *set]).collect();
        run(&[&["check"], &*arguments].concat())
    };
    let (succeeded, output) = check(&(keys.path("wren") + "/key.pem"), "wren");
    assert!(succeeded, "{output}");
    let (succeeded, output) = check(&(keys.path("kite") + "/key.pem"), "wren");
    assert!(!succeeded && output.contains("it is not the key of"), "{output}");
    let (succeeded, output) = check(&(keys.path("wren") + "/key.pem"), "kite");
    assert!(!succeeded && output.contains("is 'wren', and not 'kite'"), "{output}");
}
