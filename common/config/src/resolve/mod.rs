//! What is made of a configuration: bodies with their geometry, the camera, the views that cover its
//! sphere.

mod bodies;
mod camera;
mod mount;
mod sphere;

pub(crate) use bodies::preset_body;
pub use bodies::{BodySetError, read_bodies};
pub use camera::{CameraSettingError, MaskFileError};
pub use mount::isometry;
pub use sphere::SphereViewsError;
