//! The terminal: log lines scroll above, a live table stays below.

use std::collections::VecDeque;
use std::io::{self, IsTerminal, Write};

/// Lines that a muted screen keeps.
const KEPT_LINES: usize = 40;

/// Standard output, with an optional live table at its end.
pub struct Screen {
    is_terminal: bool,
    table_lines: usize,
    /// The last lines of a muted screen.
    kept: Option<VecDeque<String>>,
}

impl Screen {
    /// A screen that shows everything.
    pub fn new() -> Self {
        Self { is_terminal: io::stdout().is_terminal(), table_lines: 0, kept: None }
    }

    /// A screen that shows nothing and keeps the last lines, for error messages.
    pub fn muted() -> Self {
        Self { is_terminal: false, table_lines: 0, kept: Some(VecDeque::new()) }
    }

    /// The lines that were kept.
    pub fn kept(&self) -> String {
        self.kept.iter().flatten().fold(String::new(), |text, line| text + line + "\n")
    }

    /// Whether output goes to a terminal, so that a live table makes sense.
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
        // Lines that wrap would not be erased completely.
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
        // A closed pipe (`flockeye up | head`) must not stop the run.
        let mut out = io::stdout().lock();
        drop(out.write_all(text.as_bytes()).and_then(|()| out.flush()));
    }
}

impl Default for Screen {
    fn default() -> Self {
        Self::new()
    }
}
