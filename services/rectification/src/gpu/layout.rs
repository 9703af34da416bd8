//! What the shader is told, and where in the buffers what lies.

use bytemuck::{Pod, Zeroable};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use nalgebra::Vector3;

/// `Sphere` of the shader: the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SphereUniform {
    /// Sides, pixels.
    pub width: u32,
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    pub reserved: u32,
}

/// `View` of the shader.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct ViewParameters {
    /// Direction of the pixel `start` in the camera frame, in units of the view's pixels.
    direction: [f32; 3],
    /// Pixels along a side.
    size: u32,
    /// From one pixel to its right neighbour.
    right: [f32; 3],
    /// Words of four pixels in a row.
    words_per_row: u32,
    /// From one pixel to the one below.
    down: [f32; 3],
    /// The view's first word in the output.
    first_word: u32,
    /// The pixel from which directions are counted.
    start: [i32; 2],
    reserved: [u32; 2],
}

/// Views laid out one behind the other.
#[derive(Debug, Default)]
pub(super) struct Layout {
    pub views: Vec<ViewParameters>,
    /// Words of the output.
    pub words: u64,
    /// Words in the longest row, and most rows.
    pub extent: [u32; 2],
}

impl Layout {
    pub(super) fn new(views: &[View]) -> Self {
        let mut layout = Self::default();
        for view in views {
            let words_per_row = view.size_px.div_ceil(4);
            // Views beyond 2^32 words are refused before they are cut: no buffer holds as many.
            let first_word = layout.words as u32;
            layout.views.push(parameters(view, words_per_row, first_word));
            layout.words += u64::from(words_per_row) * u64::from(view.size_px);
            layout.extent[0] = layout.extent[0].max(words_per_row);
            layout.extent[1] = layout.extent[1].max(view.size_px);
        }
        layout
    }

    /// Copies view `index` out of the output's bytes, rows without gaps.
    pub(super) fn copy_out(&self, index: usize, bytes: &[u8], out: &mut [u8]) {
        let view = &self.views[index];
        let (size, pitch) = (view.size as usize, 4 * view.words_per_row as usize);
        let bytes = &bytes[4 * view.first_word as usize..][..pitch * size];
        if pitch == size {
            out[..size * size].copy_from_slice(bytes);
        } else {
            for (row, out) in bytes.chunks(pitch).zip(out.chunks_mut(size)) {
                out.copy_from_slice(&row[..size]);
            }
        }
    }
}

/// Directions are counted from the pixel next to a pole, if the view shows one, so that single
/// precision tells the columns apart there too; from the middle otherwise.
fn parameters(view: &View, words_per_row: u32, first_word: u32) -> ViewParameters {
    let axes = view.camera_from_view.to_rotation_matrix();
    let axis = |k| -> Vector3<f64> { axes.matrix().column(k).into_owned() };
    let (right, down, ahead) = (axis(0), axis(1), axis(2) * view.focal_px);
    let middle = view.centre_px();
    let start = [Vector3::z_axis(), -Vector3::z_axis()]
        .iter()
        .find(|pole| view.holds(pole, -1.0))
        .and_then(|pole| view.project(pole))
        .map_or([middle, middle], |pixel| [pixel.0.x, pixel.0.y])
        .map(f64::round);
    let direction = ahead + right * (start[0] - middle) + down * (start[1] - middle);
    let single = |vector: Vector3<f64>| [vector.x as f32, vector.y as f32, vector.z as f32];
    ViewParameters {
        direction: single(direction),
        size: view.size_px,
        right: single(right),
        words_per_row,
        down: single(down),
        first_word,
        start: start.map(|pixel| pixel as i32),
        reserved: [0; 2],
    }
}

impl SphereUniform {
    pub(super) fn new(camera: &Camera, stride: usize) -> Self {
        let (width, height) = (camera.width(), camera.height());
        // Longer strides make frames that no buffer holds, which are refused before.
        Self { width, height, stride: u32::try_from(stride).unwrap_or(u32::MAX), reserved: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_of_any_size_lie_on_whole_words() {
        let at = |size| View::looking_at(&Vector3::x_axis(), 1.0, size);
        let layout = Layout::new(&[at(5), at(8), at(1)]);
        let first: Vec<_> = layout.views.iter().map(|view| view.first_word).collect();
        assert_eq!((first, layout.words, layout.extent), (vec![0, 10, 26], 27, [2, 8]));
        let bytes: Vec<u8> = (0..108).collect();
        let mut out = [0; 25];
        layout.copy_out(0, &bytes, &mut out);
        assert_eq!((out[4], out[5], out[24]), (4, 8, 36));
        let mut out = [0; 64];
        layout.copy_out(1, &bytes, &mut out);
        assert_eq!((out[0], out[63]), (40, 103));
    }

    #[test]
    fn directions_are_counted_from_a_pole_that_is_seen() {
        let tilted = nalgebra::Unit::new_normalize(Vector3::new(0.3, 0.1, 1.0));
        let view = View::looking_at(&tilted, 1.5, 901);
        let parameters = parameters(&view, 226, 0);
        let [x, y, z] = parameters.direction;
        assert!(x.hypot(y) < 0.72 && z > 400.0, "{parameters:?}");
        let level = View::looking_at(&Vector3::y_axis(), 1.0, 100);
        assert_eq!(super::parameters(&level, 25, 0).start, [50, 50]);
    }
}
