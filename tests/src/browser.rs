//! A headless Chromium, driven over its DevTools protocol.

use std::fs::File;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use flockeye_require::absent;
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use crate::{Beside, Scratch, WATCHDOG};

/// The name of Chromium in [`flockeye_require::REQUIRE`].
pub const BROWSER: &str = "browser";

/// A browser with one tab. It ends when the value is dropped.
pub struct Browser {
    socket: WebSocket<TcpStream>,
    calls: u64,
    /// Errors of the page: exceptions, refused resources, errors in its log.
    pub complaints: Vec<String>,
    process: Beside,
    _profile: Scratch,
}

impl Browser {
    /// Starts the browser. If there is none, or if it does not start, prints a message and returns
    /// `None`.
    pub fn start() -> Option<Self> {
        let Some(program) = find() else {
            absent(BROWSER, "chromium, which `make setup` installs");
            return None;
        };
        let (process, profile, told) = match launch(&program) {
            Ok(started) => started,
            Err(reason) => {
                absent(BROWSER, &format!("a browser that says its port:\n{reason}"));
                return None;
            }
        };
        let mut chief = connect(told.0, &told.1);
        let targets = call(&mut chief, 1, "Target.getTargets", &json!({}), &mut Vec::new());
        let infos = targets["targetInfos"].as_array().expect("a list").clone();
        let page = infos.iter().find(|info| info["type"] == "page").expect("there is a tab");
        let id = page["targetId"].as_str().expect("a name");
        let socket = connect(told.0, &format!("/devtools/page/{id}"));
        let complaints = Vec::new();
        let mut browser = Self { socket, calls: 0, complaints, process, _profile: profile };
        for domain in ["Runtime", "Log", "Page"] {
            browser.call(&format!("{domain}.enable"), &json!({}));
        }
        Some(browser)
    }

    /// Opens an address.
    pub fn open(&mut self, address: &str) {
        self.call("Page.navigate", &json!({ "url": address }));
    }

    /// The value of a JavaScript expression in the page. Promises are awaited.
    pub fn ask(&mut self, expression: &str) -> Value {
        let asked = json!({
            "expression": expression, "awaitPromise": true, "returnByValue": true,
        });
        let answer = self.call("Runtime.evaluate", &asked);
        assert!(answer.get("exceptionDetails").is_none(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is neither null nor false, and returns it.
    pub fn wait_for(&mut self, expression: &str) -> Value {
        let start = Instant::now();
        loop {
            // An expression may fail while the page is loading.
            let value = self.ask(&format!(
                "(() => {{ try {{ return {expression} }} catch {{ return null }} }})()"
            ));
            if !matches!(value, Value::Null | Value::Bool(false)) {
                return value;
            }
            assert!(
                start.elapsed() < WATCHDOG,
                "waited for {expression} in vain: {:?}",
                self.complaints
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Presses a key, with its names in DevTools.
    pub fn press(&mut self, key: &str, code: &str) {
        for kind in ["keyDown", "keyUp"] {
            self.call("Input.dispatchKeyEvent", &json!({ "type": kind, "key": key, "code": code }));
        }
    }

    /// Clicks with the mouse, at a place of the window, pixels.
    pub fn click(&mut self, x: f64, y: f64) {
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({ "type": kind, "x": x, "y": y, "button": "left", "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", &event);
        }
    }

    fn call(&mut self, method: &str, parameters: &Value) -> Value {
        self.calls += 1;
        call(&mut self.socket, self.calls, method, parameters, &mut self.complaints)
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The browser is closed by a command. If killed, it leaves children that write to the
        // profile while it is removed.
        let asked = json!({ "id": self.calls + 1, "method": "Browser.close" });
        if self.socket.send(Message::text(asked.to_string())).is_ok() {
            let start = Instant::now();
            while start.elapsed() < END && !self.process.has_ended() {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

fn find() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|folder| folder.join("chromium")).find(|file| file.is_file())
}

fn connect(port: u16, path: &str) -> WebSocket<TcpStream> {
    let stream = TcpStream::connect(("127.0.0.1", port)).expect("the browser listens");
    stream.set_read_timeout(Some(WATCHDOG)).expect("a socket has a timeout");
    let address = format!("ws://127.0.0.1:{port}{path}");
    tungstenite::client(address, stream).expect("the browser talks").0
}

fn call(
    socket: &mut WebSocket<TcpStream>,
    id: u64,
    method: &str,
    parameters: &Value,
    complaints: &mut Vec<String>,
) -> Value {
    let asked = json!({ "id": id, "method": method, "params": parameters });
    socket.send(Message::text(asked.to_string())).expect("the browser listens");
    loop {
        let Message::Text(text) = socket.read().expect("the browser answers") else { continue };
        let message: Value = serde_json::from_str(text.as_str()).expect("JSON");
        if message["id"] == id {
            assert!(message.get("error").is_none(), "{method}: {message}");
            return message["result"].clone();
        }
        let parameters = &message["params"];
        let is_complaint = match message["method"].as_str() {
            Some("Runtime.exceptionThrown") => true,
            Some("Log.entryAdded") => parameters["entry"]["level"] == "error",
            Some("Runtime.consoleAPICalled") => parameters["type"] == "error",
            _ => false,
        };
        if is_complaint {
            complaints.push(parameters.to_string());
        }
    }
}

/// Timeout for a browser to print its port.
const START: Duration = Duration::from_secs(60);
/// Timeout for a browser to end by itself.
const END: Duration = Duration::from_secs(10);

/// Starts a browser. Returns its process, its profile, and its port with the path of its socket.
/// The error is its output.
fn launch(program: &Path) -> Result<(Beside, Scratch, (u16, String)), String> {
    let profile = Scratch::new("browser");
    let complaints = profile.path("stderr");
    let mut command = Command::new(program);
    command.args(["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--mute-audio"]);
    // WebGL runs on the processor, so that no GPU is needed.
    command.args(["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]);
    command.args(["--no-first-run", "--window-size=1000,700"]);
    // Disables everything but the page: updates, crash reports, and access to the desktop and the
    // network.
    command.args([
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]);
    command.args(["--disable-quic", "--no-proxy-server", "--disable-breakpad"]);
    command.args(["--password-store=basic"]).env("DBUS_SESSION_BUS_ADDRESS", "disabled:");
    command.arg("--remote-debugging-port=0");
    command.arg(format!("--user-data-dir={}", profile.path("").display()));
    // Temporary folders are in the profile, and are removed with it.
    command.arg("about:blank").env("TMPDIR", profile.path("")).stdout(Stdio::null());
    command.stderr(File::create(&complaints).expect("a temporary file can be made"));
    let mut process = Beside::start(command);
    let port_file = profile.path("DevToolsActivePort");
    let start = Instant::now();
    while start.elapsed() < START && !process.has_ended() {
        let text = std::fs::read_to_string(&port_file).unwrap_or_default();
        if let Some((port, path)) = text.split_once('\n')
            && let Ok(port) = port.trim().parse()
            && !path.trim().is_empty()
        {
            return Ok((process, profile, (port, path.trim().to_owned())));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let said = std::fs::read_to_string(&complaints).unwrap_or_default();
    let has_ended = if process.has_ended() { "it ended" } else { "it still runs" };
    Err(format!("{said:.4000}\n{has_ended}"))
}
