//! Errors of calibrations, with their cures.

/// Fewest places that determine a mount.
pub(super) const LEAST_PLACES: usize = 3;
/// Largest time offset between picture and sensor that is searched, in both directions, seconds.
pub(super) const SEARCHED_S: f64 = 0.8;
/// Fewest frames with both picture and sensor data for a calibration.
pub(super) const LEAST_FRAMES: usize = 30;

/// The reason why a calibration is impossible.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum CalibrationError {
    /// Too few frames show two or more markers of a body.
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
    /// A camera model without two lenses.
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
    /// Frames that do not determine the lenses: the least certain quantity, and its deviation.
    #[error(
        "the frames leave the lenses open: {what} would be known to +- {deviation:.1} {unit} only. Cure: carry \
         the body across the seam at several places round it (left, right, above, below), near and far"
    )]
    LensesUndetermined { what: &'static str, deviation: f64, unit: &'static str },
    /// Fewer places than a mount needs.
    #[error(
        "{places} places with a pose; {LEAST_PLACES} or more are needed. Cure: put the body at more places, \
         where the camera sees it"
    )]
    TooFewPlaces { places: usize },
    /// Places on a line or too near to each other, so that a turn of the camera is not determined.
    #[error(
        "the places lie too near to one line, or to each other: they would tell the camera's turn about \
         ({:.2}, {:.2}, {:.2}) to +- {deviation_deg:.1} degrees only. Cure: put the body on several sides of \
         the drone, not in one line, and farther apart",
        axis[0], axis[1], axis[2]
    )]
    MountUndetermined {
        /// The axis of the least certain turn, in the drone's frame.
        axis: [f64; 3],
        deviation_deg: f64,
    },
    /// A place, counted from 1, with an invalid number.
    #[error(
        "place {place} (counted from 1): its position, deviation or pose is no number above 0. Cure: correct it"
    )]
    PlaceWithoutNumber { place: usize },
    /// Too few frames have both picture and sensor data.
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
        /// Remaining share of the variation, percent.
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
