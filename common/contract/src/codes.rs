//! The enumerations of the contract.
//!
//! In shared memory they are `u32` codes, because a foreign stage may write any number; here they
//! are Rust enums, and the border between the two is `TryFrom<u32>`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ContractError;

/// A Rust name in lower-case letters with underscores, and its length. Names have at most 32
/// letters.
pub(crate) const fn snake_case(name: &str) -> ([u8; 64], usize) {
    let (name, mut snake, mut length, mut place) = (name.as_bytes(), [0; 64], 0, 0);
    while place < name.len() {
        if name[place].is_ascii_uppercase() && place > 0 {
            snake[length] = b'_';
            length += 1;
        }
        snake[length] = name[place].to_ascii_lowercase();
        length += 1;
        place += 1;
    }
    (snake, length)
}

/// The text of these bytes, which are ASCII.
pub(crate) const fn text((bytes, length): &([u8; 64], usize)) -> &str {
    match str::from_utf8(bytes.split_at(*length).0) {
        Ok(text) => text,
        Err(_) => "",
    }
}

macro_rules! codes {
    ($(#[$doc:meta])* $name:ident, $what:literal { $($(#[$variant_doc:meta])* $variant:ident = $code:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
        #[serde(rename_all = "snake_case")]
        #[repr(u32)]
        pub enum $name { $($(#[$variant_doc])* $variant = $code),+ }

        impl $name {
            /// Every value, in the order of the codes.
            pub const ALL: &'static [$name] = &[$($name::$variant),+];

            /// Their names in Rust, in the same order.
            pub(crate) const NAMES: &'static [&'static str] = &[$(stringify!($variant)),+];

            /// Its name in texts and JSON, such as `picture_and_inertial`.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => {
                        const SNAKE: ([u8; 64], usize) = snake_case(stringify!($variant));
                        const NAME: &str = text(&SNAKE);
                        NAME
                    })+
                }
            }

            /// The number that stands for it in shared memory.
            pub const fn code(self) -> u32 {
                self as u32
            }
        }

        impl From<$name> for u32 {
            fn from(value: $name) -> u32 {
                value.code()
            }
        }

        impl TryFrom<u32> for $name {
            type Error = ContractError;

            fn try_from(code: u32) -> Result<Self, ContractError> {
                match code {
                    $($code => Ok($name::$variant),)+
                    code => Err(ContractError::Code { what: $what, code }),
                }
            }
        }
    };
}

codes! {
    /// How a frame's samples lie in memory. The luma plane always comes first.
    PixelFormat, "pixel format" {
        /// One 8-bit luma plane and nothing else.
        Gray8 = 0,
        /// A luma plane, then interleaved chroma at half resolution, rows of the same stride.
        Nv12 = 1,
    }
}

codes! {
    /// How a source's pictures are coded.
    VideoCodec, "video codec" {
        /// Not at all, or not by one of these: no packets come.
        None = 0,
        /// ITU-T H.264.
        H264 = 1,
        /// ITU-T H.265.
        H265 = 2,
    }
}

codes! {
    /// The curve between light and code values.
    Transfer, "transfer curve" {
        /// The sRGB curve (IEC 61966-2-1).
        Srgb = 0,
        /// code = light^(1/gamma), gamma in the field beside it.
        Gamma = 1,
        /// Code values proportional to light.
        Linear = 2,
        /// As the table in the configuration says (`camera.response_table`).
        Table = 3,
    }
}

codes! {
    /// Which code values stand for black and white.
    Range, "range" {
        /// 0 to 255.
        Full = 0,
        /// 16 to 235, as in most video.
        Limited = 1,
    }
}

codes! {
    /// The camera model a frame was taken with.
    Projection, "projection" {
        /// Longitude along the rows, latitude along the columns; see `docs/CONTRACT.md`.
        Equirectangular = 0,
        /// Two fisheye lenses, each with its image circle, calibrated in the configuration.
        DualFisheye = 1,
        /// The stereographic plane about the camera's x axis, as the configuration says.
        Stereographic = 2,
    }
}

codes! {
    /// What the camera's own rotation was measured by.
    RotationSource, "rotation source" {
        /// It is not known.
        Nothing = 0,
        /// By the picture of the sphere.
        Picture = 1,
        /// By the inertial sensor alone, because the picture did not tell.
        Inertial = 2,
        /// By both.
        PictureAndInertial = 3,
    }
}

codes! {
    /// Why a view was cut.
    ViewKind, "view kind" {
        /// A tile of the sphere: one of the partition's views.
        Partition = 0,
        /// A region of interest: a small view centred on where a neighbour is predicted.
        Roi = 1,
        /// A high-resolution tile: one of the finer tiles that show neighbours at long range.
        HighResolution = 2,
        /// A proposal: a small view of a place that looks like a body. A plan asks for it, rectification
        /// finds the place.
        Proposal = 3,
    }
}

codes! {
    /// How a view is searched for markers.
    Search, "search" {
        /// With every threshold window that the detector has for views of this kind.
        AllWindows = 0,
        /// With the finest window alone, which finds most markers.
        FineWindow = 1,
        /// With the coarsest window alone, which finds bright markers that touch something dark.
        CoarseWindow = 2,
        /// Not at all: only the pixels are wanted. The view is acknowledged all the same.
        Nothing = 3,
    }
}

codes! {
    /// When rectification stops cutting views from a frame.
    StopRule, "stop rule" {
        /// After the first view that holds a marker of a configured body (the paper).
        FirstHit = 0,
        /// After the last view of the plan.
        All = 1,
        /// When a newer frame has come or is due; in a lossless run after a fixed number of views.
        Deadline = 2,
    }
}

codes! {
    /// Why a frame ended.
    StopReason, "stop reason" {
        /// Every view of the plan was cut.
        Complete = 0,
        /// A view held a marker, and the rule was `first_hit`.
        Hit = 1,
        /// A newer frame had come, or was due, and the rule was `deadline`.
        Newer = 2,
        /// The fixed number of views of a lossless run was reached.
        Budget = 3,
        /// The views could not be cut; the log says why.
        Failed = 4,
        /// The stage was told to stop.
        Shutdown = 5,
        /// A worker did not answer in time, and there was no other worker.
        Overdue = 6,
    }
}

codes! {
    /// How fusion searches a frame: section III-C of the paper, and our own modes.
    SearchMode, "search mode" {
        /// Partitions in a fixed order until the first hit.
        Greedy = 0,
        /// The paper's Algorithm 1.
        Optimized = 1,
        /// Every partition of every frame.
        Exhaustive = 2,
        /// Magnified views at the predicted neighbours first, then partitions, least recently searched first.
        Roi = 3,
    }
}

codes! {
    /// State of a neighbour's track.
    TrackState, "track state" {
        /// Measured too few times to be confirmed.
        Tentative = 0,
        /// Confirmed, and corrected by a pose of this frame, precise (`measured_by`) or not.
        Confirmed = 1,
        /// Confirmed, but only predicted: nothing was measured in this frame.
        Coasting = 2,
        /// Not measured for too long; the last message of a track.
        Lost = 3,
        /// Solved from this frame alone (`profile: stills`).
        Measured = 4,
    }
}

impl TrackState {
    /// Whether a track of this state is a neighbour that is there: neither tentative nor lost.
    pub const fn is_present(self) -> bool {
        matches!(self, Self::Confirmed | Self::Coasting | Self::Measured)
    }
}

codes! {
    /// What a frame's measurement of a neighbour was made from.
    MeasuredBy, "measurement source" {
        /// Nothing was measured in this frame.
        Nothing = 0,
        /// Decoded markers.
        Decoded = 1,
        /// The body aligned with the image.
        Aligned = 2,
    }
}

codes! {
    /// State that a stage reports.
    StageState, "stage state" {
        /// Opening its ports and devices.
        Starting = 0,
        /// Doing its work.
        Ready = 1,
        /// Told to stop, finishing what it has.
        Draining = 2,
        /// At the end of its input.
        Finished = 3,
        /// Waiting for something outside to come back (a camera, say).
        Degraded = 4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_serde() {
        fn check<C: Serialize + Copy>(all: &[C], name: impl Fn(C) -> &'static str) {
            for &code in all {
                assert_eq!(serde_json::to_value(code).expect("a text"), name(code));
            }
        }
        check(TrackState::ALL, TrackState::name);
        check(StageState::ALL, StageState::name);
        check(SwarmWay::ALL, SwarmWay::name);
        check(MeasuredBy::ALL, MeasuredBy::name);
        check(RotationSource::ALL, RotationSource::name);
        check(PixelFormat::ALL, PixelFormat::name);
        check(SearchMode::ALL, SearchMode::name);
        check(ViewKind::ALL, ViewKind::name);
        assert_eq!(RotationSource::PictureAndInertial.name(), "picture_and_inertial");
    }

    #[test]
    fn codes_come_back() {
        for &state in TrackState::ALL {
            assert_eq!(TrackState::try_from(state.code()), Ok(state));
        }
        assert_eq!(
            StopRule::try_from(77),
            Err(ContractError::Code { what: "stop rule", code: 77 })
        );
    }
}

codes! {
    /// How a drone's place in the swarm is known.
    SwarmWay, "swarm way" {
        /// This drone sees it.
        Direct = 0,
        /// Each of the two sees the other.
        Mutual = 1,
        /// It sees this drone, and is not seen by it.
        Reported = 2,
        /// Through others alone.
        Chained = 3,
    }
}

codes! {
    /// How far one process of a stage has replaced another.
    HandOverState, "hand-over state" {
        /// No stage is being replaced: every process counts.
        Nothing = 0,
        /// The new process works beside the old one, and what it says does not count.
        Shadow = 1,
        /// The new process counts from the frame `first` on, the old one before it.
        TakenOver = 2,
    }
}

codes! {
    /// What happened to fusion's core.
    JournalKind, "journal kind" {
        /// It heard of a view.
        View = 0,
        /// It heard a detection record.
        Searched = 1,
        /// It heard the end of a frame.
        FrameEnd = 2,
        /// It heard how the camera has turned.
        Rotation = 3,
        /// It got the answer to the oldest background pass that was not answered yet.
        Background = 4,
        /// It did a piece of work.
        Step = 5,
        /// What the last step led to was sent.
        Said = 6,
    }
}

codes! {
    /// What a stage complains of.
    ComplaintKind, "complaint kind" {
        /// A worker was given views and has answered none in time.
        Unanswered = 0,
        /// Messages of a process were refused.
        Refused = 1,
    }
}
