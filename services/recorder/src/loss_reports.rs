//! Reports of losses in a recording.

use flockeye_contract::TOPICS;
use flockeye_recording::losses::Loss;
use flockeye_runtime::logs::Throttle;

/// Detects new losses, and logs warnings.
#[derive(Default)]
pub(crate) struct LossReports {
    /// The losses in the last report.
    reported: Vec<Loss>,
    warnings: Throttle,
}

impl LossReports {
    /// Topics with new losses since the last call: index and total loss of each. Logs warnings of
    /// them.
    pub(crate) fn news(&mut self, losses: Vec<Loss>) -> Vec<(usize, Loss)> {
        let mut news = Vec::new();
        for (topic, loss) in losses.iter().enumerate() {
            let before = self.reported.get(topic).copied().unwrap_or_default();
            let is_news = Loss { recorded: 0, ..before } != Loss { recorded: 0, ..*loss };
            if is_news {
                self.warn(topic, &before, loss);
                news.push((topic, *loss));
            }
        }
        self.reported = losses;
        news
    }

    fn warn(&mut self, topic: usize, before: &Loss, loss: &Loss) {
        let is_certain = loss.certain() > before.certain();
        let topic = TOPICS[topic].name;
        if is_certain && let Some(more_since) = self.warnings.admit() {
            let Loss { refused, missing, queue_full, .. } = loss;
            tracing::warn!(
                topic,
                more_since,
                "messages are missing: {queue_full} found no room because the disk is too slow, {missing} \
                 numbers were left out, {refused} broke the contract. Cure: record less (--frames), or to a \
                 faster disk"
            );
        } else if !is_certain && before.buffer_full == 0 {
            // Logged once: it repeats with each burst, and the file has the count.
            tracing::warn!(
                topic,
                "messages may be missing: as many came at once as find room. Cure: end what else keeps the \
                 processors busy"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_is_news_once_and_what_was_recorded_is_none() {
        let mut reports = LossReports::default();
        let lost = |queue_full, recorded| Loss { queue_full, recorded, ..Loss::default() };
        assert!(reports.news(vec![lost(0, 5), lost(0, 0)]).is_empty());
        assert_eq!(reports.news(vec![lost(0, 9), lost(2, 1)]), [(1, lost(2, 1))]);
        assert!(reports.news(vec![lost(0, 12), lost(2, 8)]).is_empty());
        assert_eq!(reports.news(vec![lost(0, 12), lost(3, 8)]), [(1, lost(3, 8))]);
    }
}
