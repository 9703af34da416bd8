//! Pure mathematics of Flockeye, without input or output.
//!
//! | module | what it answers |
//! | --- | --- |
//! | [`camera`] | which ray does a pixel of the sphere image see, and back |
//! | [`mask`] | what can the camera not see |
//! | [`view`] | which ray does a pixel of a square pinhole view see, and back |
//! | [`partition`] | which views cover the whole sphere |
//! | [`body`] | where are a body's markers and their corners |
//! | [`pose`] | which pose of a body explains a set of rays |
//! | [`ego_rotation`] | how has the camera itself turned |
//! | [`inertial`] | what does an inertial sensor say of that, and how far is it right |
//! | [`filter`] | where is a neighbour now, and where will it be |
//! | [`search`] | where to look in the next frame |
//! | [`timeline`] | what lies between two samples over time |
//! | [`statistics`] | what are the mean, the median and the quantiles of some values |
//!
//! ```
//! use flockeye_geometry::body::squares;
//! use flockeye_geometry::pose::{CornerRay, solve};
//! use nalgebra::{Isometry3, Point3, Unit, Vector3};
//!
//! // A neighbour 1.5 m ahead, and the rays to the corners of its markers that face the camera.
//! let body = squares("alpha", 0.0625, 0.05, 0);
//! let camera_from_markers = Isometry3::new(Vector3::new(1.5, 0.2, 0.1), Vector3::new(0.1, 0.2, 0.4));
//! let eye_in_markers = camera_from_markers.inverse_transform_point(&Point3::origin());
//! let mut rays = Vec::new();
//! for marker in &body.markers {
//!     if marker.normal().dot(&(eye_in_markers - marker.centre()).normalize()) > 0.5 {
//!         rays.extend(marker.corners.iter().enumerate().map(|(corner, at)| CornerRay {
//!             marker_id: marker.id,
//!             corner,
//!             ray_in_camera: Unit::new_normalize((camera_from_markers * at).coords),
//!             deviation_rad: 2e-4,
//!         }));
//!     }
//! }
//! let poses = solve(&body, &rays)?;
//! let error = poses[0].camera_from_markers.translation.vector - camera_from_markers.translation.vector;
//! assert!(error.norm() < 1e-3);
//! # Ok::<(), flockeye_geometry::pose::PoseError>(())
//! ```
//!
//! Frames are right-handed; body and camera frames are x forward, y left, z up; a view's frame is
//! x right, y down, z forward. Every transform is named `target_from_source`.

pub mod body;
pub mod camera;
pub mod ego_rotation;
pub mod filter;
#[cfg(any(test, feature = "fixtures"))]
pub mod fixtures;
pub mod inertial;
pub mod mask;
pub mod partition;
pub mod pose;
mod random;
pub mod search;
pub mod statistics;
pub mod timeline;
pub mod view;

/// A unit direction. The name of the variable states its frame.
pub type Ray = nalgebra::Unit<nalgebra::Vector3<f64>>;
