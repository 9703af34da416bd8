#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::{Mutex, MutexGuard};

use flockeye_contract::FrameOrder;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::lock::lock;
use nalgebra::{Unit, Vector3};

use super::adapter::Memory;
use super::*;
use crate::cutting::Cutter;

const CAMERA: Camera = Camera::equirectangular(64, 32);

/// Holds back other tests: drivers of real devices were seen to hang where several threads of a
/// process open and destroy devices at once.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    lock(&ONE_AT_A_TIME)
}

/// A rectifier for this memory, or for the device's best.
fn gpu(memory: Option<Memory>) -> Option<GpuRectifier> {
    let Ok(found) = FoundAdapter::best() else {
        flockeye_require::absent(flockeye_require::VULKAN, "a Vulkan device");
        return None;
    };
    let device = Device::open(&found, memory).unwrap();
    Some(GpuRectifier::on(device, &found))
}

fn key(sequence: u64) -> FrameOrder {
    (0, 0, sequence)
}

fn look(x: f64, size_px: u32) -> Cut {
    let direction = Unit::new_normalize(Vector3::new(x, 1.0, 0.1));
    Cut::bilinear(View::looking_at(&direction, 1.0, size_px))
}

/// A frame of one grey.
fn plain(grey: u8) -> Vec<u8> {
    vec![grey; 64 * 32]
}

fn sphere(pixels: &[u8]) -> SphereImage<'_> {
    SphereImage::new(pixels, 64, CAMERA).unwrap()
}

#[test]
fn memory_that_is_shared_gives_the_bytes_of_memory_that_is_not() {
    let _alone = alone();
    let pixels: Vec<u8> = (0..64 * 32).map(|k| (k * 7 % 251) as u8).collect();
    let mut results = Vec::new();
    for memory in [Memory::Shared, Memory::Apart] {
        let Some(mut gpu) = gpu(Some(memory)) else { return };
        let cuts = [look(0.0, 33), look(0.5, 40), look(-3.0, 7)];
        // More frames than slots, so that buffers are used again.
        for frame in 0..5 {
            gpu.order(key(frame), &sphere(&pixels), &cuts).unwrap();
            for cut in &cuts {
                let mut out = vec![0; cut.view.size_px.pow(2) as usize];
                gpu.cut(key(frame), &sphere(&pixels), cut, &mut out).unwrap();
                results.push((memory, out));
            }
        }
    }
    let (shared, apart) = results.split_at(15);
    for (one, other) in shared.iter().zip(apart) {
        assert_eq!(one.1, other.1);
    }
    assert_eq!(shared[0].1, shared[12].1);
}

#[test]
fn what_was_ordered_is_cut_together_and_what_was_not_alone() {
    let _alone = alone();
    let Some(mut gpu) = gpu(None) else { return };
    let pixels = plain(70);
    let mut out = [0; 32 * 32];
    let ordered = [look(0.0, 32), look(0.5, 32)];
    gpu.order(key(0), &sphere(&pixels), &ordered).unwrap();
    gpu.order(key(0), &sphere(&pixels), &ordered[1..]).unwrap();
    for cut in ordered {
        gpu.cut(key(0), &sphere(&pixels), &cut, &mut out).unwrap();
    }
    let slot = gpu.slot_of(key(0), &sphere(&pixels)).unwrap();
    assert_eq!(gpu.slots[slot].filled, 1);
    gpu.cut(key(0), &sphere(&pixels), &look(0.7, 32), &mut out).unwrap();
    assert_eq!((gpu.slots[slot].filled, out), (2, [70; 32 * 32]));
}

#[test]
fn views_are_divided_where_no_output_holds_them_all() {
    let _alone = alone();
    let Some(mut gpu) = gpu(None) else { return };
    gpu.device.max_bytes = 64 * 32 + 4;
    let pixels = plain(70);
    let cuts = [0.0, 0.5, 0.7, 0.9, 1.1].map(|x| look(x, 32));
    gpu.order(key(0), &sphere(&pixels), &cuts).unwrap();
    let slot = gpu.slot_of(key(0), &sphere(&pixels)).unwrap();
    assert_eq!(gpu.slots[slot].filled, 3);
    for cut in cuts {
        let mut out = [0; 32 * 32];
        gpu.cut(key(0), &sphere(&pixels), &cut, &mut out).unwrap();
        assert_eq!(out, [70; 32 * 32]);
    }
    let mut out = vec![0; 60 * 60];
    let error = gpu.cut(key(0), &sphere(&pixels), &look(0.0, 60), &mut out).unwrap_err();
    assert!(error.to_string().starts_with("the bytes of a view are 3600"), "{error}");
}

#[test]
fn a_newer_frame_takes_the_place_of_one_prepared_in_vain() {
    let _alone = alone();
    let Some(mut gpu) = gpu(None) else { return };
    let pixels: Vec<_> = (0..9).map(|frame| plain(10 * frame)).collect();
    let sphere = |frame: usize| sphere(&pixels[frame]);
    let cut = look(0.0, 8);
    gpu.order(key(0), &sphere(0), &[cut]).unwrap();
    gpu.order(key(1), &sphere(1), &[cut]).unwrap();
    for frame in 2..9 {
        gpu.prepare(key(frame as u64), &sphere(frame)).unwrap();
    }
    let held = |gpu: &GpuRectifier, frame: usize| {
        gpu.slots.iter().any(|slot| slot.holds(key(frame as u64), &sphere(frame)))
    };
    assert!(held(&gpu, 0) && held(&gpu, 1) && held(&gpu, 8) && !held(&gpu, 7));
    for frame in [0, 8, 1, 7, 0] {
        let mut out = [0; 64];
        gpu.cut(key(frame as u64), &sphere(frame), &cut, &mut out).unwrap();
        assert_eq!(out, [10 * frame as u8; 64], "frame {frame}");
    }
}

#[test]
fn a_lost_device_is_an_error_and_stays_one() {
    let _alone = alone();
    let Some(mut gpu) = gpu(None) else { return };
    let pixels = plain(70);
    let cut = look(0.0, 33);
    let mut out = [0; 33 * 33];
    gpu.cut(key(0), &sphere(&pixels), &cut, &mut out).unwrap();
    assert_eq!(out, [70; 33 * 33]);
    gpu.device.device.destroy();
    let error = gpu.cut(key(1), &sphere(&pixels), &cut, &mut out).unwrap_err();
    assert!(error.is_lost(), "{error}");
    let error = gpu.prepare(key(2), &sphere(&pixels)).unwrap_err();
    assert!(error.is_lost() && error.to_string().contains("was lost"), "{error}");
}

#[test]
fn a_device_lost_between_two_views_of_a_frame_costs_no_view() {
    let _alone = alone();
    for memory in [Memory::Shared, Memory::Apart] {
        let Some(gpu) = gpu(Some(memory)) else { return };
        let device = gpu.device.device.clone();
        let counters = SharedCounters::default();
        let mut cutter = Cutter::new(Box::new(gpu), 1, counters, CAMERA);
        let pixels = plain(70);
        let cuts = [look(0.0, 33), look(0.5, 33), look(0.7, 33)];
        cutter.attempt(|active| active.order(key(0), &sphere(&pixels), &cuts[..2])).unwrap();
        cutter.attempt(|active| active.prepare(key(1), &sphere(&pixels))).unwrap();
        for (k, cut) in cuts.iter().enumerate() {
            let mut out = [0; 33 * 33];
            cutter.attempt(|active| active.cut(key(0), &sphere(&pixels), cut, &mut out)).unwrap();
            assert_eq!(out, [70; 33 * 33]);
            if k == 0 {
                assert!(cutter.active.name().starts_with("gpu"));
                device.destroy();
            }
        }
        assert!(cutter.active.name().starts_with("cpu"));
    }
}

#[test]
fn what_the_device_cannot_hold_is_refused() {
    let _alone = alone();
    let Some(mut gpu) = gpu(None) else { return };
    gpu.device.max_bytes = 3840 * 1920;
    gpu.check_frame(&Camera::equirectangular(3838, 1920)).unwrap();
    let error = gpu.check_frame(&Camera::equirectangular(3842, 1920)).unwrap_err();
    assert!(error.to_string().contains("7376640, but"), "{error}");
    // A frame that comes all the same is refused too, and the rectifier lives on.
    gpu.device.max_bytes = 1000;
    let pixels = plain(70);
    let error = gpu.prepare(key(0), &sphere(&pixels)).unwrap_err();
    assert!(matches!(error, RectifyError::TooLarge { needed: 2048, .. }), "{error}");
    gpu.device.max_bytes = 10_000;
    gpu.prepare(key(0), &sphere(&pixels)).unwrap();
}
