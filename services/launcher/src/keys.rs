//! `flockeye keys`: the swarm's authority, and its members' keys and certificates.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use clap::{Args, Subcommand};
use flockeye_cli::text_table::TextTable;
use flockeye_cli::{Screen, duration};
use flockeye_identity::{Authority, Issued, MemberFiles, Role};
use flockeye_network::router_config;
use flockeye_runtime::clock::utc_s;

/// Default validity of a certificate.
const HOLDS: &str = "30days";
/// Seconds of a day.
const DAY_S: f64 = 86_400.0;

/// What to do with keys.
#[derive(Debug, Subcommand)]
pub(crate) enum KeysCommand {
    /// Make the authority of a new swarm. Keep its folder where no drone is.
    Init {
        /// The swarm's name, as `observer.swarm` has it.
        #[arg(long, value_name = "NAME")]
        swarm: String,
        #[command(flatten)]
        authority: AuthorityChoice,
    },
    /// Make a key and a certificate for a drone, an onlooker or a router, or renew them.
    Issue {
        /// The name, as `observer.name` has it.
        name: String,
        #[command(flatten)]
        authority: AuthorityChoice,
        /// The folder for its files. Without it: one of its name.
        #[arg(long, value_name = "FOLDER")]
        into: Option<PathBuf>,
        /// How long the certificate holds: 12h, 30days.
        #[arg(long = "for", value_name = "DURATION", value_parser = duration, default_value = HOLDS)]
        holds: Duration,
        /// It is a router: it passes on what others say.
        #[arg(long)]
        router: bool,
    },
    /// Take somebody off the roster, and revoke all its certificates.
    Revoke {
        /// Whom.
        name: String,
        #[command(flatten)]
        authority: AuthorityChoice,
    },
    /// Show who belongs to the swarm, and until when.
    List(AuthorityChoice),
    /// Print the configuration of a router (zenohd) for the roster of now.
    Rules(AuthorityChoice),
}

/// Where the authority is.
#[derive(Debug, Args)]
pub(crate) struct AuthorityChoice {
    /// The authority's folder.
    #[arg(long, value_name = "FOLDER", default_value = "authority")]
    authority: PathBuf,
}

pub(crate) fn run(command: &KeysCommand) -> anyhow::Result<()> {
    match command {
        KeysCommand::Init { swarm, authority } => init(swarm, &authority.authority),
        KeysCommand::Issue { name, authority, into, holds, router } => {
            let into = into.clone().unwrap_or_else(|| PathBuf::from(name));
            let role = if *router { Role::Router } else { Role::Member };
            issue(authority, name, role, *holds, &into)
        }
        KeysCommand::Revoke { name, authority } => revoke(name, authority),
        KeysCommand::List(choice) => list(choice),
        KeysCommand::Rules(choice) => {
            Screen::new().line(router_text(&open(choice)?)?.trim_end());
            Ok(())
        }
    }
}

fn init(swarm: &str, folder: &Path) -> anyhow::Result<()> {
    Authority::create(folder, swarm)?;
    Screen::new().line(&format!(
        "{} is the authority of the swarm '{swarm}'. Whoever has ca.key can speak in every name: keep it where no drone \
         is, and have a copy.\nNext: flockeye keys issue NAME",
        folder.display()
    ));
    Ok(())
}

fn issue(
    choice: &AuthorityChoice,
    name: &str,
    role: Role,
    holds: Duration,
    into: &Path,
) -> anyhow::Result<()> {
    let mut authority = open(choice)?;
    let before = authority.roster().number;
    let (issued, files) = authority.issue(name, role, holds, into, utc_s())?;
    let mut screen = Screen::new();
    screen.line(&format!("{}: holds {}", into.display(), left(&issued)));
    if role == Role::Router {
        let path = into.join("zenohd.json5");
        std::fs::write(&path, router_text(&authority)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
        screen.line("on the router: cd to this folder, and zenohd -c zenohd.json5");
    } else {
        screen.line(&settings(&files));
    }
    if authority.roster().number != before {
        say_roster_changed(&mut screen, &authority);
    }
    Ok(())
}

/// Settings that pipeline.yaml needs.
fn settings(files: &MemberFiles) -> String {
    let MemberFiles { ca, certificate, key, roster } = files;
    let line = |key: &str, path: &Path| format!("\n    {key}: {}", path.display());
    format!(
        "in its pipeline.yaml:\ngateway:\n  security:{}{}{}{}",
        line("ca", ca),
        line("certificate", certificate),
        line("key", key),
        line("roster", roster)
    )
}

fn say_roster_changed(screen: &mut Screen, authority: &Authority) {
    screen.line(&format!(
        "The roster has changed. Copy {} to all others, then on each: flockeye restart gateway. Routers: flockeye \
         keys rules > zenohd.json5, and start them again.",
        authority.roster_path().display()
    ));
}

fn revoke(name: &str, choice: &AuthorityChoice) -> anyhow::Result<()> {
    let mut authority = open(choice)?;
    let count = authority.revoke(name, utc_s())?;
    let mut screen = Screen::new();
    screen.line(&format!("{name} is off the roster, and {count} of its certificates are revoked"));
    say_roster_changed(&mut screen, &authority);
    Ok(())
}

fn list(choice: &AuthorityChoice) -> anyhow::Result<()> {
    let authority = open(choice)?;
    let roster = authority.roster();
    let mut table = TextTable::new(4, &["name", "is", "serial", "holds"]);
    for issued in authority.issued()? {
        let is = if roster.is_revoked(&issued.serial) {
            "revoked"
        } else if roster.members.contains(&issued.name) {
            "member"
        } else if roster.routers.contains(&issued.name) {
            "router"
        } else {
            "gone"
        };
        table.row([issued.name.clone(), is.into(), issued.serial.clone(), left(&issued)]);
    }
    let mut screen = Screen::new();
    screen.line(&format!("swarm {}, roster {}", roster.swarm, roster.number));
    screen.table(&table.text());
    Ok(())
}

fn open(choice: &AuthorityChoice) -> anyhow::Result<Authority> {
    let cure =
        "there is no authority here. Cure: flockeye keys init --swarm NAME, or --authority FOLDER";
    Authority::open(&choice.authority).context(cure)
}

/// A router's configuration, whose files are beside it.
fn router_text(authority: &Authority) -> anyhow::Result<String> {
    let file = |name: &str| PathBuf::from(name);
    let files = MemberFiles {
        ca: file("ca.pem"),
        certificate: file("certificate.pem"),
        key: file("key.pem"),
        roster: file("roster.json"),
    };
    let config = router_config(files, authority.roster());
    Ok(serde_json::to_string_pretty(&config)? + "\n")
}

/// Remaining validity of a certificate.
fn left(issued: &Issued) -> String {
    let days = (issued.not_after_s - utc_s()) as f64 / DAY_S;
    if days < 0.0 { "no longer".into() } else { format!("{days:.1} days") }
}
