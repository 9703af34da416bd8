#![allow(missing_docs, clippy::all, clippy::unwrap_used, clippy::expect_used)]
mod shared;
use flockeye_detection::{Detector, DetectorParameters, candidates};
use flockeye_geometry::view::View;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Unit, Vector3};
use shared::Picture;
use std::time::Instant;
#[test]
fn timing() {
    flockeye_detection::use_one_thread().unwrap();
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let golden = (1.0 + 5f64.sqrt()) / 2.0;
  for file in ["/tmp/frames/000.png", "/work/shared/data/stills/images/000.jpg"] {
    let picture = Picture::read(std::path::Path::new(file));
    let mut views = vec![];
    for a in [-1.0, 1.0] { for b in [-golden, golden] { for axis in [Vector3::new(0.0, a, b), Vector3::new(a, b, 0.0), Vector3::new(b, 0.0, a)] {
        views.push(View::looking_at(&Unit::new_normalize(axis), 75f64.to_radians(), 936));
    } } }
    let mut gaze = vec![];
    for v in &views { gaze.push(View::looking_at(&v.direction_in_camera(), 2.0*(200.0f64/1222.0).atan(), 400)); }
    for at in [Vector3::new(-0.267847,-0.767822,-0.128454), Vector3::new(1.012016,2.096638,0.214633)] { gaze.push(View::looking_at(&Unit::new_normalize(at), 2.0*(200.0f64/1222.0).atan(), 400)); }
    for set in [views, gaze] {
        let cuts: Vec<Picture> = set.iter().map(|v| picture.cut(v)).collect();
        let parameters = DetectorParameters::default();
        let mut detector = Detector::new("DICT_5X5_250", parameters.clone()).unwrap();
            let (mut best_all, mut best_find, mut quads, mut text) = (0.0, 0.0, 0, String::new());
            for (view, cut) in set.iter().zip(&cuts) {
                let mut all = f64::MAX; let mut find = f64::MAX;  let mut n = 0;
                for _ in 0..6 {
                    let t = Instant::now(); n = detector.detect(&cut.image(), view, &light).unwrap().len(); all = all.min(t.elapsed().as_secs_f64());
                    let t = Instant::now(); quads += candidates::find(&cut.image(), detector.dictionary(), &parameters).unwrap().len(); find = find.min(t.elapsed().as_secs_f64());
                }
                if n > 0 { text += &format!(" [{n} markers: {:.1} ms]", all*1e3); }
                best_all += all; best_find += find;
            }
            let n = set.len() as f64;
            println!("{file} {} px: {:.1} ms, find {:.1} ms, {} quads{text}", set[0].size_px, best_all/n*1e3, best_find/n*1e3, quads/6/set.len());
    }
  }
}
