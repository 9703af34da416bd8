//! Pure functions on pixels, without input or output.
//!
//! | module | what it answers |
//! | --- | --- |
//! | [`image`] | which bytes are an image |
//! | [`light`] | which radiance a code value stands for |
//! | [`response`] | which curve leads from radiance to code values, from an exposure series |
//! | [`square`] | where a view shows a point of a printed square |
//! | [`edges`] | where exactly the corners of a marker are |
//! | [`align`] | which pose of a whole body explains a view best, and whether the body is there |
//! | [`gyroscope`] | how the camera has turned between two frames |
//! | [`proposals`] | where a neighbour may be: places that look like markers |
//! | [`sphere`] | how a view is cut from a spherical image |
//!
//! ```
//! use flockeye_geometry::view::ViewPixel;
//! use flockeye_imaging::edges::{CornerFit, Grain, Lighting, MarkerPrint, refine_corners};
//! use flockeye_imaging::image::LumaImage;
//! use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
//!
//! // A black square from 20 to 40 on white: its corners lie between pixels 19 and 20, 39 and 40.
//! let mut pixels = vec![200u8; 60 * 60];
//! for y in 20..40 {
//!     pixels[y * 60 + 20..y * 60 + 40].fill(20);
//! }
//! let image = LumaImage::new(&pixels, 60, 60, 60)?;
//! let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full)?;
//! let guess = [(20.6, 20.4), (38.8, 20.2), (38.9, 39.0), (20.3, 38.7)];
//! let guess = guess.map(|(x, y)| ViewPixel::new(x, y));
//! let print = MarkerPrint::of_bits(&[false; 25]).expect("five by five");
//! let found = refine_corners(&image, &light, &guess, &print, Grain::Pixels, Lighting::Even, CornerFit::WholePrint).expect("a square");
//! assert!((found.corners_in_view[0].0.x - 19.5).abs() < 0.1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

// Files that unit tests share with integration tests use this crate's own name.
#[cfg(test)]
extern crate self as flockeye_imaging;

pub mod align;
pub mod edges;
mod gaussian;
pub mod gyroscope;
pub mod image;
pub mod light;
mod occluded;
pub mod proposals;
pub mod response;
pub mod sphere;
pub mod square;
