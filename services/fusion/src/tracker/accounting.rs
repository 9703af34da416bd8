//! An account of what is decided of one target, for whoever asks. Nothing here changes what is decided.

use flockeye_contract::FrameOrder;

use super::Tracker;
use crate::account::{Account, AccountEntry, Trial};
use crate::decide::outcome::Outcome;

impl Tracker {
    /// Notes from now on what is decided of a target.
    pub fn keep_account(&mut self, target: usize) {
        self.account = Some(Account::of(target));
    }

    /// What was decided of the target and not taken yet, with the frame of each decision.
    pub fn account(&self) -> &[(FrameOrder, AccountEntry)] {
        self.account.as_ref().map(Account::entries).unwrap_or_default()
    }

    /// What was decided of the target since this was asked last, with the frame of each decision.
    pub fn take_account(&mut self) -> Vec<(FrameOrder, AccountEntry)> {
        self.account.as_mut().map(Account::take).unwrap_or_default()
    }

    /// Notes what happened to a target, if somebody asks.
    pub(super) fn note(&mut self, order: FrameOrder, target: usize, entry: AccountEntry) {
        if let Some(account) = self.account.as_mut().filter(|account| account.is_of(target)) {
            account.note(order, entry);
        }
    }

    /// Notes a pass over a target with what became of its pose.
    pub(super) fn note_trial(
        &mut self,
        order: FrameOrder,
        target: usize,
        trial: Trial,
        outcome: Outcome,
    ) {
        self.note(order, target, AccountEntry::Ran(Trial { outcome, ..trial }));
    }
}
