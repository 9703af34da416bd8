//! Output of processes, line by line.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use std::process::Child;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};

use rustix::fs::{FallocateFlags, SeekFrom as FileOffset, fallocate, seek};

/// A line that a stage wrote.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogLine {
    /// The stage, with the worker's number if there are several.
    pub stage: String,
    /// The line itself.
    pub text: String,
}

/// Destination of one process's lines, and their label, which a swap changes.
#[derive(Clone)]
pub(crate) struct LineSink {
    label: Arc<Mutex<String>>,
    log: SyncSender<LogLine>,
}

impl LineSink {
    /// Passes lines on to `log`.
    pub(crate) fn new(label: String, log: SyncSender<LogLine>) -> Self {
        Self { label: Arc::new(Mutex::new(label)), log }
    }

    /// Passes lines of another process on to the same log.
    pub(crate) fn of_another(&self, label: String) -> Self {
        Self::new(label, self.log.clone())
    }

    pub(crate) fn label(&self) -> String {
        // A thread that panicked while it held the lock left the text whole.
        self.label.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn rename(&self, name: String) {
        *self.label.lock().unwrap_or_else(PoisonError::into_inner) = name;
    }

    /// Forwards the output of a child.
    pub(crate) fn forward_outputs(&self, child: &mut Child) {
        child.stdout.take().into_iter().for_each(|output| self.forward(output));
        child.stderr.take().into_iter().for_each(|output| self.forward(output));
    }

    /// Forwards a stream, from a thread that ends with the stream.
    fn forward(&self, stream: impl Read + Send + 'static) {
        let sink = self.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(stream).split(b'\n') {
                let Ok(line) = line else { break };
                sink.pass_on(&line);
            }
        });
    }

    fn pass_on(&self, line: &[u8]) {
        let text = String::from_utf8_lossy(line).trim_end().to_owned();
        // A slow launcher must not block the stage: the line is dropped instead.
        drop(self.log.try_send(LogLine { stage: self.label(), text }));
    }
}

/// Maximum number of bytes read at once, so that the launcher is not held up.
const MOST_AT_ONCE: u64 = 65_536;

/// Output file of a process that may outlive its launcher. The part that was read takes no space on
/// the disk.
pub(crate) struct KeptOutput {
    file: File,
    /// Beginning of a line that is not complete yet.
    begun: Vec<u8>,
}

impl KeptOutput {
    /// Continues where the launcher before ended. A partly read line lacks its beginning.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let mut file = File::options().read(true).write(true).open(path)?;
        // The part that was read is a hole. Where the file system has no holes, lines are shown
        // twice.
        match seek(&file, FileOffset::Data(0)) {
            Ok(_) => {}
            Err(rustix::io::Errno::NXIO) => drop(file.seek(SeekFrom::End(0))?),
            Err(error) => return Err(error.into()),
        }
        Ok(Self { file, begun: Vec::new() })
    }

    /// Forwards the new output, at most [`MOST_AT_ONCE`] bytes of it. False: there was none.
    pub(crate) fn forward(&mut self, sink: &LineSink) -> io::Result<bool> {
        let from = self.file.stream_position()?;
        let length = (&self.file).take(MOST_AT_ONCE).read_to_end(&mut self.begun)? as u64;
        if length == 0 {
            return Ok(false);
        }
        let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        if let Err(error) = fallocate(&self.file, hole, from, length) {
            tracing::debug!("a stage's output stays on the disk: {error}");
        }
        let whole = self.begun.iter().rposition(|&byte| byte == b'\n').map_or(0, |end| end + 1);
        for line in self.begun[..whole].split_inclusive(|&byte| byte == b'\n') {
            // Zeros fill the part of a block that was read before.
            let start = line.iter().position(|&byte| byte != 0).unwrap_or(line.len());
            sink.pass_on(&line[start..]);
        }
        self.begun.drain(..whole);
        Ok(true)
    }

    /// Forwards the remaining output of an ended process. The end of very long output is left out.
    pub(crate) fn forward_rest(&mut self, sink: &LineSink) -> io::Result<()> {
        for _ in 0..16 {
            if !self.forward(sink)? {
                break;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::io::Write;
    use std::sync::mpsc::sync_channel;

    #[test]
    fn a_later_reader_of_a_file_goes_on_where_the_first_one_ended() {
        let path = std::env::temp_dir().join(format!("flock-output-{}", std::process::id()));
        let mut stage = File::options().append(true).create_new(true).open(&path).unwrap();
        let (log, lines) = sync_channel(100);
        let sink = LineSink::new("fusion".to_owned(), log);
        let told = || lines.try_iter().map(|line| line.text).collect::<Vec<_>>();
        let mut first = KeptOutput::open(&path).unwrap();
        stage.write_all(b"one\ntwo\nthr").unwrap();
        first.forward(&sink).unwrap();
        assert_eq!(told(), ["one", "two"]);
        stage.write_all(b"ee\n").unwrap();
        first.forward(&sink).unwrap();
        first.forward(&sink).unwrap();
        assert_eq!(told(), ["three"]);
        stage.write_all(b"four\n").unwrap();
        KeptOutput::open(&path).unwrap().forward(&sink).unwrap();
        assert_eq!(told(), ["four"]);
        std::fs::remove_file(&path).unwrap();
    }
}
