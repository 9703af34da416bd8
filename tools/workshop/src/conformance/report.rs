//! Checks and findings of a conformance test.

use std::fmt::Write;

use flockeye_geometry::statistics::median;
use serde::Serialize;

/// The heading of docs/CONTRACT.md for all stages.
pub(super) const OWES: &str = "What every stage owes";
/// The heading of docs/CONTRACT.md for messages.
pub(super) const MUST_PASS: &str = "What a message must pass";

/// The checks of a test, and the candidate's figures.
#[derive(Debug, Default, Serialize)]
pub(crate) struct ConformanceReport {
    checks: Vec<Check>,
    figures: Vec<Figure>,
}

/// A requirement of the contract.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Check {
    what: &'static str,
    /// The heading in docs/CONTRACT.md.
    page: &'static str,
    /// The first finding; `None`: the check has passed.
    wrong: Option<String>,
    /// Number of findings.
    times: u32,
}

/// A figure of the candidate's quality.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Figure {
    what: &'static str,
    value: f64,
    unit: &'static str,
}

impl ConformanceReport {
    /// Notes a check, and the finding `wrong` if it has failed. Only the first finding of each
    /// check is kept.
    pub(crate) fn check(&mut self, what: &'static str, page: &'static str, wrong: Option<String>) {
        let check = match self.checks.iter().position(|check| check.what == what) {
            Some(known) => &mut self.checks[known],
            None => {
                self.checks.push(Check { what, page, wrong: None, times: 0 });
                let last = self.checks.len() - 1;
                &mut self.checks[last]
            }
        };
        if let Some(wrong) = wrong {
            check.times += 1;
            check.wrong.get_or_insert(wrong);
        }
    }

    /// Notes the result of the contract's check of a message.
    pub(crate) fn verdict<E: std::fmt::Display>(
        &mut self,
        what: &'static str,
        verdict: Result<(), E>,
    ) {
        self.check(what, MUST_PASS, verdict.err().map(|error| error.to_string()));
    }

    /// Notes a check that passes if `holds`. Otherwise `wrong` gives the finding.
    pub(crate) fn holds(
        &mut self,
        what: &'static str,
        page: &'static str,
        holds: bool,
        wrong: impl FnOnce() -> String,
    ) {
        self.check(what, page, (!holds).then(wrong));
    }

    /// Checks that a field has the wanted value.
    pub(crate) fn field<T: PartialEq + std::fmt::Debug>(
        &mut self,
        what: &'static str,
        page: &'static str,
        field: &str,
        found: T,
        wanted: T,
    ) {
        let wrong = format!("{field} is {found:?}, and must be {wanted:?}");
        self.holds(what, page, found == wanted, || wrong);
    }

    /// Notes a figure.
    pub(crate) fn figure(&mut self, what: &'static str, value: f64, unit: &'static str) {
        self.figures.push(Figure { what, value, unit });
    }

    /// Notes the median of measured values, and returns it; NaN without values.
    pub(crate) fn median(
        &mut self,
        what: &'static str,
        mut values: Vec<f64>,
        unit: &'static str,
    ) -> f64 {
        values.sort_by(f64::total_cmp);
        let value = median(&values).unwrap_or(f64::NAN);
        self.figures.push(Figure { what, value, unit });
        value
    }

    /// Number of failed checks.
    pub(crate) fn failed(&self) -> usize {
        self.checks.iter().filter(|check| check.wrong.is_some()).count()
    }

    /// The report as text. A failed check has its first finding and its page.
    pub(crate) fn text(&self) -> String {
        let mut text = String::new();
        for Check { what, page, wrong, times } in &self.checks {
            // Writing to a string cannot fail.
            let _ = match wrong {
                None => writeln!(text, "ok     {what}"),
                Some(wrong) => writeln!(
                    text,
                    "FAILS  {what}: {wrong}{} (docs/CONTRACT.md, \"{page}\")",
                    if *times > 1 { format!("; {times} times in all") } else { String::new() }
                ),
            };
        }
        for Figure { what, value, unit } in &self.figures {
            let _ = writeln!(text, "       {what}: {value:.2} {unit}");
        }
        text.trim_end().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_check_that_fails_once_has_failed_and_shows_its_first_finding() {
        let mut report = ConformanceReport::default();
        for (found, wanted) in [(1, 1), (2, 1), (3, 1)] {
            report.field("copied fields", "Detection", "view_index", found, wanted);
        }
        report.holds("health", "What every stage owes", true, || "never shown".to_owned());
        report.figure("time", 1.5, "ms");
        assert_eq!(report.failed(), 1);
        assert_eq!(
            report.text(),
            "FAILS  copied fields: view_index is 2, and must be 1; 2 times in all (docs/CONTRACT.md, \
             \"Detection\")\nok     health\n       time: 1.50 ms"
        );
    }
}
