#![allow(missing_docs, clippy::all, clippy::unwrap_used, clippy::expect_used)]
mod shared;
use flockeye_detection::{Detector, DetectorParameters};
use flockeye_geometry::view::View;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Unit, Vector3};
use shared::{Picture, data};
use std::time::Instant;
#[test]
fn fp() {
    let data = data().unwrap();
    flockeye_detection::use_one_thread().unwrap();
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let golden = (1.0 + 5f64.sqrt()) / 2.0;
    let mut files: Vec<String> = [
        "real/theta_s/eqrect_example.png",
        "real/theta_s/eqrect_example_good.png",
        "real/panorama/examplepano.jpg",
        "real/theta_s/capture_example.png",
        "real/opencv_aruco/choriginal.jpg",
        "real/opencv_aruco/gboriginal.png",
    ]
    .map(|f| data.join(f).to_str().unwrap().to_owned())
    .to_vec();
    for k in 0..20 {
        files.push(data.join(format!("stills/images/{k:03}.jpg")).to_str().unwrap().to_owned());
    }
    files.push("/tmp/frames/000.png".into());
    let agreement: f32 = std::env::var("AGREE").map_or(0.8, |m| m.parse().unwrap());
    for file in files {
        let picture = Picture::read(std::path::Path::new(&file));
        for magnified in [1.0, 2.0] {
            let mut views = vec![];
            let focal = magnified * picture.width as f64 / (2.0 * std::f64::consts::PI);
            for a in [-1.0, 1.0] {
                for b in [-golden, golden] {
                    for axis in
                        [Vector3::new(0.0, a, b), Vector3::new(a, b, 0.0), Vector3::new(b, 0.0, a)]
                    {
                        let field = 75f64.to_radians();
                        let size = (2.0 * focal * (field / 2.0).tan()).ceil() as u32;
                        views.push(View::looking_at(&Unit::new_normalize(axis), field, size));
                    }
                }
            }
            let cuts: Vec<Picture> = views.iter().map(|v| picture.cut(v)).collect();
            for dictionary in [
                "DICT_5X5_250",
                "DICT_4X4_50",
                "DICT_4X4_1000",
                "DICT_6X6_250",
                "DICT_APRILTAG_16h5",
            ] {
                let mut detector = Detector::new(
                    dictionary,
                    DetectorParameters { min_agreement: agreement, ..Default::default() },
                )
                .unwrap();
                let mut time = 0.0;
                for (view, cut) in views.iter().zip(&cuts) {
                    let t = Instant::now();
                    let found = detector.detect(&cut.image(), view, &light).unwrap();
                    time += t.elapsed().as_secs_f64();
                    for f in found {
                        if dictionary == "DICT_5X5_250"
                            && (file.contains("stills") || file.contains("frames"))
                            && f.id < 34
                        {
                            continue;
                        }
                        println!(
                            "FP {file} x{magnified} {dictionary} id {} agree {:.3} refined {} side {:.0}",
                            f.id,
                            f.agreement,
                            f.is_refined,
                            flockeye_imaging::square::mean_side_px(&f.corners_in_view)
                        );
                    }
                }
                if dictionary == "DICT_5X5_250" {
                    println!("TIME {file} {} px: {:.1} ms", views[0].size_px, time / 12.0 * 1e3);
                }
            }
        }
    }
}
