//! Parameters of the shader, and layout of its buffers.

use bytemuck::{Pod, Zeroable};
use flockeye_geometry::camera::{Camera, CameraModel, Lens, LensCurve, Stereographic};
use flockeye_imaging::sphere::{Cut, Interpolation};
use nalgebra::Vector3;

/// Pixels in a word.
const WORD_PX: u32 = 4;

/// Sides of a workgroup: words across and rows down, as in the shader.
const TILE: u32 = 8;

/// Distance from a view within which a pole is near, pixels; at least the view's width.
const NEAR_A_POLE_PX: u32 = 64;

/// `Lens` of the shader.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct LensUniform {
    right: [f32; 3],
    focal_u: f32,
    down: [f32; 3],
    focal_v: f32,
    ahead: [f32; 3],
    half_field: f32,
    position: [f32; 3],
    circle: f32,
    centre: [f32; 2],
    curve: u32,
    xi: f32,
    coefficients: [f32; 4],
}

/// `Sphere` of the shader: the frame's camera.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SphereUniform {
    width: u32,
    height: u32,
    stride: u32,
    reserved: u32,
    offset: f32,
    plane_scale: f32,
    plane_circle: f32,
    padding: f32,
    lenses: [LensUniform; 2],
}

impl SphereUniform {
    pub(super) fn new(camera: &Camera, stride: usize) -> Self {
        let (width, height) = (camera.width(), camera.height());
        // Longer strides are refused before: no buffer has room for such a frame.
        let stride = u32::try_from(stride).unwrap_or(u32::MAX);
        let sphere = Self { width, height, stride, ..Self::default() };
        match camera.model() {
            CameraModel::Equirectangular { lens_distance_m } => {
                Self { offset: (lens_distance_m / 2.0) as f32, ..sphere }
            }
            CameraModel::DualFisheye(lenses) => {
                Self { lenses: lenses.each_ref().map(LensUniform::new), ..sphere }
            }
            &CameraModel::Stereographic { field_rad } => {
                let plane = Stereographic::new(width, height, field_rad);
                Self {
                    plane_scale: (2.0 * plane.radius_px) as f32,
                    plane_circle: plane.circle_px as f32,
                    ..sphere
                }
            }
        }
    }
}

impl LensUniform {
    fn new(lens: &Lens) -> Self {
        let axes = lens.camera_from_lens.rotation.to_rotation_matrix();
        let axis = |k: usize| single(axes.matrix().column(k).into_owned());
        let (curve, xi, coefficients) = match lens.curve {
            LensCurve::Equidistant(k) => (0, 0.0, k),
            LensCurve::DoubleSphere { xi, alpha } => (1, 0.0, [xi, alpha, 0.0, 0.0]),
            LensCurve::Unified { xi, distortion } => (2, xi, distortion),
        };
        let (xi, coefficients) = (xi as f32, coefficients.map(|k| k as f32));
        Self {
            right: axis(0),
            focal_u: lens.focal_px.x as f32,
            down: axis(1),
            focal_v: lens.focal_px.y as f32,
            ahead: axis(2),
            half_field: (lens.field_rad / 2.0) as f32,
            position: single(lens.camera_from_lens.translation.vector),
            circle: lens.circle_px as f32,
            centre: [lens.centre_px.x as f32, lens.centre_px.y as f32],
            curve,
            xi,
            coefficients,
        }
    }
}

/// `View` of the shader.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct ViewParameters {
    /// Direction of the pixel `start` in the camera frame, in pixels of the view.
    direction: [f32; 3],
    /// Pixels along a side.
    size: u32,
    /// Step from a pixel to its right neighbour.
    right: [f32; 3],
    /// Words of four pixels in a row.
    words_per_row: u32,
    /// Step from a pixel to the one below.
    down: [f32; 3],
    /// First word of the view in the output.
    first_word: u32,
    /// Reference pixel of the directions.
    start: [i32; 2],
    /// First workgroup of the view, and number of workgroups side by side.
    first_tile: u32,
    tiles_across: u32,
    /// Inverse of the distance at which the view is exact, 1/m.
    nearness: f32,
    /// 0: bilinear, 1: cubic.
    interpolation: u32,
    padding: [u32; 2],
}

/// Layout of the views of a batch: whole words in the output, whole workgroups in the dispatch.
#[derive(Debug, Default)]
pub(super) struct BatchLayout {
    pub(super) views: Vec<ViewParameters>,
    words: u32,
    tiles: u32,
}

impl BatchLayout {
    /// Adds a view, unless the output would exceed `max_bytes`. Returns whether it was added.
    pub(super) fn add(&mut self, cut: &Cut, camera: &Camera, max_bytes: u64) -> bool {
        let size = cut.view.size_px;
        let words_per_row = size.div_ceil(WORD_PX);
        // No overflow: the sides of a view are limited.
        let words = self.words + words_per_row * size;
        if 4 * u64::from(words) > max_bytes {
            return false;
        }
        let tiles_across = words_per_row.div_ceil(TILE);
        self.views.push(ViewParameters {
            words_per_row,
            first_word: self.words,
            first_tile: self.tiles,
            tiles_across,
            ..parameters(cut, camera)
        });
        self.words = words;
        self.tiles += tiles_across * size.div_ceil(TILE);
        true
    }

    /// Bytes of the output for one view alone.
    pub(super) fn bytes_alone(size_px: u32) -> u64 {
        u64::from(WORD_PX) * u64::from(size_px.div_ceil(WORD_PX)) * u64::from(size_px)
    }

    /// Bytes of the output.
    pub(super) fn bytes(&self) -> u64 {
        4 * u64::from(self.words)
    }

    /// Header of the views' buffer, as in the shader's `Batch`: number of views and of workgroups,
    /// and two words of padding.
    pub(super) fn header(&self) -> [u32; 4] {
        [self.views.len() as u32, self.tiles, 0, 0]
    }

    /// Workgroups across and down, at most `most` each. Several rows may have a few surplus
    /// workgroups.
    pub(super) fn workgroups(&self, most: u32) -> [u32; 2] {
        let down = self.tiles.div_ceil(most).max(1);
        [self.tiles.div_ceil(down), down]
    }

    /// Copies view `index` from the output's bytes to `out`, rows without gaps.
    pub(super) fn copy_out(&self, index: usize, bytes: &[u8], out: &mut [u8]) {
        let view = &self.views[index];
        let (size, pitch) = (view.size as usize, (WORD_PX * view.words_per_row) as usize);
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

/// Parameters of a view, without its position in the buffers. In an equirectangular image, the
/// reference pixel is next to a visible or near pole. So single precision is sufficient to separate
/// the columns there. Otherwise it is the view's centre.
fn parameters(cut: &Cut, camera: &Camera) -> ViewParameters {
    let view = &cut.view;
    let axes = view.camera_from_view.to_rotation_matrix();
    let axis = |k| -> Vector3<f64> { axes.matrix().column(k).into_owned() };
    let (right, down, ahead) = (axis(0), axis(1), axis(2) * view.focal_px);
    let middle = view.centre_px();
    let has_poles = matches!(camera.model(), CameraModel::Equirectangular { .. });
    let margin = f64::from(view.size_px.max(NEAR_A_POLE_PX));
    let start = [Vector3::z_axis(), -Vector3::z_axis()]
        .iter()
        .find(|pole| has_poles && view.holds(pole, -margin))
        .and_then(|pole| view.project(pole))
        .map_or([middle, middle], |pixel| [pixel.0.x, pixel.0.y])
        .map(f64::round);
    ViewParameters {
        direction: single(ahead + right * (start[0] - middle) + down * (start[1] - middle)),
        size: view.size_px,
        right: single(right),
        words_per_row: 0,
        down: single(down),
        first_word: 0,
        start: start.map(|pixel| pixel as i32),
        first_tile: 0,
        tiles_across: 0,
        nearness: camera.at_distance(cut.distance_m).nearness() as f32,
        interpolation: match cut.interpolation {
            Interpolation::Bilinear => 0,
            Interpolation::Cubic => 1,
        },
        padding: [0; 2],
    }
}

fn single(vector: Vector3<f64>) -> [f32; 3] {
    [vector.x as f32, vector.y as f32, vector.z as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_geometry::view::View;

    const CAMERA: Camera = Camera::equirectangular(3840, 1920);

    fn at(size: u32) -> Cut {
        Cut::bilinear(View::looking_at(&Vector3::x_axis(), 1.0, size))
    }

    fn layout(sizes: &[u32]) -> BatchLayout {
        let mut layout = BatchLayout::default();
        for &size in sizes {
            assert!(layout.add(&at(size), &CAMERA, u64::MAX));
        }
        layout
    }

    #[test]
    fn views_of_any_size_lie_on_whole_words() {
        let layout = layout(&[5, 8, 1]);
        let first: Vec<_> = layout.views.iter().map(|view| view.first_word).collect();
        assert_eq!((first, layout.bytes()), (vec![0, 10, 26], 108));
        let bytes: Vec<u8> = (0..108).collect();
        let mut out = [0; 25];
        layout.copy_out(0, &bytes, &mut out);
        assert_eq!((out[4], out[5], out[24]), (4, 8, 36));
        let mut out = [0; 64];
        layout.copy_out(1, &bytes, &mut out);
        assert_eq!((out[0], out[63]), (40, 103));
    }

    #[test]
    fn small_views_among_large_ones_take_no_more_workgroups_than_alone() {
        let layout = layout(&[936, 40, 33]);
        let first: Vec<_> = layout.views.iter().map(|view| view.first_tile).collect();
        // 936 px are 234 words or 30 workgroups across, and 117 down.
        assert_eq!((first, layout.tiles), (vec![0, 3510, 3520], 3530));
        assert_eq!(layout.workgroups(65_535), [3530, 1]);
        let [across, down] = layout.workgroups(1000);
        assert!(across <= 1000 && across * down >= 3530 && across * down < 3540);
    }

    #[test]
    fn what_does_not_fit_is_left_out() {
        let mut layout = BatchLayout::default();
        assert!(layout.add(&at(8), &CAMERA, 100));
        assert!(!layout.add(&at(8), &CAMERA, 100));
        assert_eq!((layout.views.len(), layout.bytes()), (1, 64));
        // A cut that does not fit alone is refused by the same measure.
        for size in [5, 8, 33] {
            let alone = BatchLayout::bytes_alone(size);
            assert!(BatchLayout::default().add(&at(size), &CAMERA, alone));
            assert!(!BatchLayout::default().add(&at(size), &CAMERA, alone - 1));
        }
    }

    #[test]
    fn directions_are_counted_from_a_pole_that_is_seen() {
        let tilted = nalgebra::Unit::new_normalize(Vector3::new(0.3, 0.1, 1.0));
        let cut = Cut::bilinear(View::looking_at(&tilted, 1.5, 901));
        let [x, y, z] = parameters(&cut, &CAMERA).direction;
        assert!(x.hypot(y) < 0.72 && z > 400.0, "{x} {y} {z}");
        assert_eq!(parameters(&at(100), &CAMERA).start, [50, 50]);
    }
}
