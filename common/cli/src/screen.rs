//! The terminal: log lines run above, the table stays below.

use std::collections::VecDeque;
use std::io::{self, IsTerminal, Write};

/// Lines that a screen without a terminal keeps.
const KEPT_LINES: usize = 40;

/// Where the launcher shows what goes on.
pub struct Screen {
    is_terminal: bool,
    table_lines: usize,
    /// The last lines, where they are kept instead of shown.
    kept: Option<VecDeque<String>>,
}

impl Screen {
    /// Standard output.
    pub fn new() -> Self {
        Self { is_terminal: io::stdout().is_terminal(), table_lines: 0, kept: None }
    }

    /// One that shows nothing and keeps the last lines, for when something goes wrong.
    pub fn muted() -> Self {
        Self { is_terminal: false, table_lines: 0, kept: Some(VecDeque::new()) }
    }

    /// The lines that were kept.
    pub fn kept(&self) -> String {
        self.kept.iter().flatten().fold(String::new(), |text, line| text + line + "\n")
    }

    /// Whether somebody is looking, so that a live table makes sense.
    pub fn is_live(&self) -> bool {
        self.is_terminal
    }

    /// Shows a line that stays.
    pub fn line(&mut self, text: &str) {
        if let Some(kept) = &mut self.kept {
            if kept.len() == KEPT_LINES {
                kept.pop_front();
            }
            return kept.push_back(text.to_owned());
        }
        self.show(&format!("{}{text}\n", self.erasure()));
        self.table_lines = 0;
    }

    /// Shows a table in place of the last one.
    pub fn table(&mut self, text: &str) {
        let width = rustix::termios::tcgetwinsize(io::stdout())
            .map_or(80, |size| usize::from(size.ws_col).max(20));
        // A line that wraps would not be erased as one.
        let lines: Vec<String> =
            text.lines().map(|line| line.chars().take(width - 1).collect()).collect();
        self.show(&format!("{}{}\n", self.erasure(), lines.join("\n")));
        self.table_lines = lines.len();
    }

    fn erasure(&self) -> String {
        if self.table_lines == 0 {
            String::new()
        } else {
            format!("\x1b[{}A\x1b[J", self.table_lines)
        }
    }

    fn show(&self, text: &str) {
        // A closed pipe (`flockeye up | head`) is no reason to stop flying.
        let mut out = io::stdout().lock();
        drop(out.write_all(text.as_bytes()).and_then(|()| out.flush()));
    }
}

impl Default for Screen {
    fn default() -> Self {
        Self::new()
    }
}
