//! Flights that are repeated from their journals, and journals that are not what they were.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "of the flights")]

use super::*;
use crate::fixtures::region_end;
use crate::tests::flights::{Recording, flown, flown_on, resolved};
use flockeye_contract::{FrameStamp, JournalHeader, MAX_JOURNAL_ENTRIES};

fn tried(recording: Recording) -> anyhow::Result<ReplayReport> {
    let mut replay = FusionReplay::new(&resolved()).unwrap();
    for (message, utc_ns) in recording {
        replay.on(message, utc_ns, |_, _| {})?;
    }
    replay.finish(true)
}

fn refused(recording: Recording) -> String {
    tried(recording).unwrap_err().to_string()
}

/// The recording with other entries in its journal, which is all at its end.
fn with_entries(recording: Recording, change: impl FnOnce(&mut Vec<JournalEntry>)) -> Recording {
    let mut entries = Vec::new();
    let mut others = Recording::new();
    for (message, utc_ns) in recording {
        match message {
            FlightMessage::Journal(_, some) => entries.extend(some),
            other => others.push((other, utc_ns)),
        }
    }
    change(&mut entries);
    let last_ns = others.last().unwrap().1;
    let mut first = 0;
    for some in entries.chunks(MAX_JOURNAL_ENTRIES) {
        let header = JournalHeader { first, ..JournalHeader::default() };
        others.push((FlightMessage::Journal(header, some.to_vec()), last_ns));
        first += some.len() as u64;
    }
    others
}

fn place_of(entries: &[JournalEntry], kind: JournalKind, sequence: u64) -> usize {
    let is_it = |entry: &JournalEntry| entry.kind == kind.code() && entry.sequence == sequence;
    entries.iter().position(is_it).unwrap()
}

fn is_journal(message: &FlightMessage) -> bool {
    matches!(message, FlightMessage::Journal(..))
}

#[test]
fn a_flight_is_repeated_from_its_journal() {
    let recording = flown_on();
    let said = recording.iter().filter(|(message, _)| {
        matches!(message, FlightMessage::Tracks(..) | FlightMessage::Plan(..))
    });
    let messages = said.count() as u64;
    let measured = recording.iter().filter_map(|(message, _)| match message {
        FlightMessage::Tracks(_, tracks, _) => {
            Some(tracks.iter().filter(|track| track.measured_by != 0))
        }
        _ => None,
    });
    assert!(measured.flatten().count() >= 5, "alpha is followed");
    let wanted = ReplayReport { frames: 7, messages, answers: 1, ..ReplayReport::default() };
    assert_eq!(tried(recording.clone()).unwrap(), wanted);
    // A recorder receives topics apart: the journal behind all that it names, or before it.
    assert_eq!(tried(with_entries(recording.clone(), |_| {})).unwrap(), wanted);
    let (mut journal, others): (Recording, Recording) =
        recording.into_iter().partition(|(message, _)| is_journal(message));
    journal.extend(others);
    assert_eq!(tried(journal).unwrap(), wanted);
}

/// The camera's rotation counts from when fusion heard of it.
#[test]
fn another_order_is_noticed() {
    let turned_later = with_entries(flown(), |entries| {
        let turn = entries.remove(place_of(entries, JournalKind::Rotation, 3));
        let end = place_of(entries, JournalKind::FrameEnd, 3);
        entries.insert(end, turn);
    });
    let replayed = tried(turned_later).unwrap();
    let difference = replayed.difference.expect("another prediction gives another pose");
    assert!(difference.contains("flockeye/track of frame 3, recorded and given:"), "{difference}");
    assert!(replayed.messages > 5, "what came before is the same");

    let worked_before = with_entries(flown(), |entries| {
        let view = place_of(entries, JournalKind::View, 4);
        assert_eq!(entries[view + 1].kind, JournalKind::Step.code());
        entries.swap(view, view + 1);
    });
    let difference = tried(worked_before).unwrap().difference.unwrap();
    assert_eq!(
        difference,
        "after the end of frame 3: there was something to do, and there is nothing now"
    );

    let answered_before = with_entries(flown_on(), |entries| {
        let answer = entries.remove(place_of(entries, JournalKind::Background, 0));
        let searched = place_of(entries, JournalKind::Searched, 5);
        entries.insert(searched, answer);
    });
    let difference = tried(answered_before).unwrap().difference.unwrap();
    assert!(
        difference.contains("a background pass was answered that is not asked for"),
        "{difference}"
    );
}

#[test]
fn another_time_is_noticed() {
    let later = with_entries(flown(), |entries| {
        let said = entries.iter_mut().filter(|entry| entry.kind == JournalKind::Said.code());
        said.last().unwrap().at_ns += 1;
    });
    let difference = tried(later).unwrap().difference.unwrap();
    assert!(difference.contains("made_ns"), "{difference}");
}

#[test]
fn a_gap_in_the_journal_ends_the_comparison() {
    let mut recording = flown();
    let end = |recording: &Recording| {
        recording.iter().position(
            |(message, _)| matches!(message, FlightMessage::FrameEnd(end) if end.stamp.sequence == 3),
        )
    };
    let after = end(&recording).unwrap();
    let gap =
        after + recording[after..].iter().position(|(message, _)| is_journal(message)).unwrap();
    let (FlightMessage::Journal(_, entries), _) = recording.remove(gap) else {
        panic!("a journal")
    };
    let replayed = tried(recording).unwrap();
    let missing = entries.len();
    let wanted = format!("{missing} entries of fusion's journal are not in the recording");
    assert_eq!((replayed.difference, replayed.end), (None, Some(wanted)));
    assert_eq!(replayed.frames, 3);
    assert!(
        replayed.messages > 3 && replayed.left > 3,
        "{} and {}",
        replayed.messages,
        replayed.left
    );
}

/// Few plans wait for a recorder that gets no processor.
#[test]
fn plans_that_were_not_recorded_are_left_out() {
    let mut recording = flown();
    recording.retain(|(message, _)| {
        !matches!(message, FlightMessage::Plan(plan, ..) if [2, 3].contains(&plan.plan_id))
    });
    let whole = tried(flown()).unwrap();
    let messages = whole.messages - 2;
    assert_eq!(tried(recording).unwrap(), ReplayReport { messages, lost_plans: 2, ..whole });
}

#[test]
fn a_message_that_is_missing_is_named() {
    let without = |is_it: &dyn Fn(&FlightMessage) -> bool| {
        let mut recording = flown();
        recording.retain(|(message, _)| !is_it(message));
        let replayed = tried(recording).unwrap();
        assert_eq!(replayed.difference, None);
        (replayed.end.unwrap(), replayed.frames)
    };
    let of = |stamp: &FrameStamp| stamp.sequence == 4;
    let view =
        without(&|message| matches!(message, FlightMessage::View(view, _) if of(&view.stamp)));
    let wanted = "view 0 of frame 4, which fusion heard, is not in the recording";
    assert_eq!(view, (wanted.to_owned(), 4));
    let record = without(
        &|message| matches!(message, FlightMessage::Searched(record) if of(&record.header.stamp)),
    );
    assert!(record.0.starts_with("the record of view 0 of frame 4 by worker 0"), "{}", record.0);
    let end = without(&|message| matches!(message, FlightMessage::FrameEnd(end) if of(&end.stamp)));
    assert!(end.0.starts_with("the end of frame 4, which"), "{}", end.0);
    let turn = without(&|message| matches!(message, FlightMessage::Rotation(_)));
    assert!(turn.0.starts_with("the rotation of frame 3, which"), "{}", turn.0);
}

/// The lack of a message is known before the recording's end.
#[test]
fn a_missing_message_is_not_waited_for_for_ever() {
    let mut recording = flown();
    recording.retain(
        |(message, _)| !matches!(message, FlightMessage::View(view, _) if view.stamp.sequence == 4),
    );
    let mut replay = FusionReplay::new(&resolved()).unwrap();
    let last_ns = recording.last().unwrap().1;
    for (message, utc_ns) in recording {
        replay.on(message, utc_ns, |_, _| {}).unwrap();
    }
    assert!(replay.is_under_way(), "it may still come");
    let later = region_end(99, 0, 0);
    for seconds in 1..=6 {
        replay
            .on(FlightMessage::FrameEnd(later), last_ns + seconds * 1_000_000_000, |_, _| {})
            .unwrap();
    }
    assert!(!replay.is_under_way());
}

#[test]
fn what_is_no_journal_from_the_beginning_on_is_refused() {
    let mut none = flown();
    none.retain(|(message, _)| !is_journal(message));
    assert!(refused(none.clone()).contains("has no journal of fusion"));
    // The refusal comes before the recording's end.
    let mut replay = FusionReplay::new(&resolved()).unwrap();
    let end = |utc_ns| (FlightMessage::FrameEnd(region_end(0, 0, 0)), utc_ns);
    let mut ends = [end(0), end(6_000_000_000)].into_iter();
    let refusal = ends.find_map(|(message, utc_ns)| replay.on(message, utc_ns, |_, _| {}).err());
    assert!(refusal.unwrap().to_string().contains("has no journal"));

    let with_header = |change: &dyn Fn(&mut JournalHeader)| {
        let mut recording = flown();
        for (message, _) in &mut recording {
            if let FlightMessage::Journal(header, _) = message {
                change(header);
            }
        }
        recording
    };
    let later = refused(with_header(&|header| header.first += 2));
    assert!(later.contains("begins 2 entries after fusion's journal"), "{later}");
    for resumed in
        [with_header(&|header| header.is_resumed = 1), with_header(&|header| header.generation = 1)]
    {
        let resumed = refused(resumed);
        assert!(resumed.contains("had replaced another one"), "{resumed}");
    }
    let mut replaced = flown();
    let header = JournalHeader { generation: 1, ..JournalHeader::default() };
    let (_, utc_ns) = replaced[replaced.len() - 1];
    replaced.push((FlightMessage::Journal(header, vec![JournalEntry::default()]), utc_ns));
    let replayed = tried(replaced).unwrap();
    assert_eq!((replayed.difference, replayed.frames), (None, 5));
    assert!(replayed.end.unwrap().starts_with("fusion was replaced"));
}

#[test]
fn views_without_pixels_are_refused() {
    let mut blind = flown();
    for (message, _) in &mut blind {
        if let FlightMessage::View(header, _) = message {
            *message = FlightMessage::Header(*header);
        }
    }
    assert!(refused(blind).contains("a view without its pixels"));
}
