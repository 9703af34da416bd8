//! Ratios of our times to OpenCV's, measured in turns in one run.
//!
//! Single-threaded work is measured in the thread's processor time. On a busy machine the scheduler
//! interrupts long work, but rarely short work.

use std::hint::black_box;
use std::time::Duration;

use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, Interpolation};
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::gpu::{FoundAdapter, GpuRectifier};
use flockeye_rectification::rectifier::Rectifier as _;
use opencv::boxed_ref::BoxedRef;
use opencv::core::{self, Mat};
use opencv::imgproc::{INTER_CUBIC, INTER_LINEAR};
use rustix::time::{ClockId, clock_gettime};

use crate::maps::Maps;
use crate::scene::{
    Scene, buffer, dual_fisheye, equirectangular, partition, region, stereographic,
};

/// Turns of each row; their medians are compared.
const ROUNDS: u32 = 41;

/// Runs all measurements and prints the table.
pub(crate) fn print() {
    core::set_num_threads(1).unwrap();
    println!(
        "\nratios, processor time of one thread, medians of {ROUNDS} turns; ours by {}",
        flockeye_imaging::sphere::instructions()
    );
    println!("{:<76} {:>9} {:>9} {:>7}", "", "ours", "theirs", "ratio");
    for interpolation in [Interpolation::Bilinear, Interpolation::Cubic] {
        partitions(interpolation);
    }
    let cameras = [
        ("equirectangular", equirectangular()),
        ("dual fisheye", dual_fisheye()),
        ("stereographic", stereographic()),
    ];
    for (name, camera) in cameras {
        for interpolation in [Interpolation::Bilinear, Interpolation::Cubic] {
            moving(name, camera, interpolation);
        }
    }
    graphics();
}

fn flag(interpolation: Interpolation) -> (&'static str, i32) {
    match interpolation {
        Interpolation::Bilinear => ("bilinear", INTER_LINEAR),
        Interpolation::Cubic => ("cubic", INTER_CUBIC),
    }
}

fn cut_of(view: View, interpolation: Interpolation) -> Cut {
    Cut { interpolation, ..Cut::bilinear(view) }
}

fn matrix(scene: &Scene) -> BoxedRef<'_, Mat> {
    let rows = scene.camera.height() as i32;
    let columns = scene.camera.width() as i32;
    Mat::new_rows_cols_with_data(rows, columns, &scene.pixels).unwrap()
}

fn partitions(interpolation: Interpolation) {
    let (name, flag) = flag(interpolation);
    let scene = Scene::of(equirectangular());
    let mut cpu = CpuRectifier::new(1);
    let cuts: Vec<Cut> = partition().into_iter().map(|view| cut_of(view, interpolation)).collect();
    let maps: Vec<_> = cuts
        .iter()
        .map(|cut| {
            let mut maps = Maps::new(cut.view.size_px);
            maps.build(&scene.camera, &cut.view);
            maps.fixed()
        })
        .collect();
    let sphere = matrix(&scene);
    let mut out = buffer(&cuts[0].view);
    let mut theirs = Mat::default();
    compare(
        &format!("12 partition views, {name}; remap with prepared fixed-point maps"),
        |_| {
            for cut in &cuts {
                scene.cut(&mut cpu, 0, cut, &mut out);
            }
        },
        |_| {
            for maps in &maps {
                maps.remap(&sphere, &mut theirs, flag);
            }
        },
    );
}

fn moving(camera_name: &str, camera: Camera, interpolation: Interpolation) {
    let (name, flag) = flag(interpolation);
    let scene = Scene::of(camera);
    let sphere = matrix(&scene);
    let mut cpu = CpuRectifier::new(1);
    let mut out = buffer(&region(0));
    let mut theirs = Mat::default();
    let mut maps = Maps::new(region(0).size_px);
    let mut ours = |round| scene.cut(&mut cpu, 0, &cut_of(region(round), interpolation), &mut out);
    let row = |how| format!("moving view of 400 px, {camera_name}, {name}; {how}");
    compare(&row("map, convertMaps, remap"), &mut ours, |round| {
        maps.build(&scene.camera, &region(round));
        maps.fixed().remap(&sphere, &mut theirs, flag);
    });
    compare(&row("map, remap"), &mut ours, |round| {
        maps.build(&scene.camera, &region(round));
        maps.remap(&sphere, &mut theirs, flag);
    });
}

fn graphics() {
    let found = match FoundAdapter::best() {
        Ok(found) => found,
        Err(error) => return println!("gpu: skipped: {error}"),
    };
    let is_software = found.is_software();
    let device = found.description();
    let mut gpu = GpuRectifier::open(found).unwrap();
    // A software device uses all processors; a real one needs one thread.
    let threads =
        if is_software { std::thread::available_parallelism().map_or(1, usize::from) } else { 1 };
    let scene = Scene::of(equirectangular());
    let mut cpu = CpuRectifier::new(threads);
    let cuts: Vec<Cut> = partition().into_iter().map(Cut::bilinear).collect();
    let mut out = buffer(&cuts[0].view);
    let mut theirs = buffer(&cuts[0].view);
    println!("wall clock, {device}");
    compare_by(
        ClockId::Monotonic,
        &format!("12 partition views of a frame, upload and readback; {}", cpu.name()),
        |round| {
            let frame = u64::from(round);
            gpu.order(scene.key(frame), &scene.sphere(), &cuts).unwrap();
            for cut in &cuts {
                scene.cut(&mut gpu, frame, cut, &mut out);
            }
        },
        |_| {
            for cut in &cuts {
                scene.cut(&mut cpu, 0, cut, &mut theirs);
            }
        },
    );
}

fn compare(name: &str, ours: impl FnMut(u32), theirs: impl FnMut(u32)) {
    compare_by(ClockId::ThreadCPUTime, name, ours, theirs);
}

/// Prints a row; `name` describes our work and OpenCV's.
fn compare_by(clock: ClockId, name: &str, mut ours: impl FnMut(u32), mut theirs: impl FnMut(u32)) {
    let mut times = [Vec::new(), Vec::new()];
    let now = || Duration::try_from(clock_gettime(clock)).unwrap();
    let time = |work: &mut dyn FnMut(u32), round| {
        let start = now();
        work(black_box(round));
        now() - start
    };
    // The first turn is a warm-up and is not counted.
    for round in 0..=ROUNDS {
        let took = [time(&mut ours, round), time(&mut theirs, round)];
        if round > 0 {
            times[0].push(took[0]);
            times[1].push(took[1]);
        }
    }
    let [ours, theirs] = times.map(|mut times: Vec<Duration>| {
        times.sort_unstable();
        times[times.len() / 2].as_secs_f64() * 1e3
    });
    println!("{name:<76} {ours:>6.2} ms {theirs:>6.2} ms {:>6.2}x", theirs / ours);
}
