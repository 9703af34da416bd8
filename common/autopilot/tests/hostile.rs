//! A million byte strings that are no messages, or messages that nobody means, and questions
//! between them.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_autopilot::core::Core;
use flockeye_autopilot::link::decode;
use flockeye_autopilot::messages::Outgoing;
use flockeye_config::Autopilot;
use mavlink::dialects::development::{MavMessage, TIMESYNC_DATA};
use mavlink::{MavHeader, Message, calculate_crc, write_v2_msg};
use rand::rngs::StdRng;
use rand::{Rng, RngExt, SeedableRng};

const STRINGS: u64 = 1_000_000;
/// One in so many is a question for the time.
const QUESTION_EVERY: u64 = 100;
const OURS: MavHeader = MavHeader { system_id: 1, component_id: 1, sequence: 0 };
/// What is heard changes something: that of every kind is sent in the autopilot's name.
const HEARD: [u32; 6] = [0, 31, 32, 111, 331, 511];

/// Memory of this process, bytes.
fn resident_bytes() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
    let pages: u64 = statm.split_whitespace().nth(1).unwrap().parse().unwrap();
    pages * 4096
}

/// A message with any payload and a right checksum, of the autopilot.
fn forged(random: &mut StdRng, bytes: &mut Vec<u8>) {
    let id = HEARD[random.random_range(0..HEARD.len())];
    let length = random.random_range(0..=255usize);
    let began = bytes.len();
    let [a, b, c, _] = id.to_le_bytes();
    bytes.extend([0xfd, length as u8, 0, 0, 9, 1, 1, a, b, c]);
    let payload = bytes.len();
    bytes.resize(payload + length, 0);
    random.fill_bytes(&mut bytes[payload..]);
    let crc = calculate_crc(&bytes[began + 1..], MavMessage::extra_crc(id));
    bytes.extend(crc.to_le_bytes());
}

/// What a hostile or broken sender sends.
fn hostile(random: &mut StdRng, bytes: &mut Vec<u8>) {
    bytes.clear();
    match random.random_range(0..5) {
        // Noise.
        0 => {
            bytes.resize(random.random_range(0..300), 0);
            random.fill_bytes(bytes);
        }
        // Nothing but beginnings.
        1 => bytes.resize(random.random_range(0..40), if random.random() { 0xfd } else { 0xfe }),
        // Cut anywhere.
        2 => {
            forged(random, bytes);
            bytes.truncate(random.random_range(0..bytes.len()));
        }
        // One bit is wrong.
        3 => {
            forged(random, bytes);
            let place = random.random_range(0..bytes.len());
            bytes[place] ^= 1 << random.random_range(0..8);
        }
        // Right in form.
        _ => forged(random, bytes),
    }
}

#[test]
fn a_million_hostile_strings_do_no_harm_and_questions_between_them_are_answered() {
    let mut core = Core::new(Autopilot::default(), 1_700_000_000_000_000_000);
    let mut random = StdRng::seed_from_u64(20_26);
    let mut bytes = Vec::new();
    let (mut heard, mut asked, mut answered, mut before_bytes) = (0u64, 0u64, 0u64, 0);
    for k in 0..STRINGS {
        // Some three strings a millisecond.
        let now_ns = k as i64 * 300_000;
        hostile(&mut random, &mut bytes);
        // Hidden behind what is not whole, in the same datagram.
        let ts1 = k as i64 + 1;
        if k % QUESTION_EVERY == 0 {
            let question = TIMESYNC_DATA { ts1, ..TIMESYNC_DATA::DEFAULT };
            write_v2_msg(&mut bytes, OURS, &MavMessage::TIMESYNC(question)).unwrap();
            asked += 1;
        }
        decode(&bytes, |sender, message| {
            heard += u64::from(core.on_message(sender, message, now_ns));
        });
        core.take_odometry();
        for sent in core.due(now_ns) {
            let Outgoing::Timesync(time) = sent else { continue };
            answered += u64::from(time.tc1 != 0 && time.ts1 == ts1 && k % QUESTION_EVERY == 0);
        }
        if k == STRINGS / 10 {
            before_bytes = resident_bytes();
        }
    }
    assert!(heard > STRINGS / 10, "{heard} messages of the right form were heard");
    // Bytes before a question may claim it as a part of a message that is right by chance; hardly
    // ever.
    assert!(answered + 3 >= asked && answered <= asked, "{answered} of {asked} were answered");
    let grown_bytes = resident_bytes().saturating_sub(before_bytes);
    assert!(grown_bytes < 4 << 20, "memory has grown by {grown_bytes} bytes");
    // Nothing of it is believed to be the time.
    assert_eq!(core.time_offset(STRINGS as i64 * 300_000), None);
}
