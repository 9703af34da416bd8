#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use flockeye_config::Pipeline;
use flockeye_geometry::camera::SpherePixel;
use nalgebra::Vector3;

const SIZE: [u32; 2] = [640, 320];

fn core() -> Core {
    core_with("none")
}

fn core_with(sensor: &str) -> Core {
    let sensor = format!("inertial.source={sensor}");
    let size: Vec<String> = vec!["camera.width=640".into(), "camera.height=320".into(), sensor];
    let resolved = Resolved::of(Pipeline::parse("", &size, "x").unwrap()).unwrap();
    Core::new(&resolved, 3).unwrap()
}

/// What a camera that yaws shows of a world of waves, at a frame's time.
fn picture(yaw: f64) -> Vec<u8> {
    let camera = Camera::equirectangular(SIZE[0], SIZE[1]);
    let world_from_camera = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    let light = |k: u32| {
        let pixel = SpherePixel::new(f64::from(k % SIZE[0]), f64::from(k / SIZE[0]));
        let ray = world_from_camera * *camera.ray(pixel).unwrap();
        let waves = (0..20).map(|k| {
            let of = |n: u32| f64::from((k * 7919 + n * 104_729) % 1000) / 500.0 - 1.0;
            let wave = Vector3::new(of(1), of(2), of(3)) * (3.0 + f64::from(k));
            (wave.dot(&ray) + 3.0 * of(4)).sin()
        });
        (128.0 + 12.0 * waves.sum::<f64>()).round().clamp(0.0, 255.0) as u8
    };
    (0..SIZE[0] * SIZE[1]).map(light).collect()
}

fn header(sequence: u64, epoch: u32) -> FrameHeader {
    let exposure_ns = sequence as i64 * 33_333_333;
    let stamp = FrameStamp { sequence, exposure_ns, epoch, ..FrameStamp::default() };
    FrameHeader {
        stamp,
        width: SIZE[0],
        height: SIZE[1],
        stride: SIZE[0],
        ..FrameHeader::default()
    }
}

fn is_known(rotation: &Rotation) -> bool {
    rotation.source != RotationSource::Nothing.code()
}

#[test]
fn a_yaw_and_its_rate_are_found() {
    let mut core = core();
    let rate = 0.6;
    for sequence in 0..12 {
        let yaw = rate * sequence as f64 / 30.0;
        let found = core.on_frame(&header(sequence, 0), &picture(yaw)).unwrap();
        assert_eq!(is_known(&found), sequence > 0, "frame {sequence}");
        assert_eq!(found.generation, 3);
        if sequence > 5 {
            let off = Vector3::from(found.rate_in_camera) - Vector3::z() * rate;
            assert!(off.norm().to_degrees() < 1.0, "{off}");
            assert_eq!(found.earlier_exposure_ns, (sequence as i64 - 1) * 33_333_333);
        }
    }
}

#[test]
fn black_frames_and_a_covered_camera_say_nothing_and_harm_nothing() {
    let mut core = core();
    let black = vec![16; (SIZE[0] * SIZE[1]) as usize];
    let mut known = |sequence: u64, pixels: &[u8]| {
        is_known(&core.on_frame(&header(sequence, 0), pixels).unwrap())
    };
    assert!(!known(0, &picture(0.0)));
    assert!(known(1, &picture(0.02)));
    // A white frame, two seconds of black ones, and fog.
    assert!(!known(2, &vec![255; black.len()]));
    (3..63).for_each(|sequence| assert!(!known(sequence, &black)));
    let fog: Vec<u8> = picture(0.1).iter().map(|value| 128 + value / 200).collect();
    assert!(!known(63, &fog));
    assert!(!known(64, &picture(0.5)), "there is nothing before it to compare with");
    assert!(known(65, &picture(0.52)));
}

/// Samples of a sensor that lies as configured, from one time to another, of a camera that yaws.
fn samples(from_s: f64, to_s: f64, rate: impl Fn(f64) -> f64) -> Vec<ImuSample> {
    let times = (0..).map(|k| from_s + f64::from(k) / 200.0).take_while(|at_s| *at_s < to_s);
    let sample = |at_s: f64| ImuSample {
        at_ns: (at_s * 1e9).round() as i64,
        rate: [0.0, 0.0, rate(at_s) + 0.01],
        ..ImuSample::default()
    };
    times.map(sample).collect()
}

#[test]
fn an_inertial_sensor_carries_the_rotation_through_a_covered_camera() {
    let mut core = core_with("sim");
    let (fast, swing) = (4.0, 0.3);
    let yaw = |at_s: f64| swing * (fast * at_s).sin();
    let black = vec![16; (SIZE[0] * SIZE[1]) as usize];
    let mut sent_s = 0.0;
    for sequence in 0..120u64 {
        let at_s = sequence as f64 / 30.0;
        let news = samples(sent_s, at_s + 0.02, |at_s| swing * fast * (fast * at_s).cos());
        sent_s = at_s + 0.02;
        core.on_samples(&ImuHeader::default(), &news);
        let is_covered = (50..110).contains(&sequence);
        let pixels = if is_covered { black.clone() } else { picture(yaw(at_s)) };
        let found = core.on_frame(&header(sequence, 0), &pixels).unwrap();
        // The first frame after the cover has none before it to compare with.
        let wanted = match sequence {
            0 => RotationSource::Nothing,
            50..=110 => RotationSource::Inertial,
            _ if sequence < 40 => continue,
            _ => RotationSource::PictureAndInertial,
        };
        assert_eq!(found.source, wanted.code(), "frame {sequence}");
        if sequence > 40 {
            let turn = flockeye_convert::camera_turn(&found).unwrap();
            let truth =
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw(at_s - 1.0 / 30.0) - yaw(at_s));
            let off = turn.later_from_earlier.angle_to(&truth).to_degrees();
            assert!(off < 0.1, "frame {sequence}: {off}");
            let rate = swing * fast * (fast * at_s).cos();
            let off = (turn.rate_in_camera - Vector3::z() * rate).norm().to_degrees();
            assert!(off < 1.5, "frame {sequence}: {off}");
            let ahead = turn.ahead.unwrap();
            assert!((ahead.until_s - at_s - 0.0175).abs() < 0.003, "{}", ahead.until_s - at_s);
            let truth = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw(at_s) - yaw(ahead.until_s));
            assert!(ahead.ahead_from_later.angle_to(&truth).to_degrees() < 0.1);
        }
    }
    let notices = core.take_notices();
    assert!(matches!(notices[..], [SensorNotice::Agrees { .. }]), "{notices:?}");
    // The sensor starts anew, with a clock of its own.
    core.on_samples(&ImuHeader { epoch: 1, ..ImuHeader::default() }, &[]);
    let found = core.on_frame(&header(120, 0), &picture(yaw(4.0))).unwrap();
    assert_eq!(found.source, RotationSource::Picture.code());
}

#[test]
fn frames_of_another_flight_or_too_far_apart_are_not_compared() {
    let mut core = core();
    let mut known = |sequence: u64, epoch: u32| {
        is_known(&core.on_frame(&header(sequence, epoch), &picture(0.0)).unwrap())
    };
    assert!(!known(0, 0));
    assert!(known(1, 0));
    assert!(known(9, 0), "0.27 s");
    assert!(!known(19, 0), "0.33 s");
    assert!(!known(0, 1), "the recording has begun anew");
    assert!(known(1, 1));
    assert!(!known(1, 1), "time does not go on");
}

#[test]
fn a_frame_of_another_size_is_refused() {
    let mut core = core();
    let small = FrameHeader { stride: 320, ..header(0, 0) };
    assert!(core.on_frame(&small, &vec![0; 320 * 160]).is_err());
}
