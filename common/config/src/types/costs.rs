//! What each piece of work costs: the virtual clock of a lossless run.

/// Processor time of each piece of work. `profile: repeat` and `stills` go by it instead of the time, so
/// that they do what flight does and repeat byte by byte. Flight itself goes by the time.
///
/// All machines state the same costs: a recording gives the same poses wherever it is worked on. Only how
/// many processors the flying machine has is configured, `search.processors`.
#[derive(Debug, Clone, PartialEq)]
pub struct Costs {
    /// How many processors work on a frame: `search.processors`.
    pub processors: f64,
    /// What a frame takes before it is searched, decoding above all, milliseconds.
    pub source_ms: f64,
    /// What the camera's own rotation takes in each frame, milliseconds.
    pub egomotion_ms: f64,
    /// Finding places that look like a body, in each frame while a neighbour is not tracked, milliseconds.
    pub proposals_ms: f64,
    /// Cutting a view, for each million of its pixels, milliseconds.
    pub cut_ms_per_megapixel: f64,
    /// Searching a view for markers with one threshold window, for each million of its pixels,
    /// milliseconds.
    pub window_ms_per_megapixel: f64,
    /// Aligning a tracked neighbour from its prediction, milliseconds.
    pub direct_pass_ms: f64,
    /// Measuring a tracked neighbour from its markers, milliseconds.
    pub corner_pass_ms: f64,
    /// Measuring an untracked neighbour, milliseconds.
    pub initiation_ms: f64,
    /// A background pass until its answer, milliseconds.
    pub background_pass_ms: f64,
}

impl Default for Costs {
    /// What `make results PARTS=costs` measured on two logical processors of the machine that
    /// `docs/results/costs.md` names.
    fn default() -> Self {
        Self {
            processors: 1.3,
            source_ms: 20.0,
            egomotion_ms: 2.2,
            proposals_ms: 4.5,
            cut_ms_per_megapixel: 2.5,
            window_ms_per_megapixel: 4.0,
            direct_pass_ms: 3.5,
            corner_pass_ms: 4.0,
            initiation_ms: 8.0,
            background_pass_ms: 8.0,
        }
    }
}
