//! The visual gyroscope on a recording: its cost for each frame, and its error beside the recording's
//! inertial sensor, whose constant bias is taken out. Prints a table for each recording that has both.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;
use std::time::Duration;

use flockeye_capture::{Event, Paced, Source, SourceParameters};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::statistics::{median, quantile};
use flockeye_imaging::gyroscope::grid::Sampler;
use flockeye_imaging::gyroscope::{CameraRotation, Gyroscope};
use flockeye_imaging::sphere::SphereImage;
use flockeye_tests::recordings;
use nalgebra::{UnitQuaternion, Vector3};
use rustix::time::{ClockId, clock_gettime};

fn main() {
    // `cargo test` runs each benchmark once, without this word.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    let Some(data) = recordings() else { return println!("gyroscope: no recordings") };
    let (video, imu) = (data.join("flight4/flight4.mp4"), data.join("flight4/imu.csv"));
    let (found, times_ms) = followed(&video);
    let rates = read(&imu);
    let pairs: Vec<(f64, &CameraRotation, Vector3<f64>)> = found
        .iter()
        .filter_map(|(at_s, found)| {
            let found = found.as_ref()?;
            Some((*at_s, found, turned(&rates, at_s - 1.0 / 30.0, *at_s)?))
        })
        .collect();
    let off = |found: &CameraRotation, truth: Vector3<f64>| {
        // The sensor turns the world the other way than the camera's frame.
        found.later_from_earlier.inverse().scaled_axis() - truth
    };
    let bias = pairs.iter().map(|(_, found, truth)| off(found, *truth)).sum::<Vector3<f64>>()
        / pairs.len() as f64;
    let mut errors_deg: Vec<f64> = Vec::new();
    let (mut nees, mut stated_deg) = (0.0, Vec::new());
    for (_, found, truth) in &pairs {
        let error = off(found, *truth) - bias;
        errors_deg.push(error.norm().to_degrees());
        let information = found.covariance.try_inverse().expect("it is positive");
        // Both frames turn by a degree or two at most, so the axes are nearly the same.
        stated_deg.push(found.covariance.trace().sqrt().to_degrees());
        nees += error.dot(&(information * error));
    }
    errors_deg.sort_by(f64::total_cmp);
    stated_deg.sort_by(f64::total_cmp);
    let mut times_ms = times_ms;
    times_ms.sort_by(f64::total_cmp);
    println!(
        "flight4: {} of {} rotations; error median {:.3} degrees, 95 % {:.3}, worst {:.3}; stated {:.3}; NEES {:.1} (3 is right)",
        pairs.len(),
        found.len() - 1,
        median(&errors_deg).unwrap(),
        quantile(&errors_deg, 0.95).unwrap(),
        errors_deg.last().unwrap(),
        median(&stated_deg).unwrap(),
        nees / pairs.len() as f64,
    );
    println!(
        "processor time of a frame: median {:.2} ms, 95 % {:.2} ms; bias of the sensor {:.2} degrees/s",
        median(&times_ms).unwrap(),
        quantile(&times_ms, 0.95).unwrap(),
        bias.norm().to_degrees() * 30.0,
    );
}

/// Processor time of this thread: what else runs on the machine does not count.
fn processor_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// The rotations to each frame, by its time in seconds, and what each took, milliseconds.
fn followed(video: &Path) -> (Vec<(f64, Option<CameraRotation>)>, Vec<f64>) {
    let camera = Camera::equirectangular(3840, 1920);
    let mut gyroscope = Gyroscope::new(Sampler::new(&camera, &Mask::nothing_hidden(camera)));
    let parameters = SourceParameters {
        flow: Paced::Lossless,
        ..SourceParameters::new(camera.width(), camera.height())
    };
    let spec = video.display().to_string().parse().unwrap();
    let mut source = Source::open(spec, parameters).unwrap();
    let (mut found, mut times_ms) = (Vec::new(), Vec::new());
    loop {
        match source.next(Duration::from_secs(5)).unwrap() {
            Event::Frame(picture) => {
                let frame = SphereImage::new(picture.luma(), picture.stride(), camera).unwrap();
                let begun_ms = processor_ms();
                let rotation = gyroscope.next(&frame, None);
                times_ms.push(processor_ms() - begun_ms);
                found.push((picture.stream_time().as_secs_f64(), rotation));
            }
            Event::End(_) => return (found, times_ms),
            _ => {}
        }
    }
}

/// Time in seconds and angular velocity of each row, rad/s.
fn read(path: &Path) -> Vec<(f64, Vector3<f64>)> {
    let text = std::fs::read_to_string(path).unwrap();
    let rows = text.lines().skip(1).map(|line| {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        (cells[0], Vector3::new(cells[1], cells[2], cells[3]))
    });
    rows.collect()
}

/// How the sensor turns between two times.
fn turned(rates: &[(f64, Vector3<f64>)], from_s: f64, to_s: f64) -> Option<Vector3<f64>> {
    let mut turned = UnitQuaternion::identity();
    let (first, last) = (rates.first()?.0, rates.last()?.0);
    if from_s < first || to_s > last {
        return None;
    }
    for pair in rates.windows(2) {
        let (begin, end) = (pair[0].0.max(from_s), pair[1].0.min(to_s));
        if end > begin {
            let rate = (pair[0].1 + pair[1].1) / 2.0;
            turned *= UnitQuaternion::from_scaled_axis(rate * (end - begin));
        }
    }
    Some(turned.scaled_axis())
}
