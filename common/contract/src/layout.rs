//! Tests of the memory layout that `docs/CONTRACT.md` specifies for stages in other languages.
#![allow(clippy::unwrap_used)]

use std::mem::{align_of, size_of};

use crate::{
    BodyTruth, Complaint, DetectedMarker, DetectionHeader, FrameEnd, FrameHeader, HandOver, Health,
    ImuHeader, ImuSample, JournalEntry, JournalHeader, OdometrySample, PacketHeader, PeerHeader,
    PeerSighting, PlanHeader, PlannedView, Rotation, SwarmHeader, SwarmPose, Text, Track,
    TrackHeader, TruthHeader, ViewHeader,
};

#[test]
fn the_layout_is_the_documented_one() {
    let contract = include_str!("../../../docs/CONTRACT.md");
    let documented = contract
        .split("```layout\n")
        .nth(1)
        .and_then(|rest| rest.split("```").next())
        .unwrap_or("docs/CONTRACT.md has no block ```layout");
    let layout = crate::description::layout();
    assert_eq!(layout, documented, "docs/CONTRACT.md must hold exactly:\n{layout}");
}

#[test]
fn type_names_are_pinned() {
    use iceoryx2::prelude::ZeroCopySend;
    // SAFETY: the call only names the type; nothing is transmitted.
    let names = unsafe {
        [
            FrameHeader::type_name(),
            PacketHeader::type_name(),
            ImuHeader::type_name(),
            ImuSample::type_name(),
            Rotation::type_name(),
            PlanHeader::type_name(),
            PlannedView::type_name(),
            ViewHeader::type_name(),
            DetectionHeader::type_name(),
            DetectedMarker::type_name(),
            FrameEnd::type_name(),
            TrackHeader::type_name(),
            Track::type_name(),
            JournalHeader::type_name(),
            JournalEntry::type_name(),
            OdometrySample::type_name(),
            PeerHeader::type_name(),
            PeerSighting::type_name(),
            SwarmHeader::type_name(),
            SwarmPose::type_name(),
            Health::type_name(),
            TruthHeader::type_name(),
            BodyTruth::type_name(),
            HandOver::type_name(),
            Complaint::type_name(),
        ]
    };
    let wanted = [
        "flockeye/FrameHeader",
        "flockeye/PacketHeader",
        "flockeye/ImuHeader",
        "flockeye/ImuSample",
        "flockeye/Rotation",
        "flockeye/PlanHeader",
        "flockeye/PlannedView",
        "flockeye/ViewHeader",
        "flockeye/DetectionHeader",
        "flockeye/DetectedMarker",
        "flockeye/FrameEnd",
        "flockeye/TrackHeader",
        "flockeye/Track",
        "flockeye/JournalHeader",
        "flockeye/JournalEntry",
        "flockeye/OdometrySample",
        "flockeye/PeerHeader",
        "flockeye/PeerSighting",
        "flockeye/SwarmHeader",
        "flockeye/SwarmPose",
        "flockeye/Health",
        "flockeye/TruthHeader",
        "flockeye/BodyTruth",
        "flockeye/HandOver",
        "flockeye/Complaint",
    ];
    assert_eq!(names, wanted);
}

#[test]
fn lying_headers_are_refused() {
    use crate::{Frames, PixelFormat, Topic};
    let honest = FrameHeader { width: 64, height: 32, stride: 64, ..FrameHeader::default() };
    let pixels = vec![0; 64 * 32];
    assert_eq!(Frames::check(&honest, &pixels), Ok(()));
    let refused = |change: &dyn Fn(&mut FrameHeader)| {
        let mut header = honest;
        change(&mut header);
        Frames::check(&header, &pixels).unwrap_err().to_string()
    };
    assert!(refused(&|header| header.height = 33).contains("2112 bytes of payload, 2048"));
    assert!(refused(&|header| header.width = 0).contains("0x32 pixels"));
    assert!(refused(&|header| header.stride = 63).contains("rows of 64 pixels"));
    assert!(refused(&|header| header.height = u32::MAX).contains("pixels"));
    assert!(
        refused(&|header| header.pixel_format = PixelFormat::Nv12.code()).contains("3072 bytes")
    );
    assert!(refused(&|header| header.pixel_format = 99).contains("unknown pixel format code 99"));
    assert!(refused(&|header| header.transfer = 1).contains("gamma 0"));
}

#[test]
fn senseless_plans_and_detections_are_refused() {
    use crate::{Detections, Plans, Topic, ViewKind};
    let view = PlannedView {
        camera_from_view: [0.0, 0.0, 0.0, 1.0],
        focal_px: 600.0,
        size_px: 900,
        ..PlannedView::default()
    };
    let refused = |change: &dyn Fn(&mut PlannedView)| {
        let mut view = view;
        change(&mut view);
        Plans::check(&PlanHeader::default(), &[view]).unwrap_err().to_string()
    };
    assert_eq!(Plans::check(&PlanHeader::default(), &[view; 12]), Ok(()));
    for gamma in [-1.0, 0.01, f32::NAN] {
        let bent = PlanHeader { gamma, ..PlanHeader::default() };
        assert!(Plans::check(&bent, &[view]).unwrap_err().to_string().contains("gamma"));
    }
    assert!(refused(&|view| view.camera_from_view[0] = f64::NAN).contains("length NaN"));
    assert!(refused(&|view| view.size_px = 0).contains("0x0 pixels"));
    assert!(refused(&|view| view.size_px = 16_000).contains("16000x16000"));
    assert!(refused(&|view| view.focal_px = f64::INFINITY).contains("focal length"));
    assert!(refused(&|view| view.rate_in_camera[1] = f64::NAN).contains("view rate"));
    assert!(refused(&|view| view.search = 77).contains("unknown search code 77"));
    assert!(refused(&|view| view.kind = 77).contains("unknown view kind code 77"));
    assert!(
        refused(&|view| (view.kind, view.target) = (ViewKind::Roi.code(), u32::MAX))
            .contains("target")
    );
    assert!(
        Plans::check(&PlanHeader::default(), &[view; 1000])
            .unwrap_err()
            .to_string()
            .contains("1000 views")
    );
    let marker = DetectedMarker {
        rays_in_camera: [[1.0, 0.0, 0.0]; 4],
        deviations: [1e-3; 4],
        ..DetectedMarker::default()
    };
    let header = DetectionHeader::default();
    assert_eq!(Detections::check(&header, &[marker]), Ok(()));
    let long = DetectedMarker { rays_in_camera: [[2.0, 0.0, 0.0]; 4], ..marker };
    assert!(Detections::check(&header, &[long]).unwrap_err().to_string().contains("length 2"));
    let sure = DetectedMarker { deviations: [0.0; 4], ..marker };
    assert!(Detections::check(&header, &[sure]).unwrap_err().to_string().contains("deviation"));
    let boasting = DetectionHeader { hits: 3, ..header };
    assert!(Detections::check(&boasting, &[marker]).unwrap_err().to_string().contains("3 hits"));
    let hit = DetectionHeader { hits: 1, ..header };
    assert_eq!(Detections::check(&hit, &[marker]), Ok(()));
}

#[test]
fn text_is_plain_bytes() {
    assert_eq!((size_of::<Text<32>>(), align_of::<Text<32>>()), (32, 1));
}
