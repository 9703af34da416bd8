//! Why nothing can be calibrated, with its cure.

/// Fewest places that tell a mount.
pub(super) const LEAST_PLACES: usize = 3;
/// Time offsets between picture and sensor are searched up to this, either way, seconds.
pub(super) const SEARCHED_S: f64 = 0.8;
/// Fewest frames of both picture and sensor that can be calibrated from.
pub(super) const LEAST_FRAMES: usize = 30;

/// Why nothing can be calibrated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// Too few frames tell where the markers of a body are relative to each other.
    #[error(
        "body '{body}' was seen with two markers or more in {frames} frames; {needed} are needed. \
         Cure: record longer and nearer, so that several markers are read in each frame"
    )]
    BodySeldomSeen { body: String, frames: usize, needed: usize },
    /// Markers that were never seen together with the others, of which `with` is the first.
    #[error(
        "markers {apart:?} of body '{body}' were never seen together with marker {with}. Cure: turn \
         the body so that they are seen in one frame, {needed} frames or more"
    )]
    MarkersApart { body: String, apart: Vec<u32>, with: u32, needed: usize },
    /// The frames do not determine the markers' places.
    #[error(
        "the frames do not determine the markers of body '{body}'. Cure: record it nearer and from \
         more sides"
    )]
    BodyUndetermined { body: String },
    /// A camera model in which there are no two lenses.
    #[error(
        "a camera of this projection has one centre. Cure: camera.projection equirectangular or dual_fisheye, if \
         it has two lenses"
    )]
    OneCentre,
    /// Too few frames in which a body spans the seam between the lenses.
    #[error(
        "in {frames} frames both lenses saw markers of one body; {needed} are needed. Cure: carry the body \
         slowly across the seam between the lenses, 0.3 to 0.8 m away, so that some of its markers are left and \
         some right of it, or use a larger body"
    )]
    SeamSeldomSpanned { frames: usize, needed: usize },
    /// Frames that leave something of the lenses open: what is known worst, and how well.
    #[error(
        "the frames leave the lenses open: {what} would be known to +- {deviation:.1} {unit} only. Cure: carry \
         the body across the seam at several places round it (left, right, above, below), near and far"
    )]
    LensesUndetermined { what: &'static str, deviation: f64, unit: &'static str },
    /// Fewer places than tell a mount.
    #[error(
        "{places} places with a pose; {LEAST_PLACES} or more are needed. Cure: put the body at more places, \
         where the camera sees it"
    )]
    TooFewPlaces { places: usize },
    /// Places on a line, or too near to each other.
    #[error(
        "the places lie too near to one line, or to each other: they would tell the camera's turn about \
         ({:.2}, {:.2}, {:.2}) to +- {deviation_deg:.1} degrees only. Cure: put the body on several sides of \
         the drone, not in one line, and farther apart",
        axis[0], axis[1], axis[2]
    )]
    MountUndetermined {
        /// The axis in the drone's frame about which the turn is known worst.
        axis: [f64; 3],
        deviation_deg: f64,
    },
    /// A place, counted from 1, that is none.
    #[error(
        "place {place} (counted from 1): its position, deviation or pose is no number above 0. Cure: correct it"
    )]
    PlaceWithoutNumber { place: usize },
    /// Too little was recorded by both picture and sensor.
    #[error(
        "picture and sensor have {found} frames in common, {LEAST_FRAMES} are needed: is the sensor sending?"
    )]
    FewComparisons { found: usize },
    /// Picture and sensor do not move together.
    #[error(
        "the sensor does not turn as the picture does, at no time offset within {SEARCHED_S} s ({left:.0} \
         % of the rates' variation is left): is it on this drone, and was the drone turned?"
    )]
    SensorUnrelated {
        /// Percent of the variation that is left.
        left: f64,
    },
    /// One or three axes of the sensor have the wrong sign.
    #[error(
        "the sensor's axes are left-handed: one axis has the wrong sign. No mounting cures that; mend it \
         where samples are read"
    )]
    LeftHanded,
    /// The drone turned about one axis only.
    #[error(
        "the mounting about an axis is known to {deviation_deg:.1} degrees only: turn the drone about all \
         three axes, by 20 degrees and more"
    )]
    OneAxis {
        /// Largest standard deviation of the mounting, degrees.
        deviation_deg: f64,
    },
}
