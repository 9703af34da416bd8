#![allow(missing_docs, clippy::all, clippy::unwrap_used, clippy::expect_used)]
mod shared;
use flockeye_detection::{Detector, DetectorParameters, Threshold, candidates};
use flockeye_geometry::camera::{Equirectangular, SpherePixel};
use flockeye_geometry::view::View;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Unit, Vector2, Vector3};
use shared::{Picture, data};
use std::collections::BTreeMap;
use std::time::Instant;
#[derive(serde::Deserialize)]
struct Truth {
    frame: u32,
    body: String,
    x: f64,
    y: f64,
    z: f64,
    dist_m: f64,
    n_markers_vis90: u32,
}
#[derive(serde::Deserialize)]
struct Corners {
    frame: u32,
    body: String,
    markers: Vec<Marker>,
}
#[derive(serde::Deserialize)]
struct Marker {
    id: u32,
    vis: f64,
    incidence_deg: f64,
    corners: [[f64; 2]; 4],
}

#[test]
fn probe() {
    let data = data().unwrap();
    flockeye_detection::use_one_thread().unwrap();
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let camera = Equirectangular { width: 3840, height: 1920 };
    let mag: f64 = std::env::var("MAG").map_or(2.0, |m| m.parse().unwrap());
    let mut views: Vec<(String, View, Picture, Vec<(u32, f64, f64, [Vector2<f64>; 4])>, f64)> =
        vec![];
    for (folder, image, every) in [("stills", "stills/images/", 1), ("flight1", "", 30)] {
        let truth: Vec<Truth> = csv::Reader::from_path(data.join(folder).join("truth.csv"))
            .unwrap()
            .deserialize()
            .map(Result::unwrap)
            .collect();
        let corners: Vec<Corners> =
            std::fs::read_to_string(data.join(folder).join("truth_corners.jsonl"))
                .unwrap()
                .lines()
                .map(|l| serde_json::from_str(l).unwrap())
                .collect();
        for body in truth
            .iter()
            .filter(|b| b.dist_m < 3.0 && b.n_markers_vis90 >= 2 && b.frame % every == 0)
        {
            let path = if image.is_empty() {
                std::path::PathBuf::from(format!("/tmp/frames/{:03}.png", body.frame / every))
            } else {
                data.join(image).join(format!("{:03}.jpg", body.frame))
            };
            if !path.exists() {
                continue;
            }
            let picture = Picture::read(&path);
            let direction = Unit::new_normalize(Vector3::new(body.x, body.y, body.z));
            let focal = mag * camera.pixels_per_radian();
            let size = (2.0 * focal * 0.12 / body.dist_m).ceil() as u32 + 20;
            let view =
                View::looking_at(&direction, 2.0 * (f64::from(size) / (2.0 * focal)).atan(), size);
            let cut = picture.cut(&view);
            let mut markers = vec![];
            for line in corners.iter().filter(|l| l.frame == body.frame && l.body == body.body) {
                for m in &line.markers {
                    let p = m.corners.map(|[u, v]| {
                        view.project(&camera.ray(SpherePixel::new(u, v))).map(|p| p.0)
                    });
                    let [Some(a), Some(b), Some(c), Some(d)] = p else { continue };
                    markers.push((m.id, m.vis, m.incidence_deg, [a, b, c, d]));
                }
            }
            views.push((
                format!("{folder} {} {}", body.frame, body.body),
                view,
                cut,
                markers,
                body.dist_m,
            ));
        }
    }
    println!("{} views", views.len());
    if let Ok(n) = std::env::var("DUMP") {
        for (name, _, cut, _, _) in &views {
            if name.starts_with(&n) {
                let mut out = format!("P5 {} {} 255\n", cut.width, cut.height).into_bytes();
                out.extend(&cut.pixels);
                std::fs::write(format!("/tmp/{}.pgm", name.replace(' ', "_")), out).unwrap();
            }
        }
        return;
    }
    let verbose = std::env::var("V").is_ok();
    let th = |w: i32, c: f64| Threshold { window_px: w, darker_by: c };
    if std::env::var("GREEDY").is_ok() {
        let all: Vec<Threshold> = [7, 9, 11, 15, 19, 23, 31, 43]
            .iter()
            .flat_map(|&w| [2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 22.0].map(|c| th(w, c)))
            .collect();
        let mut sets: Vec<std::collections::BTreeSet<(String, u32)>> = vec![];
        for t in &all {
            let mut detector = Detector::new(
                "DICT_5X5_250",
                DetectorParameters { thresholds: vec![*t], ..Default::default() },
            )
            .unwrap();
            let mut set = std::collections::BTreeSet::new();
            for (name, view, cut, markers, _) in &views {
                let image = LumaImage::new(&cut.pixels, cut.width, cut.height, cut.width).unwrap();
                for f in detector.detect(&image, view, &light).unwrap() {
                    if let Some(m) = markers.iter().find(|m| m.0 == f.id) {
                        if (0..4).all(|k| (f.corners_in_view[k].0 - m.3[k]).norm() < 4.0) {
                            set.insert((name.clone(), f.id));
                        }
                    }
                }
            }
            sets.push(set);
        }
        let mut union = std::collections::BTreeSet::new();
        for _ in 0..6 {
            let (i, n) = (0..all.len())
                .map(|i| (i, sets[i].union(&union).count()))
                .max_by_key(|x| x.1)
                .unwrap();
            union = union.union(&sets[i]).cloned().collect();
            println!("{:?} alone {} union {n}", all[i], sets[i].len());
        }
        return;
    }
    for thresholds in [
        vec![th(9, 3.0)],
        vec![th(9, 3.0), th(23, 7.0)],
        vec![th(9, 3.0), th(43, 5.0)],
        vec![th(11, 5.0), th(43, 5.0)],
        vec![th(9, 2.0), th(31, 5.0)],
        vec![th(9, 2.0), th(19, 4.0), th(43, 5.0)],
        vec![th(9, 2.0), th(23, 7.0)],
        vec![th(9, 3.0)],
        vec![th(15, 5.0)],
    ] {
        let windows = &thresholds;
        for constant in [0] {
            for accuracy in [0.05] {
                let parameters = DetectorParameters {
                    thresholds: thresholds.clone(),
                    polygon_accuracy: accuracy,
                    ..Default::default()
                };
                let mut detector = Detector::new("DICT_5X5_250", parameters.clone()).unwrap();
                let mut bins: BTreeMap<u32, [u32; 4]> = BTreeMap::new();
                let mut wrong = 0;
                let mut time = 0.0;
                let mut ctime = 0.0;
                let mut nq = 0;
                let mut un = vec![];
                let mut nun = 0;
                let mut errs = vec![];
                let mut radial = vec![];
                let mut n2 = vec![];
                for (name, view, cut, markers, _d) in &views {
                    let image =
                        LumaImage::new(&cut.pixels, cut.width, cut.height, cut.width).unwrap();
                    let t = Instant::now();
                    let found = detector.detect(&image, view, &light).unwrap();
                    time += t.elapsed().as_secs_f64();
                    let t = Instant::now();
                    let quads =
                        candidates::find(&image, detector.dictionary(), &parameters).unwrap();
                    ctime += t.elapsed().as_secs_f64();
                    nq += quads.len();
                    for f in &found {
                        let Some(m) = markers.iter().find(|m| m.0 == f.id && m.1 > 0.05) else {
                            if verbose {
                                println!(
                                    "WRONG {name} {} {:.2} {}",
                                    f.id, f.agreement, f.is_refined
                                );
                            }
                            wrong += 1;
                            continue;
                        };
                        let mid = m.3.iter().sum::<Vector2<f64>>() / 4.0;
                        for k in 0..4 {
                            let e = f.corners_in_view[k].0 - m.3[k];
                            if !f.is_refined {
                                un.push(e.norm());
                                if k == 0 {
                                    nun += 1;
                                }
                                if verbose {
                                    println!(
                                        "UNREF {name} {} {:.2} {:.2}",
                                        f.id,
                                        e.norm(),
                                        f.agreement
                                    );
                                }
                                continue;
                            }
                            errs.push(e.norm());
                            radial.push(e.dot(&(m.3[k] - mid).normalize()));
                            let s = f.deviations_rad[k] * view.focal_px;
                            n2.push(e.norm_squared() / 2.0 / s / s);
                            if e.norm() > 4.0 {
                                if verbose {
                                    println!(
                                        "FAR {name} {} {:?} {:.2} {}",
                                        f.id, e, f.agreement, f.is_refined
                                    );
                                }
                                wrong += 1;
                            }
                        }
                    }
                    for m in markers.iter().filter(|m| m.1 >= 0.9 && m.2 < 88.0) {
                        let area = ((m.3[2] - m.3[0]).perp(&(m.3[3] - m.3[1])) / 2.0).abs().sqrt();
                        let bin = bins.entry((area / 10.0) as u32 * 10).or_default();
                        bin[0] += 1;
                        let hit = found.iter().any(|f| f.id == m.0);
                        bin[1] += u32::from(hit);
                        let near = quads.iter().any(|q| {
                            (0..4).any(|s| {
                                (0..4)
                                    .map(|k| (q[(k + s) % 4].0 - m.3[k]).norm())
                                    .fold(0.0, f64::max)
                                    < 3.0 + 0.08 * area
                            })
                        });
                        bin[2] += u32::from(near);
                        if verbose && !hit {
                            println!(
                                "LOST {name} id {} side {area:.1} inc {:.0} near {near}",
                                m.0, m.2
                            );
                        }
                    }
                }
                let s: Vec<String> =
                    bins.iter().map(|(k, b)| format!("{k}:{}/{}/{}", b[1], b[2], b[0])).collect();
                for v in [&mut errs, &mut n2] {
                    v.sort_by(f64::total_cmp);
                }
                un.sort_by(f64::total_cmp);
                println!(
                    "cand {:.1} ms {} quads; unrefined {nun}: med {:?} 90% {:?}",
                    ctime / views.len() as f64 * 1e3,
                    nq / views.len(),
                    un.get(un.len() / 2),
                    un.get(un.len() * 9 / 10)
                );
                println!(
                    "{windows:?} c{constant} a{accuracy} wrong {wrong} {:.1} ms/view err {:.3} {:.3} rad {:+.3} n {:.2}  {}",
                    time / views.len() as f64 * 1e3,
                    errs[errs.len() / 2],
                    errs[errs.len() * 9 / 10],
                    radial.iter().sum::<f64>() / radial.len() as f64,
                    n2[n2.len() / 2].sqrt(),
                    s.join(" ")
                );
                if verbose && thresholds.len() == 2 {
                    return;
                }
            }
        }
    }
}
