//! How a pipeline runs: the key `profile`, and all that follows from it.

use std::time::Duration;

use flockeye_contract::{SearchMode, StageName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Costs, InertialSource, Pipeline};

/// How a pipeline runs: how frames flow, what limits the work on each, and whether neighbours are
/// tracked from frame to frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Profile {
    /// In real time: the newest frame wins everywhere, and the clock limits the work on it.
    #[default]
    Flight,
    /// Every frame gets the work that flight has time for, by stated costs in place of the clock.
    /// The poses are those of flight, and repeat byte by byte.
    Repeat,
    /// Every frame gets all passes at once, and four tiles with all threshold windows, however long it takes.
    Unlimited,
    /// Every frame is a picture for itself, unrelated to the others: nothing is tracked or predicted,
    /// the whole sphere is searched at twice its resolution, and so are bodies that no marker shows.
    Stills,
}

/// How frames flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flow {
    /// The newest frame wins at every border; what is dropped is counted.
    Latest,
    /// Every frame is worked on; results do not depend on time.
    Lossless,
}

impl Flow {
    /// Its name in recordings and in `pipeline.json`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Latest => "latest",
            Self::Lossless => "lossless",
        }
    }
}

/// What limits the work on a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameLimit {
    /// The time until the next frame.
    Time,
    /// The time until the next frame, of which each piece of work takes what [`Costs`] states.
    Costs,
    /// Nothing.
    Unlimited,
}

/// What a profile means: a row of the table in [`Profile::conduct`].
#[derive(Debug, Clone, Copy)]
struct Conduct {
    flow: Flow,
    limit: FrameLimit,
    /// Whether a filter links the measurements of a neighbour from frame to frame.
    has_tracks: bool,
    /// Factor on the deadlines of frames and views.
    patience: f64,
    /// Pixels of a tile for each of the sphere's along a side. Without tracks no magnified region of
    /// interest follows the first search.
    tile_magnification: f64,
}

impl Profile {
    /// All profiles.
    pub const ALL: [Self; 4] = [Self::Flight, Self::Repeat, Self::Unlimited, Self::Stills];

    /// Its name in the configuration.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Flight => "flight",
            Self::Repeat => "repeat",
            Self::Unlimited => "unlimited",
            Self::Stills => "stills",
        }
    }

    /// How it runs, in words.
    pub const fn about(self) -> &'static str {
        match self {
            Self::Flight => "in real time, the newest frame wins",
            Self::Repeat => "every frame, in the time that flight has, by stated costs",
            Self::Unlimited => "every frame, however long it takes",
            Self::Stills => "every frame, each for itself",
        }
    }

    /// How frames flow.
    pub const fn flow(self) -> Flow {
        self.conduct().flow
    }

    /// What each profile means. No stage asks which profile it is.
    const fn conduct(self) -> Conduct {
        let flight = Conduct {
            flow: Flow::Latest,
            limit: FrameLimit::Time,
            has_tracks: true,
            patience: 1.0,
            tile_magnification: 1.0,
        };
        let repeat = Conduct { flow: Flow::Lossless, limit: FrameLimit::Costs, ..flight };
        match self {
            Self::Flight => flight,
            Self::Repeat => repeat,
            Self::Unlimited => Conduct { limit: FrameLimit::Unlimited, ..repeat },
            // Nobody waits for a still, and all its views are magnified.
            Self::Stills => {
                Conduct { has_tracks: false, patience: 10.0, tile_magnification: 2.0, ..repeat }
            }
        }
    }
}

/// What follows from the profile, together with other keys.
impl Pipeline {
    /// How frames flow.
    pub fn flow(&self) -> Flow {
        self.profile.flow()
    }

    /// What limits the work on a frame.
    pub fn limit(&self) -> FrameLimit {
        self.profile.conduct().limit
    }

    /// What each piece of work on a frame costs, by statement.
    pub fn costs(&self) -> Costs {
        Costs { processors: self.search.processors, ..Costs::default() }
    }

    /// Whether each frame has a limited time, by the clock or by stated costs.
    pub fn is_limited(&self) -> bool {
        self.limit() != FrameLimit::Unlimited
    }

    /// Whether a filter links the measurements of a neighbour from frame to frame.
    pub fn has_tracks(&self) -> bool {
        self.profile.conduct().has_tracks
    }

    /// Whether a stage runs. One of the sources does, and the gateway unless it is switched off. ROS 2 and
    /// the autopilot run where they are configured and the gateway is on. Egomotion runs where neighbours
    /// are tracked, and the inertial stage where the sensor is no part of the source.
    pub fn runs(&self, stage: StageName) -> bool {
        match stage {
            StageName::Gateway => self.gateway.enabled,
            // Without a gateway nothing leaves this drone.
            StageName::Ros2 => self.gateway.enabled && self.ros2.is_some(),
            StageName::Autopilot => self.gateway.enabled && self.autopilot.is_some(),
            StageName::Egomotion => self.egomotion.enabled && self.has_tracks(),
            // Also where egomotion does not use it: its samples can be recorded.
            StageName::Inertial => {
                matches!(self.inertial.parsed_source(), Ok(InertialSource::Mavlink(_)))
            }
            source if source.is_source() => source == self.source.stage(),
            _ => true,
        }
    }

    /// Whether each neighbour is searched where it is predicted, and the sphere is swept in the remaining
    /// time. Without tracks there is no prediction, and the whole sphere is searched.
    pub fn has_regions(&self) -> bool {
        self.search.mode == SearchMode::Roi && self.has_tracks()
    }

    /// Whether each frame is a picture for itself that is searched as well as can be. The paper's modes
    /// keep their own extent.
    pub fn has_single_images(&self) -> bool {
        self.search.mode == SearchMode::Roi && !self.has_tracks()
    }

    /// Views of places that look like a body, in a frame with a target without a track:
    /// `search.proposals`, and twice as many in single images, which are looked at more closely and have
    /// more such places.
    pub fn proposals(&self) -> usize {
        let proposals = self.search.proposals as usize;
        match (self.has_regions(), self.has_single_images()) {
            (true, _) => proposals,
            (false, true) => 2 * proposals,
            (false, false) => 0,
        }
    }

    /// Whether a tile is searched with one threshold window at a time, the windows in turn.
    pub fn alternates_windows(&self) -> bool {
        self.has_regions() && self.is_limited()
    }

    /// Pixels of a tile for each of the sphere's, along a side.
    pub fn tile_magnification(&self) -> f64 {
        self.profile.conduct().tile_magnification
    }

    /// How long a frame is waited for: `fusion.deadline_ms`.
    pub fn frame_deadline(&self) -> Duration {
        Duration::from_secs_f64(self.fusion.deadline_ms * 1e-3 * self.profile.conduct().patience)
    }

    /// How long a lossless source waits for the answer to a frame. Fusion itself drops a frame after
    /// [`Self::frame_deadline`], so this is longer. A single image is searched beyond it, for each body at
    /// each place.
    pub fn answer_deadline(&self) -> Duration {
        self.frame_deadline() * if self.has_single_images() { 20 } else { 3 }
    }

    /// After how long a worker's silence its views are given to another: `rectification.overdue_ms`.
    pub fn view_overdue(&self) -> Duration {
        Duration::from_secs_f64(
            self.rectification.overdue_ms * 1e-3 * self.profile.conduct().patience,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(profile: Profile, mode: SearchMode) -> Pipeline {
        let mut pipeline = Pipeline { profile, ..Pipeline::default() };
        pipeline.search.mode = mode;
        pipeline
    }

    #[test]
    fn tiles_alternate_windows_where_targets_are_followed_and_time_is_limited() {
        let says = |profile, mode| {
            let pipeline = of(profile, mode);
            (pipeline.has_regions(), pipeline.alternates_windows())
        };
        assert_eq!(says(Profile::Flight, SearchMode::Roi), (true, true));
        assert_eq!(says(Profile::Repeat, SearchMode::Roi), (true, true));
        assert_eq!(says(Profile::Unlimited, SearchMode::Roi), (true, false));
        assert_eq!(says(Profile::Stills, SearchMode::Roi), (false, false));
        assert_eq!(says(Profile::Flight, SearchMode::Exhaustive), (false, false));
    }

    #[test]
    fn single_images_have_twice_the_proposals_and_other_searches_of_all_tiles_have_none() {
        let says = |profile, mode| {
            let pipeline = of(profile, mode);
            (pipeline.has_single_images(), pipeline.proposals())
        };
        assert_eq!(says(Profile::Flight, SearchMode::Roi), (false, 12));
        assert_eq!(says(Profile::Stills, SearchMode::Roi), (true, 24));
        assert_eq!(says(Profile::Stills, SearchMode::Exhaustive), (false, 0));
        assert_eq!(says(Profile::Repeat, SearchMode::Exhaustive), (false, 0));
    }

    #[test]
    fn stills_are_waited_for_ten_times_as_long_and_magnified() {
        let says = |profile| {
            let pipeline = of(profile, SearchMode::Roi);
            let waits = [pipeline.frame_deadline(), pipeline.view_overdue()];
            (waits.map(|wait| wait.as_millis()), pipeline.tile_magnification())
        };
        for profile in [Profile::Flight, Profile::Repeat, Profile::Unlimited] {
            assert_eq!(says(profile), ([3000, 500], 1.0), "{profile:?}");
        }
        assert_eq!(says(Profile::Stills), ([30_000, 5000], 2.0));
        let runs = |profile| of(profile, SearchMode::Roi).runs(StageName::Egomotion);
        assert_eq!(Profile::ALL.map(runs), [true, true, true, false]);
        let answers = Profile::ALL.map(|profile| of(profile, SearchMode::Roi).answer_deadline());
        assert_eq!(answers.map(|wait| wait.as_secs()), [9, 9, 9, 600]);
    }
}
