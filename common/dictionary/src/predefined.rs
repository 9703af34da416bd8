//! OpenCV's own dictionaries.

use opencv::aruco::{self, Dictionary as CvDictionary};
use opencv::core::Ptr;

use crate::names::{MIP_36H12, PREDEFINED};
use crate::{DictionaryError, mip_36h12, read};

/// The dictionary of this name, and the name as in [`PREDEFINED`].
pub(crate) fn predefined(
    name: &str,
) -> Result<Option<(&'static str, Ptr<CvDictionary>)>, DictionaryError> {
    let Some(index) = PREDEFINED.iter().position(|known| known.eq_ignore_ascii_case(name)) else {
        return Ok(None);
    };
    let dictionary = match PREDEFINED[index] {
        MIP_36H12 => read::of_bits(mip_36h12::markers(), mip_36h12::SIZE, mip_36h12::CORRECTABLE)?,
        // The enumeration counts from 0 without gaps.
        _ => aruco::get_predefined_dictionary_i32(index as i32)?,
    };
    Ok(Some((PREDEFINED[index], dictionary)))
}
