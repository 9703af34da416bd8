//! Messages of both processes of a stage while one works in the other's shadow.

use anyhow::ensure;
use flockeye_contract::{
    DetectionHeader, Detections, FrameEnds, RotationSource, Rotations, StageName, Tracks,
};
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Message, Ports, Subscriber};
use nalgebra::Vector3;

use super::comparison::StageAnswer;
use super::judge::Judge;
use crate::control::WorkerName;

/// Subscribers for the answers of the old and the new process.
pub(crate) enum Shadow {
    Detections(Subscriber<Detections>),
    /// Ends of frames, and findings in the views.
    Views(Subscriber<FrameEnds>, Subscriber<Detections>),
    Rotations(Subscriber<Rotations>),
    Tracks(Subscriber<Tracks>),
}

/// Whether two processes of a stage can work side by side: stages that own no device and no port.
pub fn can_shadow(stage: StageName) -> bool {
    matches!(
        stage,
        StageName::Rectification | StageName::Detection | StageName::Egomotion | StageName::Fusion
    )
}

impl Shadow {
    /// Subscribes to both processes of a worker by `ports`, which must admit all processes.
    pub(crate) fn open(worker: WorkerName, ports: &mut Ports) -> anyhow::Result<Self> {
        ensure!(can_shadow(worker.stage), "{worker} cannot run twice at once");
        Ok(match worker.stage {
            StageName::Detection => Self::Detections(ports.subscriber()?),
            StageName::Rectification => Self::Views(ports.subscriber()?, ports.subscriber()?),
            StageName::Egomotion => Self::Rotations(ports.subscriber()?),
            _ => Self::Tracks(ports.subscriber()?),
        })
    }

    /// Passes all waiting messages to the judge of the swap.
    pub(crate) fn receive(&mut self, judge: &mut Judge) -> anyhow::Result<()> {
        match self {
            Self::Detections(detections) => {
                while let Some(message) = detections.receive()? {
                    let header = &message.header;
                    if header.worker == judge.worker.replica {
                        judge.note(header.generation, searched(&message, view_number(header)));
                    }
                }
            }
            Self::Views(frame_ends, detections) => {
                while let Some(message) = detections.receive()? {
                    // Each process cuts its own views, and their number depends on the time left.
                    // Only a finding anywhere in the frame counts.
                    let mut answer = StageAnswer { took_ns: None, ..searched(&message, 0) };
                    answer.found.truncate(1);
                    answer.found.iter_mut().for_each(|found| *found = (0, None));
                    judge.note(message.header.view_generation, answer);
                }
                while let Some(message) = frame_ends.receive()? {
                    let end = &message.header;
                    let took_ns = Some(end.ended_ns - end.taken_ns);
                    let frame = end.stamp.order();
                    judge.note(
                        end.generation,
                        StageAnswer { frame, part: 0, found: Vec::new(), took_ns },
                    );
                }
            }
            Self::Rotations(rotations) => {
                while let Some(message) = rotations.receive()? {
                    let rotation = &message.header;
                    let is_known = rotation.source != RotationSource::Nothing.code();
                    // Twice the vector part is the rotation vector, to first order for small
                    // angles.
                    let [x, y, z, w] = rotation.later_from_earlier;
                    let turned = Vector3::new(x, y, z) * (2.0 * w.signum());
                    let found = is_known.then_some((0, Some(turned))).into_iter().collect();
                    let took_ns = Some(clock::monotonic_ns() - rotation.stamp.published_ns);
                    let frame = rotation.stamp.order();
                    judge.note(rotation.generation, StageAnswer { frame, part: 0, found, took_ns });
                }
            }
            Self::Tracks(tracks) => {
                while let Some(message) = tracks.receive()? {
                    let measured = message.items().iter().filter(|track| track.is_measured());
                    let found = measured
                        .map(|track| {
                            (track.target, Some(track.observer_from_target.position.into()))
                        })
                        .collect();
                    let header = &message.header;
                    let took_ns = Some(clock::monotonic_ns() - header.stamp.published_ns);
                    let frame = header.stamp.order();
                    judge.note(header.generation, StageAnswer { frame, part: 0, found, took_ns });
                }
            }
        }
        Ok(())
    }
}

/// The markers that were decoded in a view, each with the ray of its first corner.
fn searched(message: &Message<Detections>, part: u64) -> StageAnswer {
    StageAnswer {
        frame: message.header.stamp.order(),
        part,
        found: message
            .items()
            .iter()
            .map(|marker| (marker.id, Some(marker.rays_in_camera[0].into())))
            .collect(),
        took_ns: Some(message.header.sent_ns - message.header.received_ns),
    }
}

/// Number of a view in its frame. Fusion may plan anew and rectification may cut again, so the
/// index alone is not enough.
fn view_number(header: &DetectionHeader) -> u64 {
    (u64::from(header.view_generation) << 40)
        | (u64::from(header.attempt) << 16)
        | u64::from(header.view_index)
}
