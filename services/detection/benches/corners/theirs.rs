//! OpenCV's ArUco with each of its refinements.

use flockeye_geometry::view::ViewPixel;
use opencv::aruco::{
    self, CORNER_REFINE_APRILTAG, CORNER_REFINE_CONTOUR, CORNER_REFINE_NONE, CORNER_REFINE_SUBPIX,
    Dictionary as CvDictionary, PREDEFINED_DICTIONARY_NAME,
};
use opencv::core::{Mat, Point2f, Ptr, Vector};
use opencv::prelude::*;

use crate::Picture;

/// One of OpenCV's refinements.
pub(crate) struct Theirs {
    pub name: &'static str,
    method: i32,
    /// Offset of this method's corners from the convention of the others, pixels along either axis.
    offset: f64,
    dictionary: Ptr<CvDictionary>,
}

impl Theirs {
    /// All four. The corners of `APRILTAG` are offset by (+0.45, +0.45) px from the convention of
    /// the others, which is subtracted here.
    pub(crate) fn all() -> Vec<Self> {
        opencv::core::set_num_threads(1).unwrap();
        let methods = [
            ("OpenCV, NONE", CORNER_REFINE_NONE, 0.0),
            ("OpenCV, SUBPIX", CORNER_REFINE_SUBPIX, 0.0),
            ("OpenCV, CONTOUR", CORNER_REFINE_CONTOUR, 0.0),
            ("OpenCV, APRILTAG", CORNER_REFINE_APRILTAG, 0.45),
        ];
        let dictionary = PREDEFINED_DICTIONARY_NAME::DICT_5X5_250;
        methods
            .map(|(name, method, offset)| Self {
                name,
                method,
                offset,
                dictionary: aruco::get_predefined_dictionary(dictionary).unwrap(),
            })
            .into()
    }

    /// The marker's corners, with OpenCV's default parameters except for the refinement.
    pub(crate) fn corners(&self, picture: &Picture) -> Option<[ViewPixel; 4]> {
        let size = picture.scene.size as i32;
        let mat = Mat::new_rows_cols_with_data(size, size, &picture.pixels).unwrap();
        // A new set each time, because OpenCV writes into the parameters.
        let mut parameters = aruco::DetectorParameters::create().unwrap();
        parameters.set_corner_refinement_method(self.method);
        let (mut corners, mut ids) = (Vector::<Vector<Point2f>>::new(), Vector::<i32>::new());
        let mut rejected = Vector::<Vector<Point2f>>::new();
        aruco::detect_markers(
            &mat,
            &self.dictionary,
            &mut corners,
            &mut ids,
            &parameters,
            &mut rejected,
        )
        .unwrap();
        let index = ids.iter().position(|id| id as u32 == picture.id)?;
        let corners = corners.get(index).unwrap();
        Some(std::array::from_fn(|k| {
            let corner = corners.get(k).unwrap();
            let at = |x: f32| f64::from(x) - self.offset;
            ViewPixel::new(at(corner.x), at(corner.y))
        }))
    }
}
