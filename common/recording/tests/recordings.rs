//! Recordings as files: whole, cut off, damaged, and no recordings at all.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use flockeye_contract::{FrameStamp, Text, TrackHeader};
use flockeye_recording::file::RecordingFile;
use flockeye_recording::message::{decode, encode};
use flockeye_recording::recover::recover;
use flockeye_recording::{
    About, ChannelKind, ContractMessage, Ending, IndexedRecording, RecordingError, RecordingReader,
    RecordingWriter, TopicLayout, layouts,
};

fn tracks() -> TopicLayout {
    layouts().into_iter().find(|layout| layout.service == "flockeye/track").unwrap()
}

fn message(sequence: u64) -> ContractMessage {
    let stamp =
        FrameStamp { sequence, exposure_ns: 1_000 * sequence as i64, ..FrameStamp::default() };
    let header = TrackHeader { stamp, generation: 3, is_last: 1 };
    ContractMessage { header: bytemuck::bytes_of(&header).to_vec(), ..ContractMessage::default() }
}

fn about() -> About {
    About {
        utc_from_monotonic_ns: 1_700_000_000_000_000_000,
        metadata: [("observer".to_owned(), "wren".to_owned())].into(),
        attachments: vec![("pipeline.json".into(), "application/json".into(), b"{}".to_vec())],
    }
}

/// A recording of `chunks` chunks of ten messages each; ended, or as a killed recorder leaves it.
fn record(path: &Path, chunks: u64, is_ended: bool) {
    let mut writer =
        RecordingWriter::begin(RecordingFile::create(path).unwrap(), &about()).unwrap();
    let (layout, kind) = (tracks(), ChannelKind::of_topic(&tracks()));
    for sequence in 0..chunks * 10 {
        let cdr = encode(&layout, &message(sequence)).unwrap();
        assert_eq!(writer.write(&kind, sequence as i64, &cdr).unwrap(), sequence as u32);
        if sequence % 10 == 9 {
            writer.flush().unwrap();
        }
    }
    if is_ended {
        writer.finish().unwrap();
    }
}

/// The readable messages, and the ending of the recording.
fn read(path: &Path) -> Result<(Vec<ContractMessage>, Ending), RecordingError> {
    let mut reader = RecordingReader::open(path)?;
    let mut found = Vec::new();
    while let Some(message) = reader.next_message()? {
        assert_eq!(message.channel.topic, "/flockeye/track");
        found.push(decode(&tracks(), &message.bytes)?);
    }
    Ok((found, reader.ending().unwrap()))
}

fn scratch() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    (folder, path)
}

#[test]
fn a_recording_comes_back_with_all_that_it_says_of_itself() {
    let (_folder, path) = scratch();
    record(&path, 3, true);
    let (found, ending) = read(&path).unwrap();
    assert_eq!(ending, Ending::Whole);
    assert_eq!(found, (0..30).map(message).collect::<Vec<_>>());
    let mut reader = RecordingReader::open(&path).unwrap();
    assert_eq!(reader.about().metadata["observer"], "wren");
    assert_eq!(reader.about().attachments, about().attachments);
    let first = reader.next_message().unwrap().unwrap();
    assert_eq!(first.utc_ns, about().utc_from_monotonic_ns as u64);
    assert_eq!(*first.channel, ChannelKind::of_topic(&tracks()));
}

#[test]
fn a_recording_that_was_cut_off_anywhere_gives_all_that_came_before() {
    let (_folder, path) = scratch();
    record(&path, 3, false);
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(
        read(&path).unwrap().0.len(),
        30,
        "a killed recorder loses nothing that was flushed"
    );
    let mut most = 0;
    for length in 1..bytes.len() {
        std::fs::write(&path, &bytes[..length]).unwrap();
        match read(&path) {
            Ok((found, ending)) => {
                assert_eq!(ending, Ending::Cut, "{length} bytes");
                assert!(found.len().is_multiple_of(10) && found.len() >= most, "{length} bytes");
                most = found.len();
            }
            // The rest is too short to identify the file.
            Err(error) => {
                let said = error.to_string();
                assert!(most == 0 && said.contains("Cure:"), "{length} bytes: {said}");
            }
        }
    }
    // The longest file lacks only a part of the last chunk's index.
    assert_eq!(most, 30);
}

#[test]
fn a_recording_ends_whole_before_the_disk_is_full() {
    let (_folder, path) = scratch();
    let mut writer =
        RecordingWriter::begin(RecordingFile::create(&path).unwrap(), &about()).unwrap();
    let (layout, kind) = (tracks(), ChannelKind::of_topic(&tracks()));
    let write = |writer: &mut RecordingWriter, sequence| {
        let cdr = encode(&layout, &message(sequence)).unwrap();
        writer.write(&kind, sequence as i64, &cdr).unwrap();
        writer.flush()
    };
    (0..5).for_each(|sequence| write(&mut writer, sequence).unwrap());
    // More than any disk has: so it is as good as full.
    writer.leave_free(u64::MAX);
    let error = write(&mut writer, 5).unwrap_err();
    assert!(matches!(error, RecordingError::DiskFull { .. }), "{error}");
    assert!(error.to_string().contains("so the recording ends here, whole. Cure:"), "{error}");
    writer.finish().unwrap();
    let (found, ending) = read(&path).unwrap();
    assert_eq!((found, ending), ((0..6).map(message).collect(), Ending::Whole));
}

#[test]
fn what_is_whole_of_a_broken_recording_is_recovered() {
    let (folder, path) = scratch();
    record(&path, 3, false);
    let bytes = std::fs::read(&path).unwrap();
    let last_chunk = bytes.windows(4).rposition(|bytes| bytes == b"zstd").unwrap();
    std::fs::write(&path, &bytes[..last_chunk + 40]).unwrap();
    let good = folder.path().join("good.mcap");
    let recovered = recover(&path, &good).unwrap();
    assert_eq!((recovered.messages, recovered.was_whole), (20, false));
    let (found, ending) = read(&good).unwrap();
    assert_eq!((found.len(), ending), (20, Ending::Whole));
    let about = RecordingReader::open(&good).unwrap().about().clone();
    assert_eq!((about.metadata["observer"].as_str(), about.attachments.len()), ("wren", 1));
    let error = recover(&path, &good).unwrap_err().to_string();
    assert!(error.contains("is there already"), "{error}");
}

#[test]
fn a_damaged_recording_is_named_with_place_and_cure() {
    let (folder, path) = scratch();
    record(&path, 3, true);
    let bytes = std::fs::read(&path).unwrap();
    let mut refused = 0;
    for place in (0..bytes.len()).step_by(7) {
        let mut damaged = bytes.clone();
        damaged[place] ^= 0x5a;
        std::fs::write(&path, &damaged).unwrap();
        // Not each byte is guarded by a sum, but none makes it panic or run on.
        if let Err(error) = read(&path) {
            let said = error.to_string();
            assert!(said.contains("flight.mcap") || said.starts_with("a message of"), "{said}");
            refused += 1;
        }
    }
    assert!(refused > bytes.len() / 7 / 4, "{refused} of {}", bytes.len() / 7);
    // In the middle of the first chunk, and of the second.
    let all = bytes.windows(4).enumerate().filter(|(_, bytes)| bytes == b"zstd");
    let chunks: Vec<usize> = all.map(|(place, _)| place).take(2).collect();
    for (number, chunk) in chunks.into_iter().enumerate() {
        let mut damaged = bytes.clone();
        damaged[chunk + 60] ^= 0xff;
        std::fs::write(&path, &damaged).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(
            error.contains("damaged near byte") && error.contains("Cure: `flockeye record"),
            "{error}"
        );
        let good = folder.path().join(format!("good-{number}.mcap"));
        let recovered = recover(&path, &good).unwrap();
        assert_eq!((recovered.messages, recovered.damage.is_some()), (10 * number as u64, true));
        let (found, ending) = read(&good).unwrap();
        assert_eq!((found.len(), ending), (10 * number, Ending::Whole));
    }
}

#[test]
fn what_is_no_recording_is_refused_with_a_cure() {
    let (folder, path) = scratch();
    let refused = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let error = RecordingReader::open(&path).map(drop).expect_err("refused").to_string();
        assert!(error.contains("flight.mcap") && error.contains("Cure:"), "{error}");
        error
    };
    assert!(refused(b"").contains("is empty"));
    assert!(refused(b"a text, and no recording at all").contains("is no MCAP file"));
    assert!(refused(&[0; 4096]).contains("is no MCAP file"));
    let mut bytes = Vec::new();
    let mut foreign = mcap::Writer::new(std::io::Cursor::new(&mut bytes)).unwrap();
    foreign.finish().unwrap();
    drop(foreign);
    assert!(refused(&bytes).contains("no metadata 'flockeye'"));
    let error = RecordingReader::open(folder.path()).map(drop).unwrap_err().to_string();
    assert!(error.contains("is a directory"), "{error}");
    let error =
        RecordingReader::open(&folder.path().join("none.mcap")).map(drop).unwrap_err().to_string();
    assert!(error.contains("none.mcap: No such file"), "{error}");
}

/// Peak resident memory of this process, bytes.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 1024
}

#[test]
fn a_file_of_100_gigabytes_of_nothing_is_refused_at_once() {
    let (_folder, path) = scratch();
    let length = 100_000_000_000;
    File::create(&path).unwrap().set_len(length).unwrap();
    let error = RecordingReader::open(&path).map(drop).unwrap_err().to_string();
    assert!(error.contains("is no MCAP file"), "{error}");
    std::fs::remove_file(&path).unwrap();
    // A recording whose rest a crash has left as a hole.
    record(&path, 2, false);
    File::options().write(true).open(&path).unwrap().set_len(length).unwrap();
    let error = read(&path).unwrap_err().to_string();
    assert!(error.contains("zeros where a record should be"), "{error}");
    // A record that says it is as large as the file.
    let mut file = File::options().write(true).open(&path).unwrap();
    let end = file.seek(SeekFrom::Start(0)).unwrap();
    assert_eq!(end, 0);
    file.write_all(mcap::MAGIC).unwrap();
    file.write_all(&[6]).unwrap();
    file.write_all(&(length - 100).to_le_bytes()).unwrap();
    let before = peak_bytes();
    let error = RecordingReader::open(&path).map(drop).unwrap_err().to_string();
    assert!(error.contains("damaged near byte"), "{error}");
    assert!(peak_bytes() < before + 500_000_000, "{} bytes", peak_bytes());
    assert!(std::fs::metadata(&path).unwrap().blocks() < 10_000, "it has stayed sparse");
}

/// The numbers of all frames that an index leads to, chunk by chunk, and where a chunk cannot be
/// read, why.
fn through_index(recording: &IndexedRecording) -> (Vec<u64>, Vec<String>) {
    let (mut numbers, mut complaints) = (Vec::new(), Vec::new());
    for chunk in 0..recording.chunks().len() {
        match recording.messages(chunk, |_| true) {
            Ok(messages) => numbers.extend(messages.iter().map(|message| {
                let kind = &recording.channels()[&message.channel];
                assert_eq!(**kind, ChannelKind::of_topic(&tracks()));
                let header = decode(&tracks(), &message.bytes).unwrap().header;
                bytemuck::pod_read_unaligned::<TrackHeader>(&header).stamp.sequence
            })),
            Err(error) => complaints.push(error.to_string()),
        }
    }
    (numbers, complaints)
}

#[test]
fn messages_are_found_by_the_index_and_without_one() {
    let (_folder, path) = scratch();
    for is_ended in [true, false] {
        record(&path, 4, is_ended);
        let recording = IndexedRecording::open(&path).unwrap();
        assert_eq!(recording.ending(), if is_ended { Ending::Whole } else { Ending::Cut });
        assert_eq!(through_index(&recording), ((0..40).collect(), Vec::new()));
        let begin = about().utc_from_monotonic_ns as u64;
        assert_eq!(recording.span_ns(), Some((begin, begin + 39)));
        for (at, chunk) in [(0, 0), (begin, 0), (begin + 9, 0), (begin + 10, 1), (u64::MAX, 3)] {
            assert_eq!(recording.chunk_at(at), chunk, "{at}");
        }
        assert!(recording.messages(2, |_| false).unwrap().is_empty());
        assert!(recording.messages(99, |_| true).unwrap().is_empty());
        assert_eq!(recording.about().attachments, about().attachments);
        std::fs::remove_file(&path).unwrap();
    }
}

#[test]
fn an_index_of_a_broken_recording_leads_to_what_is_whole() {
    let (_folder, path) = scratch();
    record(&path, 4, true);
    let bytes = std::fs::read(&path).unwrap();
    let all = bytes.windows(4).enumerate().filter(|(_, bytes)| bytes == b"zstd");
    let chunks: Vec<usize> = all.map(|(place, _)| place).take(4).collect();
    // In the middle of the third chunk: with its index all others are there, without it those
    // before.
    let mut damaged = bytes.clone();
    damaged[chunks[2] + 60] ^= 0xff;
    std::fs::write(&path, &damaged).unwrap();
    let recording = IndexedRecording::open(&path).unwrap();
    let (numbers, complaints) = through_index(&recording);
    assert_eq!(numbers, (0..20).chain(30..40).collect::<Vec<_>>());
    let [complaint] = &complaints[..] else { panic!("{complaints:?}") };
    assert!(complaint.contains("damaged near byte") && complaint.contains("Cure:"), "{complaint}");
    std::fs::write(&path, &damaged[..damaged.len() - 10]).unwrap();
    let recording = IndexedRecording::open(&path).unwrap();
    assert_eq!(through_index(&recording), ((0..20).collect(), Vec::new()));
    let said = recording.damage().expect("it is damaged").to_string();
    assert!(said.contains("damaged near byte") && said.contains("Cure:"), "{said}");
    // Cut off anywhere, and any byte changed: what comes is whole, and nothing panics or runs on.
    for length in (1..bytes.len()).step_by(11) {
        std::fs::write(&path, &bytes[..length]).unwrap();
        let Ok(recording) = IndexedRecording::open(&path) else { continue };
        let (numbers, complaints) = through_index(&recording);
        assert!(complaints.is_empty() && recording.damage().is_none(), "{length}: {complaints:?}");
        assert_eq!(numbers, (0..numbers.len() as u64).collect::<Vec<_>>(), "{length}");
    }
    for place in (0..bytes.len()).step_by(7) {
        let mut damaged = bytes.clone();
        damaged[place] ^= 0x5a;
        std::fs::write(&path, &damaged).unwrap();
        if let Ok(recording) = IndexedRecording::open(&path) {
            for chunk in 0..recording.chunks().len() {
                drop(recording.messages(chunk, |_| true));
            }
        }
    }
}

#[test]
fn an_index_of_100_gigabytes_of_nothing_is_made_at_once() {
    let (_folder, path) = scratch();
    record(&path, 2, false);
    File::options().write(true).open(&path).unwrap().set_len(100_000_000_000).unwrap();
    let recording = IndexedRecording::open(&path).unwrap();
    assert_eq!(through_index(&recording).0, (0..20).collect::<Vec<_>>());
    let said = recording.damage().expect("it is damaged").to_string();
    assert!(said.contains("zeros where a record should be"), "{said}");
}

#[test]
fn texts_are_as_they_were() {
    let layout = layouts().into_iter().find(|layout| layout.service == "flockeye/health").unwrap();
    let health = flockeye_contract::Health {
        stage: "fusion".into(),
        detail: Text::from("turning 3 degrees/s \u{00b1} 1"),
        ..flockeye_contract::Health::default()
    };
    let message = ContractMessage {
        header: bytemuck::bytes_of(&health).to_vec(),
        ..ContractMessage::default()
    };
    assert_eq!(decode(&layout, &encode(&layout, &message).unwrap()).unwrap(), message);
}
