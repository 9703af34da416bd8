//! Printed sheets hold every marker, upright, at its true size: drawn by somebody else's renderer
//! and read by the detector.

use std::path::Path;

use flockeye_contract::{Search, ViewKind};
use flockeye_detection::windows::thresholds;
use flockeye_detection::{DarkerBy, Detector, DetectorParameters, MarkerInView, Threshold};
use flockeye_geometry::view::View;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_rectification::PROPOSAL_WINDOWS;
use flockeye_tests::{Scratch, run, succeeds};
use gstreamer as gst;
use gstreamer::prelude::*;
use nalgebra::Vector3;

/// Draws an SVG with librsvg; its pixels, row by row, and their number in a row.
fn drawn(svg: &Path, png: &Path) -> (Vec<u8>, usize) {
    gst::init().expect("GStreamer is installed");
    let line = format!(
        "filesrc location={} ! rsvgdec ! videoconvert ! video/x-raw,format=GRAY8 ! pngenc ! \
         filesink location={}",
        svg.display(),
        png.display()
    );
    let pipeline = gst::parse::launch(&line).expect("GStreamer has rsvgdec");
    pipeline.set_state(gst::State::Playing).expect("it starts");
    let bus = pipeline.bus().expect("a pipeline has one");
    let wanted = [gst::MessageType::Eos, gst::MessageType::Error];
    let message = bus.timed_pop_filtered(gst::ClockTime::from_seconds(60), &wanted);
    pipeline.set_state(gst::State::Null).expect("it stops");
    let message = message.expect("it ends");
    assert!(matches!(message.view(), gst::MessageView::Eos(_)), "{message:?}");
    let file = std::fs::File::open(png).expect("it was written");
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("its size is known")];
    let info = reader.next_frame(&mut pixels).expect("its pixels");
    assert_eq!(info.color_type, png::ColorType::Grayscale);
    (pixels, info.width as usize)
}

/// The drawing as a lens would show it, blurred by a pixel. A renderer's codes at edges are shares
/// of white: light, not sRGB.
fn blurred(pixels: &[u8], width: usize) -> Vec<u8> {
    let along = |light: &[f64], step: usize| -> Vec<f64> {
        let at = |k: usize, by: isize| {
            let other = k as isize + by * step as isize;
            light[usize::try_from(other).unwrap_or(k).min(light.len() - 1)]
        };
        let sum = |k: usize| {
            let (near, far) = (at(k, -1) + at(k, 1), at(k, -2) + at(k, 2));
            (6.0 * light[k] + 4.0 * near + far) / 16.0
        };
        (0..light.len()).map(sum).collect()
    };
    let light: Vec<f64> = pixels.iter().map(|&code| f64::from(code)).collect();
    along(&along(&light, 1), width).into_iter().map(|light| light.round() as u8).collect()
}

/// Every marker on a sheet.
fn read(pixels: &[u8], width: usize, dictionary: &str) -> Vec<MarkerInView> {
    let pixels = &blurred(pixels, width);
    let image = LumaImage::new(pixels, width, pixels.len() / width, width).expect("rows");
    let view = View::looking_at(&Vector3::x_axis(), 1.0, width as u32);
    let light = LinearLight::new(TransferCurve::Linear, CodeRange::Full).expect("a curve");
    // Cells on a sheet are larger than in flight, and so are the windows.
    let thresholds = [(11, 4), (61, 10)]
        .map(|(window_px, codes)| Threshold { window_px, darker_by: DarkerBy::Codes(codes) })
        .into();
    let parameters = DetectorParameters { thresholds, ..DetectorParameters::default() };
    let mut detector = Detector::new(dictionary, parameters).expect("known");
    detector.detect(&image, &view, &light)
}

/// Prints a body and reads it again: ids and sides in millimetres, by rising id.
fn printed(preset: &str, dictionary: &str, paper: &str, width_mm: f64) -> (usize, Vec<(u32, f64)>) {
    let scratch = Scratch::new("sheets");
    let out = scratch.path("body.svg");
    let preset = format!("bodies.list=[{preset}]");
    let dictionary_set = format!("bodies.dictionary={dictionary}");
    let output = succeeds(&[
        "markers",
        "--body",
        "alpha",
        "--paper",
        paper,
        "--out",
        out.to_str().expect("a text"),
        "--set",
        &preset,
        "--set",
        &dictionary_set,
    ]);
    let sheets: Vec<&str> = output.lines().filter(|line| line.ends_with(".svg")).collect();
    let mut found = Vec::new();
    for sheet in &sheets {
        let (pixels, width) = drawn(Path::new(sheet), &scratch.path("sheet.png"));
        for marker in read(&pixels, width, dictionary) {
            let [top_left, top_right, bottom_right, bottom_left] =
                marker.corners_in_view.map(|corner| corner.0);
            let mm = width_mm / width as f64;
            // Upright: its top is above, and its right is right.
            assert!((bottom_left.x - top_left.x).abs() * mm < 0.1 && bottom_left.y > top_left.y);
            assert!((top_right.y - top_left.y).abs() * mm < 0.1 && top_right.x > top_left.x);
            let sides = [
                top_right - top_left,
                bottom_right - top_right,
                bottom_left - bottom_right,
                top_left - bottom_left,
            ];
            let side = sides.iter().map(|side| side.norm()).sum::<f64>() / 4.0 * mm;
            found.push((marker.id, side));
        }
    }
    found.sort_by_key(|(id, _)| *id);
    (sheets.len(), found)
}

fn assert_sizes(found: &[(u32, f64)], wanted: &[(u32, f64)]) {
    let ids = |list: &[(u32, f64)]| list.iter().map(|(id, _)| *id).collect::<Vec<_>>();
    assert_eq!(ids(found), ids(wanted));
    for ((id, side), (_, wanted)) in found.iter().zip(wanted) {
        println!("marker {id}: {side:.3} mm");
        assert!((side - wanted).abs() < 0.02, "marker {id}: {side} mm instead of {wanted}");
    }
}

/// Lossless runs charge a proposal by the windows that it is searched with, in another stage.
#[test]
fn a_proposal_is_charged_by_all_of_its_windows() {
    let windows = thresholds(ViewKind::Proposal, Search::AllWindows, 1.0).count();
    assert_eq!(windows as f64, PROPOSAL_WINDOWS);
}

#[test]
fn every_marker_of_a_printed_body_is_read_at_its_true_size() {
    let (sheets, found) = printed("{name: alpha, first_id: 20}", "DICT_5X5_250", "a4", 210.0);
    assert!(sheets > 1, "17 facets of 62.5 mm do not fit one sheet");
    let wanted: Vec<(u32, f64)> = (20..37).map(|id| (id, 50.0)).collect();
    assert_sizes(&found, &wanted);
}

#[test]
fn the_flown_body_is_printed_with_its_small_markers() {
    let preset = "{name: alpha, preset: truncated, first_id: 17}";
    let (_, found) = printed(preset, "DICT_4X4_50", "a3", 297.0);
    let wanted: Vec<(u32, f64)> =
        (17..34).map(|id| (id, if id < 30 { 48.683 } else { 23.283 })).collect();
    assert_sizes(&found, &wanted);
}

#[test]
fn a_pdf_has_the_same_sheets() {
    let scratch = Scratch::new("pdf");
    let out = scratch.path("body.pdf");
    succeeds(&["markers", "--body", "bravo", "--out", out.to_str().expect("a text")]);
    let text = String::from_utf8(std::fs::read(&out).expect("it was written")).expect("no streams");
    // Every object is where the table of objects says.
    let (body, table) = text.rsplit_once("xref\n0 ").expect("a table");
    let places: Vec<usize> = table
        .lines()
        .filter(|line| line.ends_with(" 00000 n "))
        .map(|line| line[..10].parse().expect("a place"))
        .collect();
    for (index, place) in places.iter().enumerate() {
        assert!(body[*place..].starts_with(&format!("{} 0 obj\n", index + 1)));
    }
    let start = table.split("startxref\n").nth(1).expect("its own place");
    assert_eq!(start.lines().next(), Some(body.len().to_string().as_str()));
    let pages = text.matches("<< /Type /Page /Parent 2 0 R ").count();
    assert!(pages > 0 && text.contains(&format!(" /Count {pages} >>")), "{pages} pages");
    // 17 markers of 50 mm each, in millimetres under the page's own scale.
    let squares = text.lines().filter(|line| line.starts_with("0 g ") && line.ends_with("f*"));
    let is_marker = |line: &&str| {
        let numbers: Vec<f64> = line.split(' ').filter_map(|word| word.parse().ok()).collect();
        // "0 g" comes first: then the square's top left and top right.
        let side = (numbers[3] - numbers[1]).hypot(numbers[4] - numbers[2]);
        numbers.len() > 9 && (side - 50.0).abs() < 1e-3
    };
    assert_eq!(squares.filter(is_marker).count(), 17);
    assert!(text.contains("2.83464567 0 0 -2.83464567"), "72 points are an inch of 25.4 mm");
}

#[test]
fn sheets_that_cannot_be_are_refused_with_a_cure() {
    for (arguments, wanted) in [
        (&["--body", "nobody", "--out", "/tmp/x.svg"][..], "there are alpha, bravo"),
        (&["--body", "alpha", "--out", "/tmp/x.png"], "must end in .pdf or .svg"),
        (&["--body", "alpha", "--out", "/nowhere/x.pdf"], "cannot write /nowhere/x.pdf"),
        (
            &["--body", "alpha", "--out", "/tmp/x.pdf", "--set", "bodies.dictionary=DICT_5X5_5"],
            "unknown dictionary",
        ),
        (
            &[
                "--body",
                "bravo",
                "--out",
                "/tmp/x.pdf",
                "--set",
                "bodies.dictionary=DICT_APRILTAG_16h5",
            ],
            "body 'bravo' has markers 30, 31, 32, 33; DICT_APRILTAG_16h5 has ids 0 to 29",
        ),
        (
            &["--body", "alpha", "--out", "/tmp/x.pdf", "--set", "bodies.list=[{edge_m: 0.25}]"],
            "try --paper a3",
        ),
    ] {
        let arguments: Vec<&str> = ["markers"].iter().chain(arguments).copied().collect();
        let (succeeded, output) = run(&arguments);
        assert!(!succeeded && output.contains(wanted), "{arguments:?}:\n{output}");
    }
}
