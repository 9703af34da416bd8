//! The names of OpenCV's own dictionaries.

/// OpenCV's predefined dictionaries, in the order of its own enumeration. Case is ignored, because
/// newer versions of OpenCV name `DICT_APRILTAG_16h5` also `DICT_APRILTAG_16H5`.
pub const PREDEFINED: [&str; 22] = [
    "DICT_4X4_50",
    "DICT_4X4_100",
    "DICT_4X4_250",
    "DICT_4X4_1000",
    "DICT_5X5_50",
    "DICT_5X5_100",
    "DICT_5X5_250",
    "DICT_5X5_1000",
    "DICT_6X6_50",
    "DICT_6X6_100",
    "DICT_6X6_250",
    "DICT_6X6_1000",
    "DICT_7X7_50",
    "DICT_7X7_100",
    "DICT_7X7_250",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
    MIP_36H12,
];

/// Name of the one that Debian's OpenCV does not have.
pub(crate) const MIP_36H12: &str = "DICT_ARUCO_MIP_36h12";
