//! Warnings about refused links, and about the expiry of the drone's own certificate.

use flockeye_network::Network;
use flockeye_runtime::clock::utc_s;
use flockeye_runtime::logs::Throttle;

/// Remaining validity of the certificate at which a warning is logged, seconds.
const REMIND_S: [i64; 4] = [7 * 86_400, 86_400, 3_600, 0];

/// The warnings that were logged so far.
#[derive(Debug, Default)]
pub(crate) struct SecurityWarnings {
    refused_links: u64,
    warnings: Throttle,
    reminded: Option<i64>,
}

impl SecurityWarnings {
    /// Logs new warnings.
    pub(crate) fn look(&mut self, network: &Network) {
        let (refused, why) = network.refused_links();
        if refused > self.refused_links
            && let Some(more) = self.warnings.admit()
        {
            let new = refused - self.refused_links;
            self.refused_links = refused;
            tracing::warn!(
                held_back = more,
                "refused {new} links of strangers, the last one: {why}"
            );
        }
        if let Some(left_s) = network.expires_s().map(|expires_s| expires_s - utc_s())
            && let Some(limit_s) = self.reminder(left_s)
        {
            self.reminded = Some(limit_s);
            let hours = left_s / 3_600;
            if left_s > 0 {
                tracing::warn!(
                    "this drone's certificate holds for {hours} h. Cure: flockeye keys issue"
                );
            } else {
                tracing::error!(
                    "this drone's certificate has expired: nobody believes it. Cure: flockeye keys issue"
                );
            }
        }
    }

    /// The limit that was passed since the last reminder.
    fn reminder(&self, left_s: i64) -> Option<i64> {
        let limit_s = REMIND_S.into_iter().rev().find(|limit_s| left_s <= *limit_s)?;
        self.reminded.is_none_or(|reminded| limit_s < reminded).then_some(limit_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_is_warned_of_once_at_each_limit() {
        let mut security = SecurityWarnings::default();
        let mut said = Vec::new();
        for left_s in (-12..1_440).rev().map(|k| 600 * k) {
            if let Some(limit_s) = security.reminder(left_s) {
                security.reminded = Some(limit_s);
                said.push(left_s);
            }
        }
        assert_eq!(said, REMIND_S);
    }
}
