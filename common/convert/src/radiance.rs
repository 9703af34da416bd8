//! Radiance of a view's code values.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use flockeye_contract::{Range, Transfer, ViewHeader};
use flockeye_imaging::light::{LightError, LinearLight};

use crate::codes::{code_range, transfer_curve};
use crate::view::ViewError;

/// Maximum number of cached curves. A source that changes its curve with every frame must not fill
/// the memory.
const MAX_CURVES: usize = 8;

/// Tables from code values to linear radiance, one for each transfer curve in view headers.
#[derive(Debug, Clone)]
pub struct RadianceCache {
    /// The camera's own curve, where it was measured.
    measured: Option<LinearLight>,
    known: BTreeMap<(u32, u32, u32), LinearLight>,
}

impl RadianceCache {
    /// An empty cache. `measured`: the radiance of each code of a camera whose response is a table.
    ///
    /// # Errors
    /// The table does not rise.
    pub fn new(measured: Option<[f32; 256]>) -> Result<Self, LightError> {
        let measured = measured.map(LinearLight::from_table).transpose()?;
        Ok(Self { measured, known: BTreeMap::new() })
    }

    /// The radiance of a view's codes, if [`RadianceCache::of`] has found it before.
    pub fn known(&self, header: &ViewHeader) -> Option<&LinearLight> {
        match Transfer::try_from(header.transfer).ok()? {
            Transfer::Table => self.measured.as_ref(),
            _ => self.known.get(&key(header)),
        }
    }

    /// The radiance of a view's codes.
    ///
    /// # Errors
    /// The curve cannot be inverted, or a table is missing in the configuration.
    pub fn of(&mut self, header: &ViewHeader) -> Result<&LinearLight, ViewError> {
        // The contract's check has refused unknown codes, so the default is never used.
        let transfer = Transfer::try_from(header.transfer).unwrap_or(Transfer::Srgb);
        if transfer == Transfer::Table {
            return self.measured.as_ref().ok_or(ViewError::NoTable);
        }
        let key = key(header);
        if self.known.len() >= MAX_CURVES && !self.known.contains_key(&key) {
            self.known.clear();
        }
        match self.known.entry(key) {
            Entry::Occupied(light) => Ok(light.into_mut()),
            Entry::Vacant(place) => {
                let curve = transfer_curve(transfer, header.gamma).ok_or(ViewError::NoTable)?;
                let range = code_range(Range::try_from(header.range).unwrap_or(Range::Full));
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
    use flockeye_imaging::light::{CodeRange, TransferCurve};

    #[test]
    fn a_measured_curve_is_taken_as_it_is() {
        let header = ViewHeader { transfer: Transfer::Table.code(), ..ViewHeader::default() };
        let table: [f32; 256] = std::array::from_fn(|code| (code as f32 / 255.0).sqrt());
        let mut radiances = RadianceCache::new(Some(table)).unwrap();
        assert_eq!(radiances.of(&header), Ok(&LinearLight::from_table(table).unwrap()));
        let message = RadianceCache::new(None).unwrap().of(&header).unwrap_err().to_string();
        assert!(message.contains("camera.response_table"), "{message}");
    }

    #[test]
    fn a_curve_that_changes_with_every_frame_does_not_fill_the_memory() {
        let mut radiances = RadianceCache::new(None).unwrap();
        for step in 0..100 {
            let gamma = 1.0 + step as f32 / 100.0;
            let transfer = Transfer::Gamma.code();
            let header = ViewHeader { transfer, gamma, ..ViewHeader::default() };
            let curve = TransferCurve::Gamma(gamma);
            assert_eq!(
                radiances.of(&header),
                Ok(&LinearLight::new(curve, CodeRange::Full).unwrap())
            );
            assert!(radiances.known.len() <= MAX_CURVES);
        }
    }
}
