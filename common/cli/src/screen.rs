//! Output of a command. On a terminal log lines scroll above and a live table stays below. Under
//! systemd lines go to the journal, with their stage as a field.

use std::collections::VecDeque;
use std::io::{self, IsTerminal, Write};

use libsystemd::logging::{Priority, connected_to_journal, journal_send};

/// Number of lines that a muted screen keeps.
const KEPT_LINES: usize = 40;

/// Standard output with an optional live table at its end, or the journal.
pub struct Screen {
    is_terminal: bool,
    /// Whether lines go to the journal's socket, so that they can have fields.
    is_journal: bool,
    table_lines: usize,
    /// The last lines of a muted screen.
    kept: Option<VecDeque<String>>,
}

impl Screen {
    /// A screen that shows everything.
    pub fn new() -> Self {
        Self {
            is_terminal: io::stdout().is_terminal(),
            is_journal: connected_to_journal(),
            table_lines: 0,
            kept: None,
        }
    }

    /// A screen that shows nothing and keeps the last lines, for error messages.
    pub fn muted() -> Self {
        Self { is_terminal: false, is_journal: false, table_lines: 0, kept: Some(VecDeque::new()) }
    }

    /// The lines that were kept.
    pub fn kept(&self) -> String {
        self.kept.iter().flatten().fold(String::new(), |text, line| text + line + "\n")
    }

    /// Whether output goes to a terminal, which can show a live table.
    pub fn is_live(&self) -> bool {
        self.is_terminal
    }

    /// Whether lines go to systemd's journal, which stamps them itself.
    pub fn is_journal(&self) -> bool {
        self.is_journal
    }

    /// Shows a line that a process of the pipeline wrote at `at_s`, the time of the run. `label` is
    /// its stage, with the worker's number if there are several (`detection.1`).
    pub fn stage_line(&mut self, at_s: f64, label: &str, text: &str) {
        if self.is_journal && self.kept.is_none() {
            let (stage, worker) = label.split_once('.').unwrap_or((label, "0"));
            let (priority, message) = priority_of(text);
            let fields = [
                ("SYSLOG_IDENTIFIER", "flockeye"),
                ("FLOCKEYE_STAGE", stage),
                ("FLOCKEYE_WORKER", worker),
            ];
            if journal_send(priority, message, fields.into_iter()).is_ok() {
                return;
            }
            // Standard output is the journal's other input, which has no fields.
        }
        self.line(&format!("{at_s:>8.3} {label:<14} {text}"));
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

/// The journal's priority of a line in the format of [`flockeye_runtime::logs`], and the rest of
/// the line.
fn priority_of(text: &str) -> (Priority, &str) {
    let line = text.trim_start();
    let levels = [
        ("ERROR ", Priority::Error),
        ("WARN ", Priority::Warning),
        ("INFO ", Priority::Info),
        ("DEBUG ", Priority::Debug),
        ("TRACE ", Priority::Debug),
    ];
    let found = levels.into_iter().find_map(|(level, priority)| {
        let message = line.strip_prefix(level)?;
        Some((priority, message.trim_start()))
    });
    // The level of another program's line is unknown.
    found.unwrap_or((Priority::Notice, text))
}

impl Default for Screen {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_level_of_a_line_is_its_priority() {
        let cases = [
            ("ERROR it cannot go on", 3, "it cannot go on"),
            (" WARN 3 frames are missing", 4, "3 frames are missing"),
            (" INFO decoder: avdec_h264", 6, "decoder: avdec_h264"),
            ("thread 'main' panicked", 5, "thread 'main' panicked"),
        ];
        for (line, level, message) in cases {
            let (priority, rest) = priority_of(line);
            assert_eq!((u8::from(priority), rest), (level, message));
        }
    }
}
