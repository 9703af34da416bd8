//! Execution of background passes: on a thread of their own in flight, at once in a lossless run.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use flockeye_runtime::background;

use crate::account::Trial;
use crate::aligner::Aligner;
use crate::measure::background::Job;

/// Runs background passes.
#[derive(Debug)]
pub enum BackgroundRunner {
    /// Runs on a thread. After a drop, the thread ends with its present job. The time of an answer
    /// depends on the machine.
    Thread {
        /// Jobs for the thread.
        jobs: Sender<Job>,
        /// Answers of the thread.
        answers: Receiver<Box<Trial>>,
    },
    /// Runs at once, so that a lossless run is repeatable. The virtual clock gives the time at
    /// which the answer counts.
    Inline {
        /// The aligner of the jobs.
        aligner: Arc<Aligner>,
        /// Answers that were not taken yet.
        answers: VecDeque<Box<Trial>>,
    },
}

impl BackgroundRunner {
    /// Runs jobs on a thread.
    ///
    /// # Errors
    /// The system starts no thread.
    pub(crate) fn thread(aligner: Arc<Aligner>) -> io::Result<Self> {
        let (jobs, asked) = channel::<Job>();
        let (tell, answers) = channel();
        background::spawn("background-pass", move || {
            for job in asked {
                if tell.send(job.run(&aligner)).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self::Thread { jobs, answers })
    }

    /// Runs each job when it is submitted.
    pub fn inline(aligner: Arc<Aligner>) -> Self {
        Self::Inline { aligner, answers: VecDeque::new() }
    }

    /// Runs a job.
    ///
    /// # Errors
    /// The thread has panicked.
    pub fn run(&mut self, job: Job) -> anyhow::Result<()> {
        match self {
            Self::Thread { jobs, .. } => jobs.send(job).map_err(|_| thread_ended()),
            Self::Inline { aligner, answers } => {
                answers.push_back(job.run(aligner));
                Ok(())
            }
        }
    }

    /// The answer to a finished job.
    ///
    /// # Errors
    /// The thread has panicked.
    pub fn answer(&mut self) -> anyhow::Result<Option<Box<Trial>>> {
        match self {
            Self::Thread { answers, .. } => match answers.try_recv() {
                Ok(answer) => Ok(Some(answer)),
                Err(TryRecvError::Empty) => Ok(None),
                Err(TryRecvError::Disconnected) => Err(thread_ended()),
            },
            Self::Inline { answers, .. } => Ok(answers.pop_front()),
        }
    }
}

fn thread_ended() -> anyhow::Error {
    anyhow::anyhow!("the thread of the background pass has ended; its panic was logged before")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_has_ended_is_an_error() {
        let ((jobs, _), (_, answers)) = (channel(), channel());
        assert!(BackgroundRunner::Thread { jobs, answers }.answer().is_err());
    }
}
