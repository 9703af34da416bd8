//! OpenCV's own ArUco detector (`detection.engine: opencv`), as a reference for ours.

use flockeye_dictionary::{Dictionary, DictionaryError};
use flockeye_geometry::mask::Mask;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::image::LumaImage;
use flockeye_runtime::findings::Finding;
use opencv::aruco::{self, DetectorParameters as CvParameters};
use opencv::core::{Mat, Point2f, Ptr, Vector};

use crate::detector::{MarkerInView, found_at, is_hidden};
use crate::parameters::DetectError;

/// Standard deviation of a corner, pixels: docs/results/benchmarks.md has 0.7 to 0.9 without
/// refinement, most of it because OpenCV's corners lie inside the marker.
const CORNER_PX: f64 = 0.9;

/// OpenCV's detector with its default parameters.
pub struct OpenCvDetector {
    dictionary: Dictionary,
    mask: Option<Mask>,
}

/// Whether OpenCV is available and finds markers of this dictionary in a picture without any.
pub(crate) fn examine(dictionary: &str) -> Vec<Finding> {
    let version = opencv::core::get_version_string().unwrap_or_else(|error| error.to_string());
    let searched = OpenCvDetector::new(dictionary).map_err(|error| error.to_string());
    vec![match searched {
        Ok(_) => Finding::fine("opencv", format!("OpenCV {version} with ArUco")),
        Err(error) => Finding::problem(
            "opencv",
            format!("OpenCV {version}, {dictionary}: {error}"),
            "one of OpenCV's dictionaries, or the path of a dictionary file (bodies.dictionary)",
        ),
    }]
}

impl OpenCvDetector {
    /// A detector for the dictionary of this name, or of a file's path.
    ///
    /// # Errors
    /// An unknown dictionary, or a broken file.
    pub fn new(dictionary: &str) -> Result<Self, DetectError> {
        Ok(Self { dictionary: Dictionary::load(dictionary)?, mask: None })
    }

    /// Leaves out markers on what `mask` hides.
    pub fn with_mask(self, mask: Mask) -> Self {
        Self { mask: Some(mask), ..self }
    }

    /// The dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// Finds every marker in `image`, the picture of `view`, by rising id. One id may occur more
    /// than once.
    ///
    /// # Errors
    /// Errors of OpenCV.
    pub fn detect(
        &self,
        image: &LumaImage<'_>,
        view: &View,
    ) -> Result<Vec<MarkerInView>, DetectError> {
        let rows: Vec<&[u8]> = (0..image.height()).map(|row| image.row(row)).collect();
        let copied = rows.concat();
        let (width, height) = (image.width() as i32, image.height() as i32);
        let (corners, ids) = self.markers(height, width, &copied).map_err(DictionaryError::from)?;
        let mut found: Vec<MarkerInView> = ids
            .iter()
            .zip(corners.iter())
            .filter_map(|(id, corners)| {
                let corner = |k: usize| corners.get(k).ok();
                let corners = [corner(0)?, corner(1)?, corner(2)?, corner(3)?]
                    .map(|corner| ViewPixel::new(f64::from(corner.x), f64::from(corner.y)));
                let id = u32::try_from(id).ok()?;
                Some(found_at(view, id, corners, [CORNER_PX; 4]))
            })
            .filter(|found| !is_hidden(self.mask.as_ref(), view, &found.corners_in_view))
            .collect();
        found.sort_by_key(|marker| marker.id);
        Ok(found)
    }

    fn markers(
        &self,
        height: i32,
        width: i32,
        pixels: &[u8],
    ) -> opencv::Result<(Vector<Vector<Point2f>>, Vector<i32>)> {
        let mat = Mat::new_rows_cols_with_data(height, width, pixels)?;
        // A new set each time, because OpenCV writes into the parameters.
        let parameters: Ptr<CvParameters> = CvParameters::create()?;
        let (mut corners, mut ids) = (Vector::new(), Vector::new());
        let mut rejected = Vector::<Vector<Point2f>>::new();
        let dictionary = self.dictionary.opencv();
        aruco::detect_markers(
            &mat,
            dictionary,
            &mut corners,
            &mut ids,
            &parameters,
            &mut rejected,
        )?;
        Ok((corners, ids))
    }
}
