//! CSV tables with the results of runs, and counts of how often the sphere is searched. `flockeye
//! up` writes the tables and `flockeye-lab` reads them. Capture reads the tables of inertial
//! sensors.
//!
//! | module | content |
//! | --- | --- |
//! | [`writer`] | a CSV file that is being written |
//! | [`table`] | CSV files read by the names of their columns |
//! | [`pose`] | each neighbour's pose in each frame |
//! | [`truth`] | the true poses, of a simulated flight or of a recording |
//! | [`frame_times`] | when each frame was published and when it ended |
//! | [`rotation`] | how the camera has turned to each frame |
//! | [`imu`] | samples of an inertial sensor |
//! | [`rays`] | the corner rays of detected markers |
//! | [`sweep`] | how often each part of the sphere is searched |

pub mod frame_times;
pub mod imu;
pub mod pose;
pub mod rays;
pub mod rotation;
pub mod sweep;
pub mod table;
pub mod truth;
pub mod writer;

pub use frame_times::FrameTimes;
pub use imu::{ImuRow, rate_record};
pub use pose::{MeasuredPose, PoseRow, PredictedPose};
pub use rays::MarkerRays;
pub use rotation::{RecordedTurn, RotationRow};
pub use table::{TableError, TableRow, read};
pub use truth::TruthRow;
pub use writer::{TableWriter, WrittenRow};
