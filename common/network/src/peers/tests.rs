#![allow(clippy::unwrap_used, clippy::expect_used)]
use flockeye_contract::wire::{ClockOffset, MAX_FRAME_REPORT_BYTES, frame_key};

use super::*;
use crate::outbox::tests::frame_report;

fn at(at: Instant, since: Duration, delivery: Delivery) -> Arrival {
    let monotonic_ns = since.as_nanos() as i64;
    let utc_ns = monotonic_ns + 1_700_000_000_000_000_000;
    Arrival {
        at: at + since,
        time: ClockReading { monotonic_ns, utc_ns, is_synchronised: false },
        delivery,
    }
}

fn arrival(now: Instant, delivery: Delivery) -> Arrival {
    at(now, Duration::ZERO, delivery)
}

/// A report of wren on kite.
fn report() -> FrameReport {
    frame_report("wren", &["kite"])
}

fn take(peers: &mut Peers, key: &str, payload: &[u8], now: Instant) -> Result<(), Refusal> {
    peers.take(key, payload, arrival(now, Delivery::Published)).map(drop)
}

#[test]
fn age_counts_from_arrival_and_adds_the_senders_latency() {
    let arrived = Instant::now();
    let now = arrived + Duration::from_millis(300);
    assert_eq!(age_of(arrived, 120.0, now), Duration::from_millis(420));
    assert_eq!(age_of(now, 120.0, arrived), Duration::from_millis(120), "never negative");
    assert_eq!(age_of(arrived, -5e9, now), Duration::from_millis(300), "never young by lying");
    assert_eq!(age_of(arrived, 1e300, now), Duration::MAX);
}

#[test]
fn the_latest_report_of_each_target_is_kept_with_its_rate() {
    let mut peers = Peers::default();
    let start = Instant::now();
    for frame in 0..50 {
        let since = Duration::from_millis(40 * frame);
        let stamp_utc_ns = since.as_nanos() as i64;
        let json = FrameReport { frame, stamp_utc_ns, ..report() }.to_json().unwrap();
        let key = frame_key("s", "wren");
        peers.take(&key, &json, at(start, since, Delivery::Published)).unwrap();
    }
    let kite = &peers.observers["wren"].targets["kite"];
    assert_eq!((kite.report.frame, kite.count, kite.arrived_monotonic_ns), (49, 50, 1_960_000_000));
    let rate = |silent_ms| kite.rate_hz(kite.arrived + Duration::from_millis(silent_ms));
    assert!((rate(0).unwrap() - 25.0).abs() < 1e-6);
    assert!((rate(2_000).unwrap() - 0.5).abs() < 1e-6, "falls when nothing comes");
}

#[test]
fn an_answer_never_replaces_what_was_published_after_it() {
    let mut peers = Peers::default();
    let (key, now) = (frame_key("s", "wren"), Instant::now());
    let mut send = |stamp_utc_ns, delivery| {
        let frame = stamp_utc_ns as u64;
        let json = FrameReport { stamp_utc_ns, frame, ..report() }.to_json().unwrap();
        !peers.take(&key, &json, arrival(now, delivery)).unwrap().is_empty()
    };
    assert!(send(5, Delivery::LastValue));
    assert!(send(9, Delivery::Published));
    assert!(!send(8, Delivery::LastValue));
    assert!(send(11, Delivery::LastValue));
}

#[test]
fn what_is_said_twice_is_refused_until_the_drone_comes_back() {
    let mut peers = Peers::default();
    let (key, now) = (frame_key("s", "wren"), Instant::now());
    let json = |stamp_utc_ns| FrameReport { stamp_utc_ns, ..report() }.to_json().unwrap();
    take(&mut peers, &key, &json(9), now).unwrap();
    for stamp in [9, 3] {
        let refused = take(&mut peers, &key, &json(stamp), now);
        assert!(matches!(refused, Err(Refusal::Replayed { .. })));
    }
    assert_eq!(peers.observers["wren"].refused, Refused { replayed: 2, ..Refused::default() });
    peers.set_alive("wren", true, now);
    take(&mut peers, &key, &json(3), now).expect("a restarted drone may be set back");
}

#[test]
fn a_frame_brings_all_its_targets_and_what_it_repeats_is_no_news() {
    let mut peers = Peers::of(Some("own".into()), false);
    let (key, now) = (frame_key("s", "wren"), Instant::now());
    let mut frame = frame_report("wren", &["kite"]);
    let mut send = |frame: &FrameReport| {
        let json = frame.to_json().unwrap();
        let taken = peers.take(&key, &json, arrival(now, Delivery::Published)).unwrap();
        taken.into_iter().map(|sighting| sighting.target.name).collect::<Vec<_>>()
    };
    assert_eq!(send(&frame), ["kite"]);
    // Again, when more is known of it.
    frame.targets.extend(frame_report("wren", &["swift"]).targets);
    frame.latency_ms += 5.0;
    frame.clocks = BTreeMap::from([(
        "own".into(),
        ClockOffset { one_way_ms: 1.5, offset_ms: 0.0, deviation_ms: 1.0 },
    )]);
    assert_eq!(send(&frame), ["swift"]);
    let wren = &peers.observers["wren"];
    assert_eq!((wren.targets["kite"].count, wren.targets.len()), (1, 2));
    assert!(wren.clock(0).is_some());
}

#[test]
fn hostile_messages_are_counted_where_they_belong_and_change_nothing_else() {
    let mut peers = Peers::default();
    let now = Instant::now();
    let good = report().to_json().unwrap();
    let key = frame_key("s", "wren");
    take(&mut peers, &key, &good, now).unwrap();
    let mut refused = |key: &str, payload: &[u8]| {
        take(&mut peers, key, payload, now).expect_err("refused").to_string()
    };
    assert!(refused(&key, b"{").starts_with("not a report"));
    assert!(refused(&key, &vec![b' '; MAX_FRAME_REPORT_BYTES + 1]).contains("84993 bytes"));
    assert!(refused(&frame_key("s", "robin"), &good).contains("of 'wren'"));
    let other = FrameReport { schema: "flockeye.pose/1".into(), ..report() }.to_json().unwrap();
    assert!(refused(&key, &other).contains("flockeye.pose/1"));
    assert!(refused("flockeye/s/wren/sees/kite/pose", &good).starts_with("no key"));
    assert!(refused("flockeye/s/wr\u{7}n/sees", &good).starts_with("no key"));
    assert_eq!((peers.refused, peers.observers["wren"].refused.malformed), (2, 3));
    assert_eq!(peers.observers["robin"].refused.total(), 1);
    assert_eq!(peers.observers["wren"].targets["kite"].count, 1);
    assert!(peers.observers["robin"].targets.is_empty());
}

#[test]
fn memory_is_bounded() {
    let mut peers = Peers::default();
    let now = Instant::now();
    for k in 0..MAX_TARGETS + 3 {
        let mut report = frame_report("wren", &[format!("t{k}").as_str()]);
        report.stamp_utc_ns += k as i64;
        let taken = take(&mut peers, &frame_key("s", "wren"), &report.to_json().unwrap(), now);
        assert_eq!(taken.is_ok(), k < MAX_TARGETS);
    }
    for k in 0..MAX_OBSERVERS + 3 {
        assert_eq!(peers.set_alive(&format!("o{k}"), true, now), k < MAX_OBSERVERS - 1);
    }
    assert_eq!(peers.observers["wren"].targets.len(), MAX_TARGETS);
    assert_eq!(peers.observers["wren"].refused.malformed, 3);
    assert_eq!((peers.observers.len(), peers.refused), (MAX_OBSERVERS, 4));
}

#[test]
fn alive_says_since_when() {
    let mut peers = Peers::default();
    let start = Instant::now();
    let at = |seconds| start + Duration::from_secs(seconds);
    for (second, alive) in [(1, true), (2, true), (3, false)] {
        assert!(peers.set_alive("wren", alive, at(second)));
        let since = peers.observers["wren"].since;
        assert_eq!(since, at(if alive { 1 } else { 3 }));
    }
    assert_eq!(alive_in("flockeye/s/wren/alive"), Some("wren"));
    assert_eq!(alive_in("flockeye/s/wr n/alive"), None);
}

/// Bytes drawn at random, and reports with bytes changed, cut and swapped: a million of them in
/// all. None panics, none makes the table grow, and the valid ones between them arrive.
#[test]
fn a_million_hostile_payloads_do_no_harm() {
    use rand::{RngExt, SeedableRng, rngs::StdRng};
    let mut random = StdRng::seed_from_u64(1);
    let mut peers = Peers::default();
    let now = Instant::now();
    let keys = [frame_key("s", "wren"), frame_key("s", "crow")];
    let single = report().to_json().unwrap();
    let double = frame_report("wren", &["kite", "swift"]).to_json().unwrap();
    let hostile = ["NaN", "1e999", "-1e308", "null", "\"x\"", "[[[[[[[[", "9223372036854775808"];
    let (mut valid, mut arrived) = (0, 0);
    for round in 0..1_000_000u64 {
        let key = &keys[random.random_range(0..keys.len())];
        let mut bytes = if random.random() { single.clone() } else { double.clone() };
        match random.random_range(0..4) {
            0 => bytes.truncate(random.random_range(0..bytes.len())),
            1 => (0..3).for_each(|_| {
                let index = random.random_range(0..bytes.len());
                bytes[index] = random.random();
            }),
            2 => bytes = (0..random.random_range(0..200)).map(|_| random.random()).collect(),
            _ => {
                let text = String::from_utf8(bytes).unwrap();
                let pick = hostile[random.random_range(0..hostile.len())];
                bytes = text.replacen("0.1", pick, random.random_range(1..4)).into_bytes();
            }
        }
        let since = Duration::from_micros(round);
        let _ = peers.take(key, &bytes, at(now, since, Delivery::Published));
        if round % 1_000 == 999 {
            valid += 1;
            let stamp_utc_ns = 1_700_000_000_000_000_000 + 1_000 * round as i64;
            let robin = frame_report("finch", &["robin"]);
            let good = FrameReport { frame: round, stamp_utc_ns, ..robin }.to_json().unwrap();
            let key = frame_key("s", "finch");
            let taken = peers.take(&key, &good, at(now, since, Delivery::Published));
            arrived += taken.map_or(0, |taken| taken.len());
        }
    }
    assert_eq!(arrived, valid);
    assert!(peers.observers.len() <= 3, "{:?}", peers.observers.keys());
    assert!(peers.observers.values().all(|peer| peer.targets.len() <= MAX_TARGETS));
}
