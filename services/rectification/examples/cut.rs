//! Cuts one view from a picture with a configured camera, to look at a calibration:
//!
//! ```text
//! cargo run --release -p flockeye-rectification --example cut -- \
//!     camera.yaml frame.png view.png 0,1,0 60 600
//! ```
//!
//! The direction is in the camera frame (x forward, y left, z up), the field in degrees, the size
//! in pixels. Two pictures, `front.jpg+back.jpg`, are put side by side first. With
//! `--set camera.assumed_distance_m=2` and the like any key can be overridden.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use flockeye_config::Pipeline;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, Interpolation, SphereImage, rectify_into};
use nalgebra::{Unit, Vector3};
use opencv::core::{self, Mat, Vector};
use opencv::imgcodecs;
use opencv::prelude::*;

fn main() -> anyhow::Result<()> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut overrides = Vec::new();
    while let Some(at) = arguments.iter().position(|argument| argument == "--set") {
        ensure!(at + 1 < arguments.len(), "--set needs KEY.PATH=VALUE");
        overrides.push(arguments.remove(at + 1));
        arguments.remove(at);
    }
    let [camera, pictures, out, direction, field_deg, size_px] = arguments.as_slice() else {
        bail!("give CAMERA.yaml PICTURE OUT.png X,Y,Z FIELD_DEG SIZE_PX");
    };
    let pipeline = Pipeline::load(Path::new(camera), &overrides)?;
    let camera = pipeline.camera_model()?;
    let picture = read(pictures)?;
    let pixels = picture.data_bytes()?;
    ensure!(
        (picture.cols(), picture.rows()) == (camera.width() as i32, camera.height() as i32),
        "{pictures} has {}x{} px, the camera {}x{}",
        picture.cols(),
        picture.rows(),
        camera.width(),
        camera.height()
    );
    let sphere = SphereImage::new(pixels, camera.width() as usize, camera)?;
    let numbers: Vec<f64> =
        direction.split(',').map(str::parse).collect::<Result<_, _>>().context("X,Y,Z")?;
    let [x, y, z] = numbers[..] else { bail!("a direction has three numbers: X,Y,Z") };
    let towards = Unit::try_new(Vector3::new(x, y, z), 1e-9).context("no direction")?;
    let field_deg: f64 = field_deg.parse().context("FIELD_DEG")?;
    let size_px: u32 = size_px.parse().context("SIZE_PX")?;
    let view = View::looking_at(&towards, field_deg.to_radians(), size_px);
    let cut = Cut {
        view,
        distance_m: pipeline.camera.assumed_distance_m,
        interpolation: Interpolation::suited_to(&view, &camera),
    };
    let size = size_px as usize;
    let mut greys = vec![0; size * size];
    rectify_into(&sphere, &cut, &mut greys, size)?;
    let image = Mat::new_rows_cols_with_data(size_px as i32, size_px as i32, &greys)?;
    ensure!(imgcodecs::imwrite(out, &image, &Vector::new())?, "cannot write {out}");
    Ok(())
}

/// A grey picture, or several side by side.
fn read(pictures: &str) -> anyhow::Result<Mat> {
    let mut parts = Vector::<Mat>::new();
    for path in pictures.split('+') {
        let part = imgcodecs::imread(path, imgcodecs::IMREAD_GRAYSCALE)?;
        ensure!(!part.empty(), "cannot read {path}");
        parts.push(part);
    }
    let mut whole = Mat::default();
    core::hconcat(&parts, &mut whole)?;
    Ok(whole)
}
