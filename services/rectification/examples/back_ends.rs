//! Measures the GPU back end and the CPU back end on this machine. Prints the table of
//! docs/results/gpu.md.
//!
//! ```text
//! cargo run --release -p flockeye-rectification --example back_ends
//! ```
//!
//! Frames of 3840 x 1920 px have 12 and 24 views, ordered as in the stage. The pixels of both back
//! ends are compared.
#![allow(
    clippy::unwrap_used,
    reason = "the cuts are sound, and a lost device shall end the program"
)]

#[path = "../benches/rectify/scene.rs"]
#[allow(dead_code, reason = "not all of it is needed here")]
mod scene;

use std::time::Instant;

use flockeye_imaging::sphere::Cut;
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::gpu::{FoundAdapter, GpuRectifier};
use flockeye_rectification::rectifier::Rectifier;
use rustix::time::{ClockId, clock_gettime};

use self::scene::{Scene, buffer, equirectangular, partition, region};

/// Number of measured frames, after warm-up frames that fill the slots.
const FRAMES: u64 = 60;
const WARM_UP: u64 = 10;

fn main() -> anyhow::Result<()> {
    let scene = Scene::of(equirectangular());
    let found = FoundAdapter::best()?;
    let mut gpu = GpuRectifier::open(found)?;
    println!("## {}\n", gpu.name());
    println!(
        "| views | back end | a frame alone, ms | uploading it, ms | frames/s | processor, ms/frame |"
    );
    println!("| --- | --- | --- | --- | --- | --- |");
    for (name, cuts) in
        [("12 of 936 px", twelve()), ("24: 12 of 936 px, 12 of 400 px, cubic", more())]
    {
        let mut cpus = [1, 2, 4].map(CpuRectifier::new);
        let mut back_ends: Vec<&mut dyn Rectifier> = vec![&mut gpu];
        back_ends.extend(cpus.iter_mut().map(|cpu| cpu as &mut dyn Rectifier));
        for rectifier in back_ends {
            let measured = measure(rectifier, &scene, &cuts);
            println!("| {name} | {} | {measured} |", short(&rectifier.name()));
        }
    }
    println!("\n{}", differences(&mut gpu, &scene, &more()));
    Ok(())
}

/// The partition's views.
fn twelve() -> Vec<Cut> {
    partition().into_iter().map(Cut::bilinear).collect()
}

/// The partition's views, and as many regions of interest.
fn more() -> Vec<Cut> {
    let regions = (0..12).map(|k| Cut::cubic(region(8 * k)));
    twelve().into_iter().chain(regions).collect()
}

/// A back end's name without the reasons for it.
fn short(name: &str) -> String {
    name.split(" (").next().unwrap_or(name).replace('\'', "")
}

/// A row of the table: medians of single frames, and means of consecutive frames.
fn measure(rectifier: &mut dyn Rectifier, scene: &Scene, cuts: &[Cut]) -> String {
    let mut outs: Vec<Vec<u8>> = cuts.iter().map(|cut| buffer(&cut.view)).collect();
    let order = |rectifier: &mut dyn Rectifier, frame: u64| {
        rectifier.order(scene.key(frame), &scene.sphere(), cuts).unwrap(); // A lost device ends it.
    };
    let mut cut_all = |rectifier: &mut dyn Rectifier, frame: u64| {
        for (cut, out) in cuts.iter().zip(&mut outs) {
            scene.cut(rectifier, frame, cut, out);
        }
    };
    let (mut alone, mut uploads) = (Vec::new(), Vec::new());
    for frame in 0..WARM_UP + FRAMES {
        let begun = Instant::now();
        rectifier.prepare(scene.key(frame), &scene.sphere()).unwrap(); // A lost device ends it.
        uploads.push(begun.elapsed().as_secs_f64() * 1e3);
        order(rectifier, frame);
        cut_all(rectifier, frame);
        alone.push(begun.elapsed().as_secs_f64() * 1e3);
    }
    // As in the stage: the next frame is uploaded during the wait for this frame's views.
    let first = 1000;
    rectifier.prepare(scene.key(first), &scene.sphere()).unwrap(); // A lost device ends it.
    let (begun, used) = (Instant::now(), processor_ms());
    for frame in first..first + FRAMES {
        order(rectifier, frame);
        rectifier.prepare(scene.key(frame + 1), &scene.sphere()).unwrap(); // A lost device ends it.
        cut_all(rectifier, frame);
    }
    let rate = FRAMES as f64 / begun.elapsed().as_secs_f64();
    let used = (processor_ms() - used) / FRAMES as f64;
    let median = |values: &mut Vec<f64>| {
        values.drain(..WARM_UP as usize);
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let (alone, uploads) = (median(&mut alone), median(&mut uploads));
    format!("{alone:.2} | {uploads:.2} | {rate:.0} | {used:.1}")
}

/// Processor time of this process, milliseconds.
fn processor_ms() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 / 1e6
}

/// Text about the differences between the pixels of both back ends.
fn differences(gpu: &mut dyn Rectifier, scene: &Scene, cuts: &[Cut]) -> String {
    let mut cpu = CpuRectifier::new(1);
    let mut by_difference = [0u64; 256];
    for cut in cuts {
        let (mut one, mut other) = (buffer(&cut.view), buffer(&cut.view));
        scene.cut(gpu, 5000, cut, &mut one);
        scene.cut(&mut cpu, 5000, cut, &mut other);
        for (a, b) in one.iter().zip(&other) {
            by_difference[usize::from(a.abs_diff(*b))] += 1;
        }
    }
    let all: u64 = by_difference.iter().sum();
    let most = by_difference.iter().rposition(|&count| count > 0).unwrap_or(0);
    let above: u64 = by_difference[3..].iter().sum();
    format!(
        "Greys of {all} pixels of a hard texture: {:.3} % are the same, {:.4} % differ by more than 2, the most by {most}.",
        100.0 * by_difference[0] as f64 / all as f64,
        100.0 * above as f64 / all as f64,
    )
}
