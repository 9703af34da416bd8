//! The thread that background passes run on.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use flockeye_runtime::background;

use crate::hypothesis::Aligner;
use crate::passes::background::{Answer, Job};

/// The thread has panicked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the thread of the background pass has ended; its panic was logged before")]
pub struct ThreadEnded;

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
