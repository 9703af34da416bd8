//! A frame as an equirectangular JPEG, small enough for a browser.

use flockeye_contract::FrameHeader;
use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Camera, CameraModel, Equirectangular, SpherePixel};
use opencv::core::{
    BORDER_CONSTANT, CV_16SC2, CV_32FC2, Mat, Point2f, Rect, Scalar, Size, ToInputArray, Vector,
};
use opencv::prelude::*;
use opencv::{core, imgcodecs, imgproc};

/// Maximum width of a picture, pixels.
const MAX_WIDTH: u32 = 1920;
/// JPEG quality of whole pictures, of 100.
const QUALITY: i32 = 78;
/// JPEG quality of close-ups, which are small.
const CLOSEUP_QUALITY: i32 = 92;

/// The reason why a frame cannot be shown.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PictureError {
    #[error("the frame is {width}x{height}, the camera {}x{}", .camera.0, .camera.1)]
    Size {
        width: u32,
        height: u32,
        /// Width and height of the configured camera's frames.
        camera: (u32, u32),
    },
    #[error("the frame has {found} bytes, its header says {needed}")]
    TooShort { needed: usize, found: usize },
    #[error("the recorded picture cannot be shown: {0}")]
    Recorded(&'static str),
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// Makes pictures of one camera's frames.
pub(crate) struct PictureMaker {
    camera: Camera,
    size: Size,
    /// Position in the frame of each pixel of the picture; none where the frame is equirectangular.
    maps: Option<[Mat; 2]>,
    scaled: Mat,
    jpeg: Vector<u8>,
}

impl PictureMaker {
    /// A maker for frames of this camera.
    pub(crate) fn new(camera: &Camera) -> opencv::Result<Self> {
        // More threads of OpenCV would compete with the pipeline for processors.
        core::set_num_threads(1)?;
        let (width, height) = (camera.width(), camera.height());
        let is_plain = matches!(camera.model(), CameraModel::Equirectangular { .. });
        let size = match is_plain {
            true => {
                let shown = width.min(MAX_WIDTH);
                let rows = u64::from(height) * u64::from(shown) / u64::from(width);
                Size::new(shown as i32, (rows as i32).max(1))
            }
            false => {
                let around = camera.pixels_per_radian() * std::f64::consts::TAU;
                let rows = (around.min(f64::from(MAX_WIDTH)) as i32 / 2).max(1);
                Size::new(2 * rows, rows)
            }
        };
        let maps = if is_plain { None } else { Some(maps(camera, size)?) };
        Ok(Self { camera: *camera, size, maps, scaled: Mat::default(), jpeg: Vector::new() })
    }

    /// Width and height of its pictures, pixels.
    pub(crate) fn size(&self) -> [u32; 2] {
        [self.size.width, self.size.height].map(|side| side.unsigned_abs())
    }

    /// The picture of a frame whose header has passed the contract's check.
    pub(crate) fn jpeg(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
    ) -> Result<&[u8], PictureError> {
        let camera = (self.camera.width(), self.camera.height());
        let (width, height) = (header.width, header.height);
        if camera != (width, height) {
            return Err(PictureError::Size { width, height, camera });
        }
        let needed = header.stride as usize * height as usize;
        let luma =
            pixels.get(..needed).ok_or(PictureError::TooShort { needed, found: pixels.len() })?;
        // The contract's check has bounded all sides, so they fit.
        let (rows, columns) = (height as i32, width as i32);
        let padded = Mat::new_rows_cols_with_data(rows, header.stride as i32, luma)?;
        let frame = padded.roi(Rect::new(0, 0, columns, rows))?;
        self.encoded(&frame)
    }

    /// The picture of a decoded frame of any size, from a recording.
    pub(crate) fn jpeg_of_decoded(&mut self, decoded: &Mat) -> Result<&[u8], PictureError> {
        let camera = Size::new(self.camera.width() as i32, self.camera.height() as i32);
        if self.maps.is_none() || decoded.size()? == camera {
            return self.encoded(decoded);
        }
        let mut whole = Mat::default();
        imgproc::resize(decoded, &mut whole, camera, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        self.encoded(&whole)
    }

    /// Whether a picture of this size can be shown without conversion.
    pub(crate) fn is_shown_as_is(&self, [width, height]: [u32; 2]) -> bool {
        self.maps.is_none() && width <= MAX_WIDTH && width == 2 * height
    }

    fn encoded(&mut self, frame: &impl ToInputArray) -> Result<&[u8], PictureError> {
        let size = frame.input_array()?.size(-1)?;
        match &self.maps {
            Some([whole, part]) => imgproc::remap(
                frame,
                &mut self.scaled,
                whole,
                part,
                imgproc::INTER_LINEAR,
                BORDER_CONSTANT,
                Scalar::default(),
            )?,
            None if size == self.size => {
                encode(frame, QUALITY, &mut self.jpeg)?;
                return Ok(self.jpeg.as_slice());
            }
            None => {
                imgproc::resize(frame, &mut self.scaled, self.size, 0.0, 0.0, imgproc::INTER_AREA)?;
            }
        }
        encode(&self.scaled, QUALITY, &mut self.jpeg)?;
        Ok(self.jpeg.as_slice())
    }
}

fn encode(pixels: &impl ToInputArray, quality: i32, jpeg: &mut Vector<u8>) -> opencv::Result<()> {
    let parameters = Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, quality]);
    imgcodecs::imencode(".jpg", pixels, jpeg, &parameters)?;
    Ok(())
}

/// Positions in the frames of `camera` of the pixels of an equirectangular picture, in the format
/// that OpenCV remaps fastest.
fn maps(camera: &Camera, size: Size) -> opencv::Result<[Mat; 2]> {
    let picture =
        Equirectangular { width: size.width.unsigned_abs(), height: size.height.unsigned_abs() };
    let outside = Point2f::new(-1e4, -1e4);
    let place = |ray: &Ray| match camera.project(ray) {
        Some(SpherePixel(at)) => Point2f::new(at.x as f32, at.y as f32),
        None => outside,
    };
    let mut places = Mat::new_size_with_default(size, CV_32FC2, Scalar::default())?;
    for row in 0..size.height {
        for (column, at) in places.at_row_mut::<Point2f>(row)?.iter_mut().enumerate() {
            *at = place(&picture.ray(SpherePixel::new(column as f64, f64::from(row))));
        }
    }
    let (mut whole, mut part) = (Mat::default(), Mat::default());
    let none = core::no_array();
    imgproc::convert_maps(&places, &none, &mut whole, &mut part, CV_16SC2, false)?;
    Ok([whole, part])
}

/// Encodes gray pixels, `width` in a row, as a JPEG of high quality.
pub(crate) fn gray_jpeg(pixels: &[u8], width: usize, height: usize) -> opencv::Result<Vec<u8>> {
    let mat = Mat::new_rows_cols_with_data(height as i32, width as i32, pixels)?;
    let mut jpeg = Vector::new();
    encode(&mat, CLOSEUP_QUALITY, &mut jpeg)?;
    Ok(jpeg.to_vec())
}

/// Width and height of a JPEG from its frame header, without decoding it (ITU-T T.81, B.2.2).
pub(crate) fn jpeg_size(jpeg: &[u8]) -> Option<[u32; 2]> {
    let mut rest = jpeg.strip_prefix(&[0xff, 0xd8])?;
    loop {
        let [0xff, marker, high, low, ..] = *rest else { return None };
        let length = usize::from(u16::from_be_bytes([high, low]));
        // All frame headers; 0xc4, 0xc8 and 0xcc are other segments.
        if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
            let side = |at: usize| {
                Some(u32::from(u16::from_be_bytes([*rest.get(at)?, *rest.get(at + 1)?])))
            };
            return Some([side(7)?, side(5)?]);
        }
        rest = rest.get(2 + length.max(2)..)?;
    }
}

/// Decodes the luma of a JPEG that is at most `most` wide and high.
///
/// # Errors
/// The bytes are not a JPEG, or it is larger.
pub(crate) fn decode(jpeg: &[u8], most: [u32; 2]) -> Result<Mat, PictureError> {
    let size = jpeg_size(jpeg).ok_or(PictureError::Recorded("it is no JPEG"))?;
    // A file of a few bytes can claim a size of gigabytes.
    if size[0] > most[0] || size[1] > most[1] || size.contains(&0) {
        return Err(PictureError::Recorded("it is larger than the camera's frames"));
    }
    let bytes = Vector::<u8>::from_slice(jpeg);
    let decoded = imgcodecs::imdecode(&bytes, imgcodecs::IMREAD_GRAYSCALE)?;
    if decoded.empty() {
        return Err(PictureError::Recorded("it is damaged"));
    }
    Ok(decoded)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn decoded(jpeg: &[u8]) -> Mat {
        let bytes = Vector::<u8>::from_slice(jpeg);
        imgcodecs::imdecode(&bytes, imgcodecs::IMREAD_GRAYSCALE).unwrap()
    }

    fn header(camera: &Camera, stride: u32) -> FrameHeader {
        FrameHeader {
            width: camera.width(),
            height: camera.height(),
            stride,
            ..FrameHeader::default()
        }
    }

    /// A frame whose left half is dark, with bytes between the rows that must not show.
    fn half_dark(width: usize, height: usize, stride: usize) -> Vec<u8> {
        let row = |x: usize| {
            if x < width / 2 {
                40
            } else if x < width {
                200
            } else {
                255
            }
        };
        (0..height).flat_map(|_| (0..stride).map(row)).collect()
    }

    #[test]
    fn a_picture_is_the_frame_made_smaller() {
        let camera = Camera::equirectangular(3840, 1920);
        let mut maker = PictureMaker::new(&camera).unwrap();
        assert_eq!(maker.size(), [1920, 960]);
        let pixels = half_dark(3840, 1920, 3904);
        let picture = decoded(maker.jpeg(&header(&camera, 3904), &pixels).unwrap());
        for (column, expected) in [(10, 40), (900, 40), (1000, 200), (1910, 200)] {
            let grey = i32::from(*picture.at_2d::<u8>(500, column).unwrap());
            assert!((grey - expected).abs() < 4, "{grey} at {column}");
        }
        let short = maker.jpeg(&header(&camera, 3904), &pixels[1..]).unwrap_err();
        assert!(matches!(short, PictureError::TooShort { .. }));
        let other = Camera::equirectangular(64, 32);
        let wrong = maker.jpeg(&header(&other, 64), &pixels).unwrap_err().to_string();
        assert_eq!(wrong, "the frame is 64x32, the camera 3840x1920");
    }

    #[test]
    fn a_picture_of_another_camera_is_equirectangular_too() {
        let model = CameraModel::Stereographic { field_rad: 300f64.to_radians() };
        let camera = Camera::new(512, 512, model).unwrap();
        // A bright spot where the camera sees what is left of it.
        let left = Ray::new_normalize(nalgebra::Vector3::y());
        let SpherePixel(spot) = camera.project(&left).unwrap();
        let mut pixels = vec![60u8; 512 * 512];
        for y in -6..=6 {
            for x in -6..=6 {
                let (x, y) = (spot.x as i32 + x, spot.y as i32 + y);
                pixels[(y * 512 + x) as usize] = 250;
            }
        }
        let mut maker = PictureMaker::new(&camera).unwrap();
        let picture = decoded(maker.jpeg(&header(&camera, 512), &pixels).unwrap());
        let [width, height] = maker.size();
        let shown = Equirectangular { width, height };
        let SpherePixel(at) = shown.project(&left);
        assert!(*picture.at_2d::<u8>(at.y as i32, at.x as i32).unwrap() > 200);
        assert!(*picture.at_2d::<u8>(at.y as i32, at.x as i32 + 60).unwrap() < 100);
        // What lies straight behind is outside the circle: black.
        assert!(*picture.at_2d::<u8>((height / 2) as i32, 0).unwrap() < 20);
    }

    #[test]
    fn a_recorded_picture_says_its_size_and_lies_are_refused() {
        let pixels = vec![90; 64 * 32];
        let jpeg = gray_jpeg(&pixels, 64, 32).unwrap();
        assert_eq!(jpeg_size(&jpeg), Some([64, 32]));
        assert_eq!(super::decode(&jpeg, [64, 32]).unwrap().size().unwrap(), Size::new(64, 32));
        let refused = |jpeg: &[u8], most| super::decode(jpeg, most).unwrap_err().to_string();
        assert!(refused(&jpeg, [63, 32]).contains("larger than the camera's"));
        for end in 0..jpeg.len() / 4 {
            assert!(refused(&jpeg[..end], [64, 32]).contains("cannot be shown"), "{end} bytes");
        }
        // Made smaller or larger, it is as large as all pictures.
        let mut maker = PictureMaker::new(&Camera::equirectangular(3840, 1920)).unwrap();
        let small = super::decode(&jpeg, [3840, 1920]).unwrap();
        assert_eq!(jpeg_size(maker.jpeg_of_decoded(&small).unwrap()), Some([1920, 960]));
        assert!(maker.is_shown_as_is([64, 32]) && !maker.is_shown_as_is([3840, 1920]));
    }
}
