//! A view's message as what it shows: its geometry, its pixels and the light they stand for.
//!
//! Whoever looks into views (detection, fusion) reads their headers here, so that both see the same.

use std::collections::BTreeMap;

use flockeye_contract::{Range, Transfer, ViewHeader};
use flockeye_geometry::view::View;
use flockeye_imaging::image::{ImageError, LumaImage};
use flockeye_imaging::light::{CodeRange, LightError, LinearLight, TransferCurve};
use nalgebra::{Quaternion, UnitQuaternion};

/// Curves that are remembered: a source that changes its curve with every frame must not fill the
/// memory.
const MAX_CURVES: usize = 8;

/// Why a view cannot be looked into.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ViewingError {
    /// Its pixels are not as many as its header says.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// Its curve cannot be undone.
    #[error(transparent)]
    Light(#[from] LightError),
    /// Its curve is a table that was not configured.
    #[error(
        "its curve is a table, but the configuration has none. Cure: set camera.response to table, \
         and camera.response_table"
    )]
    NoTable,
}

/// The geometry that a header states. The rotation is normalised; whether it was one is for the
/// contract's check to say.
pub fn view_of(header: &ViewHeader) -> View {
    let [x, y, z, w] = header.camera_from_view;
    View {
        camera_from_view: UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
        focal_px: header.focal_px,
        size_px: header.size_px,
    }
}

/// The pixels that a header states, in a message's items.
///
/// # Errors
/// Too few of them.
pub fn image_of<'p>(header: &ViewHeader, pixels: &'p [u8]) -> Result<LumaImage<'p>, ViewingError> {
    let size = header.size_px as usize;
    Ok(LumaImage::new(pixels, size, size, header.stride as usize)?)
}

/// The light of codes, by what headers say of their curve.
#[derive(Debug, Clone)]
pub struct Lights {
    /// The camera's own curve, where it was measured.
    measured: Option<LinearLight>,
    known: BTreeMap<(u32, u32, u32), LinearLight>,
}

impl Lights {
    /// `measured`: the light of each code of a camera whose response is a table.
    ///
    /// # Errors
    /// A table that falls.
    pub fn new(measured: Option<[f32; 256]>) -> Result<Self, LightError> {
        let measured = measured.map(LinearLight::from_table).transpose()?;
        Ok(Self { measured, known: BTreeMap::new() })
    }

    /// The light of a view's codes, if [`Lights::of`] has found it before.
    pub fn known(&self, header: &ViewHeader) -> Option<&LinearLight> {
        match Transfer::try_from(header.transfer).ok()? {
            Transfer::Table => self.measured.as_ref(),
            _ => self.known.get(&key(header)),
        }
    }

    /// The light of a view's codes.
    ///
    /// # Errors
    /// A curve that cannot be undone, or a table where none was configured.
    pub fn of(&mut self, header: &ViewHeader) -> Result<&LinearLight, ViewingError> {
        // Unknown codes were refused with the message; the defaults here are never taken.
        let transfer = Transfer::try_from(header.transfer).unwrap_or(Transfer::Srgb);
        if transfer == Transfer::Table {
            return self.measured.as_ref().ok_or(ViewingError::NoTable);
        }
        let key = key(header);
        if self.known.len() >= MAX_CURVES && !self.known.contains_key(&key) {
            self.known.clear();
        }
        match self.known.entry(key) {
            std::collections::btree_map::Entry::Occupied(light) => Ok(light.into_mut()),
            std::collections::btree_map::Entry::Vacant(place) => {
                let curve = match transfer {
                    Transfer::Gamma => TransferCurve::Gamma(header.gamma),
                    Transfer::Linear => TransferCurve::Linear,
                    Transfer::Srgb | Transfer::Table => TransferCurve::Srgb,
                };
                let range = match Range::try_from(header.range).unwrap_or(Range::Full) {
                    Range::Full => CodeRange::Full,
                    Range::Limited => CodeRange::Limited,
                };
                Ok(place.insert(LinearLight::new(curve, range)?))
            }
        }
    }
}

fn key(header: &ViewHeader) -> (u32, u32, u32) {
    (header.transfer, header.gamma.to_bits(), header.range)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_measured_curve_is_taken_as_it_is() {
        let header = ViewHeader { transfer: Transfer::Table.code(), ..ViewHeader::default() };
        let table: [f32; 256] = std::array::from_fn(|code| (code as f32 / 255.0).sqrt());
        let mut lights = Lights::new(Some(table)).unwrap();
        assert_eq!(lights.of(&header), Ok(&LinearLight::from_table(table).unwrap()));
        let message = Lights::new(None).unwrap().of(&header).unwrap_err().to_string();
        assert!(message.contains("camera.response_table"), "{message}");
    }

    #[test]
    fn a_curve_that_changes_with_every_frame_does_not_fill_the_memory() {
        let mut lights = Lights::new(None).unwrap();
        for step in 0..100 {
            let gamma = 1.0 + step as f32 / 100.0;
            let transfer = Transfer::Gamma.code();
            let header = ViewHeader { transfer, gamma, ..ViewHeader::default() };
            let curve = TransferCurve::Gamma(gamma);
            assert_eq!(lights.of(&header), Ok(&LinearLight::new(curve, CodeRange::Full).unwrap()));
            assert!(lights.known.len() <= MAX_CURVES);
        }
    }

    #[test]
    fn a_view_shorter_than_it_says_is_refused() {
        let header = ViewHeader { size_px: 10, stride: 10, ..ViewHeader::default() };
        assert!(image_of(&header, &[0; 99]).is_err());
        assert_eq!(image_of(&header, &[0; 100]).unwrap().height(), 10);
    }
}
