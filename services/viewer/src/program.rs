//! The command line of `flockeye view`.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Parser;
use flockeye_cli::running::{PipelineChoice, choose};
use flockeye_cli::{Screen, signals};
use rustix::process::setpriority_process;

use crate::audience::Audience;
use crate::explaining::Explainer;
use crate::foxglove_view::FoxgloveView;
use crate::pages::Pages;
use crate::recorded::overview::OverviewMaker;
use crate::recorded::{Recorded, foxglove_player, player};
use crate::request::{Access, is_token};
use crate::server;
use crate::watch::PipelineWatch;
use crate::wire::TextMessage;

/// The view's nice value: the pipeline has priority.
const NICE: i32 = 10;
/// Period at which an unfinished overview is shown.
const OVERVIEW_PERIOD: Duration = Duration::from_millis(500);
/// Period of the check of the stop flag.
const IDLE_PERIOD: Duration = Duration::from_millis(100);

/// Show what a running pipeline sees, or what a recorded one saw, on a page in the browser.
#[derive(Debug, Parser)]
#[command(name = "flockeye view", version)]
pub struct ViewArguments {
    /// A recording, in place of a running pipeline.
    #[arg(value_name = "FILE.mcap", conflicts_with = "instance")]
    pub file: Option<PathBuf>,
    /// Which pipeline.
    #[command(flatten)]
    pub running: PipelineChoice,
    /// Where the page is served. Other machines reach it at another address than loopback, with
    /// --token.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8760")]
    pub listen: SocketAddr,
    /// What a page must know to be shown anything: 8 to 128 letters, digits, `-`, `_`, `.` or `~`.
    #[arg(long, value_name = "TOKEN")]
    pub token: Option<String>,
    /// Also serve Foxglove and Lichtblick here. Loopback only: their protocol has no token.
    #[arg(long, value_name = "ADDRESS:PORT")]
    pub foxglove: Option<SocketAddr>,
    /// Pictures a second, at most: 0.5 to 60.
    #[arg(long, value_name = "RATE", default_value_t = 15.0)]
    pub rate: f64,
}

/// Serves the page until Ctrl-C.
///
/// # Errors
/// No such pipeline runs, the recording cannot be shown, or the address cannot be served.
pub fn run() -> anyhow::Result<()> {
    let arguments = ViewArguments::parse();
    let access = access(&arguments)?;
    let stopping = signals::stop_flag()?;
    match &arguments.file {
        Some(file) => show_recording(&arguments, access, file, &stopping),
        None => show_pipeline(&arguments, access, stopping),
    }
}

fn show_pipeline(
    arguments: &ViewArguments,
    access: Access,
    stopping: Arc<AtomicBool>,
) -> anyhow::Result<()> {
    let instance = choose(&arguments.running)?;
    give_way();
    let pages = Arc::new(Pages::default());
    let explainer = Explainer::of_pipeline(instance.clone());
    let page = serve(arguments, access, pages.clone(), explainer)?;
    let mut screen = Screen::new();
    let mut foxglove = None;
    if let Some(address) = arguments.foxglove {
        let (view, port) = FoxgloveView::start(address, &instance)?;
        screen.line(&format!("Foxglove and Lichtblick connect to ws://{}:{port}", address.ip()));
        foxglove = Some(view);
    }
    screen.line(&format!("the view of '{}' is at {page}", instance.name()));
    PipelineWatch::new(instance, Audience { pages, foxglove }, arguments.rate, stopping).run();
    Ok(())
}

fn show_recording(
    arguments: &ViewArguments,
    access: Access,
    file: &Path,
    stopping: &AtomicBool,
) -> anyhow::Result<()> {
    give_way();
    let recorded = Arc::new(Recorded::open(file, arguments.rate)?);
    let mut screen = Screen::new();
    if !recorded.trouble.is_empty() {
        screen.line(&recorded.trouble);
    }
    let played = recorded.clone();
    let start = move |page| player::start(played.clone(), page);
    let pages = Arc::new(Pages::with_players(Box::new(start)));
    pages.tell(&TextMessage::Hello(&recorded.hello));
    pages.tell(&TextMessage::Status { running: true, trouble: &recorded.trouble });
    let page = serve(arguments, access, pages.clone(), Explainer::of_recording(file))?;
    if let Some(address) = arguments.foxglove {
        let port = foxglove_player::start(address, recorded.clone())?;
        screen.line(&format!("Foxglove and Lichtblick connect to ws://{}:{port}", address.ip()));
    }
    screen.line(&format!("the view of {} is at {page}", file.display()));
    let is_stopping = || stopping.load(Ordering::Relaxed);
    let mut maker = OverviewMaker::new(&recorded);
    let mut shown_at = Instant::now();
    while !is_stopping() && maker.read() {
        if shown_at.elapsed() > OVERVIEW_PERIOD {
            shown_at = Instant::now();
            pages.tell(&TextMessage::Overview(&maker.overview()));
        }
    }
    pages.tell(&TextMessage::Overview(&maker.overview()));
    while !is_stopping() {
        std::thread::sleep(IDLE_PERIOD);
    }
    Ok(())
}

fn give_way() {
    if let Err(refused) = setpriority_process(None, NICE) {
        tracing::warn!("nice {NICE} is refused ({refused}): the view competes with the pipeline");
    }
}

/// Serves the page, in threads of its own. Returns its address.
fn serve(
    arguments: &ViewArguments,
    access: Access,
    pages: Arc<Pages>,
    explainer: Explainer,
) -> anyhow::Result<String> {
    let token = access.token.clone();
    let bound = server::start(arguments.listen, access, pages, explainer).with_context(|| {
        format!("cannot serve {}. Cure: --listen with another port", arguments.listen)
    })?;
    Ok(address(bound, token.as_deref()))
}

/// Decides which requests are served.
fn access(arguments: &ViewArguments) -> anyhow::Result<Access> {
    let ViewArguments { listen, token, rate, foxglove, .. } = arguments;
    ensure!((0.5..=60.0).contains(rate), "--rate {rate}: 0.5 to 60 pictures a second are allowed");
    if let Some(token) = token {
        ensure!(
            is_token(token),
            "--token has 8 to 128 letters, digits, '-', '_', '.' or '~', because it stands in an address"
        );
    }
    if let Some(address) = foxglove {
        ensure!(
            address.ip().is_loopback(),
            "--foxglove {address} is not loopback, and Foxglove's protocol has no token. Cure: 127.0.0.1:{port}, \
             and `ssh -L {port}:127.0.0.1:{port} DRONE` from elsewhere",
            port = address.port()
        );
    }
    let is_loopback = listen.ip().is_loopback();
    ensure!(
        is_loopback || token.is_some(),
        "{} is not loopback: others could watch. Cure: --token SOMETHING-LONG, or --listen 127.0.0.1:{}",
        listen.ip(),
        listen.port()
    );
    Ok(Access { token: token.clone(), is_loopback })
}

/// The page's address. The browser never sends the part behind `#`, so the token is in no request
/// for a file.
fn address(bound: SocketAddr, token: Option<&str>) -> String {
    let host = match bound.ip() {
        IpAddr::V4(address) if address.is_unspecified() => "THIS-MACHINE".to_owned(),
        IpAddr::V6(address) if address.is_unspecified() => "THIS-MACHINE".to_owned(),
        IpAddr::V6(address) => format!("[{address}]"),
        IpAddr::V4(address) => address.to_string(),
    };
    let fragment = token.map(|token| format!("#token={token}")).unwrap_or_default();
    format!("http://{host}:{}/{fragment}", bound.port())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use clap::CommandFactory;

    fn parsed(arguments: &[&str]) -> ViewArguments {
        ViewArguments::parse_from([&["view"], arguments].concat())
    }

    #[test]
    fn the_command_line_is_well_formed() {
        ViewArguments::command().debug_assert();
    }

    #[test]
    fn only_loopback_needs_no_token() {
        assert!(access(&parsed(&[])).unwrap().is_loopback);
        assert!(access(&parsed(&["--listen", "[::1]:80"])).is_ok());
        let refused = |arguments: &[&str]| access(&parsed(arguments)).unwrap_err().to_string();
        let open = refused(&["--listen", "0.0.0.0:8760"]);
        assert!(
            open.contains("0.0.0.0 is not loopback") && open.contains("Cure: --token"),
            "{open}"
        );
        assert!(refused(&["--token", "short"]).contains("8 to 128"));
        assert!(
            refused(&["--foxglove", "0.0.0.0:8765"]).contains("no token. Cure: 127.0.0.1:8765")
        );
        let both = ViewArguments::try_parse_from(["view", "flight.mcap", "--instance", "field"]);
        assert!(both.unwrap_err().to_string().contains("cannot be used with"));
        assert!(refused(&["--rate", "0"]).contains("0.5 to 60"));
        let guarded =
            access(&parsed(&["--listen", "10.0.0.7:1", "--token", "open-sesame"])).unwrap();
        assert_eq!(guarded, Access { token: Some("open-sesame".into()), is_loopback: false });
    }

    #[test]
    fn the_printed_address_opens_the_page() {
        let local = "127.0.0.1:8760".parse().unwrap();
        assert_eq!(address(local, None), "http://127.0.0.1:8760/");
        let other = "[2001:db8::1]:80".parse().unwrap();
        assert_eq!(
            address(other, Some("open-sesame")),
            "http://[2001:db8::1]:80/#token=open-sesame"
        );
    }
}
