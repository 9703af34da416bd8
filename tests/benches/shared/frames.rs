//! The frames of a recording.

use std::path::Path;
use std::time::Duration;

use flockeye_capture::{Event, FrameSource, SourceParameters};
use flockeye_config::Flow;
use flockeye_geometry::camera::Camera;
use flockeye_imaging::sphere::SphereImage;

/// Calls `each` for each frame and its number, from 0.
pub fn each_frame(path: &Path, camera: Camera, mut each: impl FnMut(u64, &SphereImage<'_>)) {
    let parameters = SourceParameters {
        flow: Flow::Lossless,
        ..SourceParameters::new(camera.width(), camera.height())
    };
    let mut source =
        FrameSource::open(path.display().to_string().parse().unwrap(), parameters).unwrap();
    for number in 0.. {
        let picture = loop {
            match source.next(Duration::from_secs(5)).unwrap() {
                Event::Frame(picture) => break picture,
                Event::End(_) => return,
                _ => {}
            }
        };
        each(number, &SphereImage::new(picture.luma(), picture.stride(), camera).unwrap());
    }
}
