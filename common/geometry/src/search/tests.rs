#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Isometry3, Matrix3, Unit, UnitQuaternion};
use proptest::prelude::*;

use super::*;
use crate::body::squares;

const RESOLUTION: f64 = 3840.0 / std::f64::consts::TAU;

fn planner(mode: PlanOrder, roi: RoiOptions) -> Planner {
    let partition = Partition::icosahedron();
    let views = partition.views(0.1, RESOLUTION).unwrap();
    Planner::new(mode, partition, views, roi).unwrap()
}

fn neighbour(target: usize) -> PredictedNeighbour {
    PredictedNeighbour {
        target,
        direction_in_camera: Unit::new_normalize(Vector3::new(1.0, 0.3 * target as f64, 0.1)),
        rate_in_camera: Vector3::new(0.0, 0.0, 0.4),
        radius_rad: 0.05,
        deviation_rad: 0.01,
        marker_rad: 0.03,
        is_stale: false,
    }
}

fn partitions(plan: &Plan) -> Vec<usize> {
    plan.views
        .iter()
        .filter_map(|planned| match planned.purpose {
            Purpose::Partition(part) => Some(part),
            _ => None,
        })
        .collect()
}

fn targets(plan: &Plan) -> Vec<usize> {
    plan.views
        .iter()
        .filter_map(|planned| match planned.purpose {
            Purpose::Roi(target) => Some(target),
            _ => None,
        })
        .collect()
}

#[test]
fn algorithm_1_begins_where_the_last_detection_was() {
    let partition = Partition::icosahedron();
    assert_eq!(optimized(&partition, None), greedy(&partition));
    for n in 0..12 {
        let order = optimized(&partition, Some(n));
        assert_eq!(order[0], n);
        let mut all = order.clone();
        all.sort_unstable();
        assert_eq!(all, greedy(&partition));
        // Five neighbours, five beyond them, the opposite one; each group by number.
        assert!(order[1..6].is_sorted() && order[6..11].is_sorted());
        let directions = partition.directions();
        let distance = |k: usize| directions[n].angle(&directions[order[k]]);
        assert!(distance(5) + 0.1 < distance(6) && distance(10) + 0.1 < distance(11));
    }
    assert_eq!(optimized(&partition, Some(12)), greedy(&partition));
}

#[test]
fn the_papers_modes_stop_at_the_first_hit() {
    let roi = RoiOptions::new(RESOLUTION);
    let mut searched = Searched::new(12, 0);
    let neighbours = [neighbour(0)];
    let optimized = planner(PlanOrder::Optimized, roi);
    let greedy = planner(PlanOrder::Greedy, roi);
    assert_eq!(optimized.plan(&searched, &neighbours), greedy.plan(&searched, &neighbours));
    searched.hit(Purpose::Partition(7));
    searched.hit(Purpose::Roi(0));
    searched.hit(Purpose::Partition(99));
    assert_eq!(searched.last_hit(), Some(7));
    let plan = optimized.plan(&searched, &neighbours);
    assert_eq!(partitions(&plan)[0], 7);
    assert_eq!((plan.stop_rule, plan.view_budget, plan.views.len()), (StopRule::FirstHit, 12, 12));
    let plan = greedy.plan(&searched, &neighbours);
    assert_eq!(partitions(&plan), (0..12).collect::<Vec<_>>());
    assert_eq!(plan.stop_rule, StopRule::FirstHit);
    let plan = planner(PlanOrder::Exhaustive, roi).plan(&searched, &neighbours);
    assert_eq!((plan.stop_rule, plan.view_budget, plan.views.len()), (StopRule::All, 12, 12));
}

#[test]
fn a_plan_follows_first_and_then_goes_round() {
    let planner = planner(PlanOrder::Roi, RoiOptions::new(RESOLUTION));
    let mut searched = Searched::new(12, 0);
    for part in [0, 1, 2] {
        searched.record(1, Purpose::Partition(part));
    }
    searched.record(2, Purpose::Partition(1));
    searched.record(3, Purpose::Partition(40));
    let plan = planner.plan(&searched, &[neighbour(2), neighbour(1)]);
    assert_eq!(targets(&plan), [2, 1]);
    assert_eq!(partitions(&plan), [3, 4, 5, 6, 7, 8, 9, 10, 11, 0, 2, 1]);
    assert!(matches!(plan.views[1].purpose, Purpose::Roi(1)));
    assert_eq!((plan.stop_rule, plan.view_budget), (StopRule::Deadline, 4));
    assert_eq!(plan.views[0].rate_in_camera, neighbour(2).rate_in_camera);
    assert_eq!(plan.views[2].rate_in_camera, Vector3::zeros());
}

#[test]
fn a_crowd_does_not_hide_the_partitions_nor_each_other() {
    // Time for five views a frame, and nine neighbours.
    let planner = planner(PlanOrder::Roi, RoiOptions::new(RESOLUTION));
    let neighbours: Vec<_> = (0..9).map(neighbour).collect();
    let mut searched = Searched::new(12, 0);
    let mut followed = [0; 9];
    for frame in 0..36 {
        for planned in &planner.plan(&searched, &neighbours).views[..5] {
            searched.record(frame, planned.purpose);
            if let Purpose::Roi(target) = planned.purpose {
                followed[target] += 1;
            }
        }
    }
    assert!(followed.iter().all(|&frames| frames >= 12), "{followed:?}");
    for part in 0..12 {
        assert!(searched.last_searched(Purpose::Partition(part)).unwrap() >= 24);
    }
}

/// A planner with 12 partitions and 32 high-resolution tiles.
fn fine_planner(partitions_per_frame: usize) -> Planner {
    let roi = RoiOptions { partitions_per_frame, ..RoiOptions::new(RESOLUTION) };
    let fine = Partition::stored(32).unwrap().views(0.05, 2.0 * RESOLUTION).unwrap();
    planner(PlanOrder::Roi, roi).with_high_resolution_tiles(fine)
}

#[test]
fn both_resolutions_are_swept_in_turn_however_little_time_there_is() {
    for per_frame in [1, 3, 4] {
        let planner = fine_planner(per_frame);
        let mut searched = planner.nothing_searched();
        let mut order = Vec::new();
        for frame in 0..100 {
            let plan = planner.plan(&searched, &[]);
            assert_eq!(plan.views.len(), 44);
            for planned in &plan.views[..plan.view_budget] {
                searched.record(frame, planned.purpose);
                let is_fine = matches!(planned.purpose, Purpose::HighResolution(_));
                assert_eq!(is_fine, planned.view.focal_px > 1.5 * RESOLUTION);
                assert_eq!(planned.search, Search::AllWindows);
                order.push(planned.purpose);
            }
        }
        // The partition is searched once as a whole before any high-resolution tile.
        assert!(order[..12].iter().all(|purpose| matches!(purpose, Purpose::Partition(_))));
        for part in 0..12 {
            let is_part = |(_, other): &(usize, &Purpose)| **other == Purpose::Partition(part);
            let at: Vec<usize> =
                order[12..].iter().enumerate().filter(is_part).map(|(at, _)| at).collect();
            assert!(at.windows(2).all(|pair| pair[1] - pair[0] <= 26), "{per_frame}: {at:?}");
        }
        for tile in 0..32 {
            let is_tile = |other: &Purpose| *other == Purpose::HighResolution(tile);
            let first = order.iter().position(is_tile).unwrap();
            assert!(first < 12 + 2 * 32 + per_frame, "{per_frame}: {tile} is {first}th");
        }
    }
}

#[test]
fn high_resolution_tiles_that_the_mask_hides_are_not_planned() {
    let camera = crate::camera::Camera::equirectangular(64, 32);
    let seen = (0..64 * 32).map(|pixel| pixel < 16 * 64).collect();
    let mask = Mask::new(camera, [64, 32], seen).unwrap();
    let planner = fine_planner(4).with_mask(mask.clone());
    let plan = planner.plan(&planner.nothing_searched(), &[]);
    let is_fine = |planned: &&SearchView| matches!(planned.purpose, Purpose::HighResolution(_));
    let fine = plan.views.iter().filter(is_fine).count();
    assert!((14..28).contains(&fine), "{fine}");
    assert_eq!(plan.views.len() - fine, 12 - planner.hidden_partitions());
    // Whichever is given first.
    let tiles = fine_planner(4).high_resolution.into_iter().flatten().collect();
    let other = self::planner(PlanOrder::Roi, planner.roi).with_mask(mask);
    assert_eq!(other.with_high_resolution_tiles(tiles), planner);
}

#[test]
fn hits_in_high_resolution_tiles_are_not_the_papers_n() {
    let mut searched = Searched::new(12, 32);
    searched.hit(Purpose::HighResolution(3));
    assert_eq!(searched.last_hit(), None);
}

#[test]
fn windows_alternate_for_each_tile_and_neighbours_get_all() {
    let planner = fine_planner(44).with_alternating_windows(true);
    let mut searched = planner.nothing_searched();
    for (frame, window) in
        [Search::FineWindow, Search::CoarseWindow].into_iter().cycle().enumerate().take(4)
    {
        let plan = planner.plan(&searched, &[neighbour(0)]);
        assert_eq!(plan.views.len(), 45);
        for planned in &plan.views {
            let is_followed = matches!(planned.purpose, Purpose::Roi(_));
            let wanted = if is_followed { Search::AllWindows } else { window };
            assert_eq!(planned.search, wanted, "{:?}", planned.purpose);
            searched.record(frame as u64, planned.purpose);
            searched.record_window(planned.purpose, planned.search);
        }
    }
    // Two frames that follow the same plan use the same window: the other one is still next.
    let tile = Purpose::Partition(5);
    searched.record_window(tile, Search::FineWindow);
    searched.record_window(tile, Search::FineWindow);
    assert_eq!(searched.next_window(tile), Search::CoarseWindow);
    // After a search with all windows, as rectification's own sweep does, the fine one is next.
    searched.record_window(tile, Search::AllWindows);
    assert_eq!(searched.next_window(tile), Search::FineWindow);
    // A tile that does not exist is ignored.
    searched.record_window(Purpose::HighResolution(99), Search::FineWindow);
}

proptest! {
    #[test]
    fn every_partition_is_searched_within_a_bounded_number_of_frames(
        crowd in 0usize..20,
        partitions_per_frame in 1usize..14,
        history in proptest::collection::vec((0u64..50, 0usize..12), 0..40),
    ) {
        let roi = RoiOptions { partitions_per_frame, ..RoiOptions::new(RESOLUTION) };
        let planner = planner(PlanOrder::Roi, roi);
        let neighbours: Vec<_> = (0..crowd).map(neighbour).collect();
        let mut searched = Searched::new(12, 0);
        let mut history = history;
        history.sort_unstable();
        for (frame, part) in history {
            searched.record(frame, Purpose::Partition(part));
        }
        for frame in 50..50 + 12usize.div_ceil(partitions_per_frame) as u64 {
            let plan = planner.plan(&searched, &neighbours);
            prop_assert_eq!(targets(&plan).len(), crowd);
            for planned in &plan.views[..plan.view_budget] {
                searched.record(frame, planned.purpose);
            }
        }
        for part in 0..12 {
            prop_assert!(searched.last_searched(Purpose::Partition(part)) >= Some(50));
        }
    }

    #[test]
    fn a_region_of_interest_is_small_and_shows_the_body_and_its_margins(
        range in 0.25..5.0f64,
        deviation in 0.0..0.2f64,
        (x, y, z) in (-1.0..1.0f64, -1.0..1.0f64, 0.1..1.0f64),
    ) {
        let body = squares("alpha", 0.0625, 0.05, 0);
        let position = Vector3::new(x, y, z).normalize() * range;
        let pose = Isometry3::from_parts(position.into(), UnitQuaternion::identity());
        let covariance = Matrix3::identity() * (deviation * range).powi(2);
        let predicted =
            PredictedNeighbour::from_pose(3, &body, &pose, &covariance, &Vector3::zeros()).unwrap();
        prop_assert!((predicted.deviation_rad - deviation).abs() < 1e-9);
        let view = roi_view(&predicted, RESOLUTION).unwrap().view;
        prop_assert!(view.direction_in_camera().angle(&Unit::new_normalize(position)) < 1e-6);
        prop_assert!(view.size_px <= 640);
        let magnification = view.focal_px / RESOLUTION;
        let marker_px = predicted.marker_rad * view.focal_px;
        prop_assert!(magnification < 3.0 + 1e-9);
        prop_assert!(magnification > 1.0 - 1e-9 || marker_px > 80.0 - 1e-9);
        let wanted = 2.0 * (predicted.radius_rad + 3.0 * predicted.deviation_rad);
        let shown = view.field_rad();
        // Cut only where it must be: at 70 degrees, or at 640 pixels that are not magnified, or
        // only as much as decoding needs.
        let is_needed = magnification <= 1.0 + 1e-9 || marker_px <= 24.0 + 1e-9;
        let is_cut = wanted > 70f64.to_radians() || (view.size_px == 640 && is_needed);
        prop_assert!(marker_px > 24.0 - 1e-9 || magnification > 3.0 - 1e-9, "{marker_px}");
        prop_assert!(shown >= wanted - 1e-9 || is_cut, "{shown} {wanted} {view:?}");
        if !is_cut && view.size_px < 630 && magnification < 3.0 - 1e-9 && magnification > 1.0 + 1e-9 {
            prop_assert!((marker_px - 80.0).abs() < 1e-6, "{marker_px}");
        }
    }
}

#[test]
fn the_rate_is_how_the_direction_turns() {
    let body = squares("alpha", 0.0625, 0.05, 0);
    let pose = Isometry3::translation(0.0, 2.0, 0.0);
    let velocity = Vector3::new(-1.0, 3.0, 0.0);
    let covariance = Matrix3::from_diagonal(&Vector3::new(0.01, 0.25, 0.04));
    let predicted = PredictedNeighbour::from_pose(0, &body, &pose, &covariance, &velocity).unwrap();
    // One metre a second across, two metres away; what is along the sight turns nothing.
    assert!((predicted.rate_in_camera - Vector3::new(0.0, 0.0, 0.5)).norm() < 1e-12);
    assert!((predicted.deviation_rad - 0.1).abs() < 1e-12);
    let later = UnitQuaternion::from_scaled_axis(predicted.rate_in_camera * 1e-3)
        * predicted.direction_in_camera;
    let moved = Unit::new_normalize(pose.translation.vector + velocity * 1e-3);
    assert!(later.angle(&moved) < 2e-6);
}

#[test]
fn predictions_that_are_none_give_no_view() {
    let body = squares("alpha", 0.0625, 0.05, 0);
    let (covariance, still) = (Matrix3::identity(), Vector3::zeros());
    for range in [0.0, 0.01, f64::NAN, f64::INFINITY] {
        let pose = Isometry3::translation(range, 0.0, 0.0);
        assert_eq!(PredictedNeighbour::from_pose(0, &body, &pose, &covariance, &still), None);
    }
    let broken = PredictedNeighbour { deviation_rad: f64::NAN, ..neighbour(0) };
    assert_eq!(roi_view(&broken, RESOLUTION), None);
    let plan =
        planner(PlanOrder::Roi, RoiOptions::new(RESOLUTION)).plan(&Searched::new(12, 0), &[broken]);
    assert_eq!((plan.views.len(), plan.view_budget), (12, 2));
}

#[test]
fn options_out_of_range_are_named() {
    let good = RoiOptions::new(RESOLUTION);
    let with = |roi| {
        Planner::new(
            PlanOrder::Roi,
            Partition::icosahedron(),
            Partition::icosahedron().views(0.1, RESOLUTION).unwrap(),
            roi,
        )
    };
    for (roi, name) in [
        (RoiOptions { partitions_per_frame: 0, ..good }, "partitions_per_frame"),
        (RoiOptions::new(f64::NAN), "pixels_per_radian"),
        (RoiOptions::new(0.5), "pixels_per_radian"),
    ] {
        assert!(with(roi).unwrap_err().to_string().contains(name));
    }
    let missing = Planner::new(PlanOrder::Greedy, Partition::icosahedron(), Vec::new(), good);
    assert_eq!(missing.unwrap_err(), PlannerError::Views { views: 0, partitions: 12 });
}

#[test]
fn proposals_come_before_the_tiles_while_a_target_is_not_tracked() {
    let planner = fine_planner(2).with_proposals(2, 3);
    let searched = planner.nothing_searched();
    let kinds = |tracked: usize| -> String {
        let neighbours: Vec<PredictedNeighbour> = (0..tracked).map(neighbour).collect();
        let plan = planner.plan(&searched, &neighbours);
        let letter = |planned: &SearchView| match planned.purpose {
            Purpose::Roi(_) => 'g',
            Purpose::Proposal => 'p',
            Purpose::Partition(_) | Purpose::HighResolution(_) => 't',
        };
        plan.views[..plan.view_budget].iter().map(letter).collect()
    };
    assert_eq!([kinds(0), kinds(1), kinds(2)], ["ppptt", "gppptt", "ggtt"]);
}

#[test]
fn an_exhaustive_search_has_its_proposals_behind_all_tiles() {
    let partition = Partition::icosahedron();
    let views = partition.views(0.1, 611.0).unwrap();
    let roi = RoiOptions::new(611.0);
    let planner = Planner::new(PlanOrder::Exhaustive, partition, views, roi).unwrap();
    let planner = planner.with_proposals(2, 3);
    let plan = planner.plan(&planner.nothing_searched(), &[]);
    assert_eq!((plan.views.len(), plan.view_budget, plan.stop_rule), (15, 15, StopRule::All));
    let is_proposal = |view: &SearchView| view.purpose == Purpose::Proposal;
    assert!(plan.views[12..].iter().all(is_proposal) && !plan.views[..12].iter().any(is_proposal));
}

#[test]
fn a_tile_comes_before_the_proposals_after_four_frames_without_one() {
    let planner = fine_planner(2).with_proposals(2, 3);
    let mut searched = planner.nothing_searched();
    let first = |searched: &Searched| planner.plan(searched, &[]).views[0].purpose;
    for frame in 0..3 {
        searched.record(frame, Purpose::Proposal);
        assert_eq!(first(&searched), Purpose::Proposal, "frame {frame}");
    }
    searched.record(3, Purpose::Proposal);
    let tile = first(&searched);
    assert!(matches!(tile, Purpose::Partition(_)), "{tile:?}");
    searched.record(4, tile);
    assert_eq!(first(&searched), Purpose::Proposal);
}
