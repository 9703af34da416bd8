//! Where background passes run: on a thread of their own in flight, at once in a lossless run.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use flockeye_runtime::background;

use crate::aligner::Aligner;
use crate::measure::background::{Answer, Job};

/// The thread has panicked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the thread of the background pass has ended; its panic was logged before")]
pub struct ThreadEnded;

/// Runs background passes.
#[derive(Debug)]
pub enum BackgroundRunner {
    /// Beside the others. When an answer comes depends on the machine.
    Thread(BackgroundThread),
    /// At once, so that a lossless run repeats. The virtual clock says when the answer counts.
    Inline {
        /// What jobs run with.
        aligner: Arc<Aligner>,
        /// Answers that were not asked for yet.
        answers: VecDeque<Answer>,
    },
}

impl BackgroundRunner {
    /// Runs jobs on a thread.
    ///
    /// # Errors
    /// The system starts no thread.
    pub fn thread(aligner: Arc<Aligner>) -> io::Result<Self> {
        BackgroundThread::start(aligner).map(Self::Thread)
    }

    /// Runs each job when it is handed in.
    pub fn inline(aligner: Arc<Aligner>) -> Self {
        Self::Inline { aligner, answers: VecDeque::new() }
    }

    /// Runs a job.
    ///
    /// # Errors
    /// [`ThreadEnded`].
    pub fn run(&mut self, job: Job) -> Result<(), ThreadEnded> {
        match self {
            Self::Thread(thread) => thread.run(job),
            Self::Inline { aligner, answers } => {
                answers.push_back(job.run(aligner));
                Ok(())
            }
        }
    }

    /// The answer to a job that is over.
    ///
    /// # Errors
    /// [`ThreadEnded`].
    pub fn answer(&mut self) -> Result<Option<Answer>, ThreadEnded> {
        match self {
            Self::Thread(thread) => thread.answer(),
            Self::Inline { answers, .. } => Ok(answers.pop_front()),
        }
    }
}

/// The thread. It ends when this is dropped, after the job that it is at.
#[derive(Debug)]
pub struct BackgroundThread {
    jobs: Sender<Job>,
    answers: Receiver<Answer>,
}

impl BackgroundThread {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system starts no thread.
    pub fn start(aligner: Arc<Aligner>) -> io::Result<Self> {
        let (jobs, asked) = channel::<Job>();
        let (tell, answers) = channel();
        background::spawn("background-pass", move || {
            for job in asked {
                if tell.send(job.run(&aligner)).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { jobs, answers })
    }

    /// Runs a job.
    ///
    /// # Errors
    /// [`ThreadEnded`].
    pub fn run(&self, job: Job) -> Result<(), ThreadEnded> {
        self.jobs.send(job).map_err(|_| ThreadEnded)
    }

    /// The answer to a job that is over.
    ///
    /// # Errors
    /// [`ThreadEnded`].
    pub fn answer(&self) -> Result<Option<Answer>, ThreadEnded> {
        match self.answers.try_recv() {
            Ok(answer) => Ok(Some(answer)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(ThreadEnded),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_has_ended_is_an_error() {
        let ((jobs, _), (_, answers)) = (channel(), channel());
        let thread = BackgroundThread { jobs, answers };
        assert_eq!(thread.answer().map(|answer| answer.is_some()), Err(ThreadEnded));
    }
}
