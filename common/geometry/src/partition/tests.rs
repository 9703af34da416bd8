#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use crate::fixtures::BEST_KNOWN_DEG;
use crate::random::Chance;
use proptest::prelude::*;

const PIXELS_PER_RADIAN: f64 = 3840.0 / std::f64::consts::TAU;
/// A marker of 5 cm at 40 cm.
const MARGIN_RAD: f64 = 0.125;

fn stored() -> impl Iterator<Item = Partition> {
    STORED.map(|count| Partition::stored(count).expect("all are stored"))
}

/// Largest angle, radians, between any point of the sphere and the direction nearest to it, from
/// the definition alone: each triple that has all others on one side is a hole. O(N^4).
fn covering_radius_rad(directions: &[Ray]) -> f64 {
    let mut radius: f64 = 0.0;
    for (a, p) in directions.iter().enumerate() {
        for (b, q) in directions.iter().enumerate().skip(a + 1) {
            for r in &directions[b + 1..] {
                let Some(normal) = (q.into_inner() - p.into_inner())
                    .cross(&(r.into_inner() - p.into_inner()))
                    .try_normalize(1e-12)
                else {
                    continue;
                };
                let offset = normal.dot(p);
                let side = |d: &Ray| normal.dot(d) - offset;
                if directions.iter().all(|d| side(d) < 1e-9) {
                    radius = radius.max(offset.clamp(-1.0, 1.0).acos());
                } else if directions.iter().all(|d| side(d) > -1e-9) {
                    radius = radius.max((-offset).clamp(-1.0, 1.0).acos());
                }
            }
        }
    }
    radius
}

#[test]
fn stored_circles_leave_no_gap_and_smaller_ones_do() {
    for partition in stored() {
        let theta = partition.covering_diameter_rad();
        let proved = 2.0 * covering_radius_rad(partition.directions());
        assert!((theta - proved).abs() < 1e-9, "{}: {theta} {proved}", partition.len());
        assert!(partition.directions().iter().all(|d| (d.norm() - 1.0).abs() < 1e-14));
    }
}

#[test]
fn stored_diameters_are_the_best_known() {
    for (count, known_deg) in BEST_KNOWN_DEG {
        let theta_deg = Partition::stored(count).unwrap().covering_diameter_rad().to_degrees();
        assert!(theta_deg < known_deg + 1e-3, "{count}: {theta_deg} against {known_deg}");
    }
    // One circle more never needs larger ones.
    let thetas: Vec<_> = stored().map(|partition| partition.covering_diameter_rad()).collect();
    assert!(thetas.windows(2).all(|pair| pair[0] > pair[1]));
}

#[test]
fn what_is_stored_is_what_is_found() {
    for count in [5, 12, 16] {
        let found = Partition::compute(Method::Covering, count, STORED_SEED).unwrap();
        assert_eq!(Some(found), Partition::stored(count), "{count}");
    }
}

#[test]
fn the_search_finds_the_icosahedron() {
    let facets = hull(&covering::directions(12, 5)).unwrap();
    let theta_deg = 2.0 * covering_cosine(&facets).acos().to_degrees();
    assert!((theta_deg - 74.7547).abs() < 1e-4, "{theta_deg}");
}

#[test]
fn twelve_are_the_icosahedron_as_it_was_turned() {
    let partition = Partition::icosahedron();
    let vertices = icosahedron_vertices();
    assert!(
        partition.directions().iter().zip(&vertices).all(|(p, q)| (p.as_ref() - q).norm() < 1e-14)
    );
    // A facet's circumcentre is that far from its corners and nearer to none.
    let hole = Unit::new_normalize(Vector3::new(1.0, 1.0, 1.0));
    let nearest = &partition.directions()[partition.nearest(&hole)];
    assert!((2.0 * nearest.angle(&hole) - partition.covering_diameter_rad()).abs() < 1e-9);
}

#[test]
fn the_order_goes_from_ahead_to_behind() {
    for partition in stored() {
        let directions = partition.directions();
        assert!(directions.windows(2).all(|pair| pair[0].x >= pair[1].x - 1e-6));
        if partition.len() != 12 {
            assert!(directions[0].angle(&Vector3::x_axis()) < 1e-7);
        }
    }
}

/// FNV-1a over the bits of all coordinates.
fn fingerprint(partition: &Partition) -> u64 {
    let numbers = partition.directions().iter().flat_map(|d| [d.x, d.y, d.z]);
    let bytes = numbers.flat_map(|number| number.to_bits().to_le_bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

#[test]
fn a_seed_means_one_partition_everywhere() {
    for (method, count, seed, wanted) in [
        (Method::Covering, 5, 3, 0x34cf_f8ae_48c0_d287),
        (Method::Covering, 100, 1, 0x7a05_db77_be72_580b),
        (Method::Paper, 12, 1, 0xbbd4_fc74_c679_a9c1),
        (Method::Paper, 33, 9, 0x8192_13b7_3e8e_b370),
    ] {
        let partition = Partition::compute(method, count, seed).unwrap();
        assert_eq!(Partition::compute(method, count, seed).unwrap(), partition);
        // Pinned: another machine must find the same bits.
        assert_eq!(fingerprint(&partition), wanted, "{method:?} {count} {seed}");
    }
}

#[test]
fn the_papers_method_covers_but_with_larger_circles() {
    for count in [6, 12, 13, 24] {
        let spread = Partition::compute(Method::Paper, count, 1).unwrap();
        let theta = spread.covering_diameter_rad();
        assert!((theta - 2.0 * covering_radius_rad(spread.directions())).abs() < 1e-9);
        let best = Partition::stored(count).unwrap().covering_diameter_rad();
        assert!(theta > best - 1e-6, "{count}: {theta} against {best}");
    }
}

#[test]
fn squares_are_no_larger_than_round_the_circles() {
    for partition in stored() {
        for margin_deg in [0.0, 2.0, 7.15, 15.0, 25.0] {
            let margin_rad = f64::to_radians(margin_deg);
            let round = partition.covering_diameter_rad() + margin_rad;
            if let Ok(field) = partition.field_rad(margin_rad) {
                assert!(field <= round && field > 0.8 * round, "{} {margin_deg}", partition.len());
            } else {
                assert!(round > LARGEST_FIELD_RAD);
            }
        }
    }
}

/// Whether one view holds the disc wholly: its rim is inside all four sides.
fn is_held(views: &[View], middle: &Vector3<f64>, half_rad: f64) -> bool {
    let helper = if middle.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
    let across = middle.cross(&helper).normalize();
    let down = middle.cross(&across);
    let (sin, cos) = half_rad.sin_cos();
    let rim: Vec<Ray> = (0..60)
        .map(|k| {
            let (s, c) = (f64::from(k) * PI / 30.0).sin_cos();
            Unit::new_normalize(middle * cos + (across * c + down * s) * sin)
        })
        .collect();
    views.iter().any(|view| rim.iter().all(|ray| view.holds(ray, 0.0)))
}

#[test]
fn a_marker_anywhere_lies_wholly_in_a_view() {
    for partition in stored() {
        for margin_deg in [0.0, 3.0, 7.15, 12.0, 20.0] {
            let margin_rad = f64::to_radians(margin_deg);
            let Ok(views) = partition.views(margin_rad, PIXELS_PER_RADIAN) else {
                assert!(partition.len() <= 5 && margin_deg > 3.0);
                continue;
            };
            let points = vectors(partition.directions());
            let mut random = Chance::stream(11, partition.len() as u64);
            let mut middles: Vec<_> = (0..300).map(|_| random.portable_direction()).collect();
            // Where it is hardest: the holes, the middles between neighbours, and the worst points
            // that the bound was found at.
            let squares = partition.squares();
            let bound =
                half_field(&squares, &points, &partition.facets, margin_rad / 2.0, 1e-4).unwrap();
            middles.extend(bound.worst);
            for facet in &partition.facets {
                middles.push(facet.normal);
                let [a, b, _] = facet.corners.map(|corner| points[corner]);
                middles.push((a + b).normalize());
            }
            for middle in middles {
                assert!(
                    is_held(&views, &middle, margin_rad / 2.0),
                    "{} views, margin {margin_deg}, at {middle}",
                    partition.len()
                );
            }
        }
    }
}

#[test]
fn no_smaller_squares_do() {
    for count in [5, 6, 12, 24, 32] {
        let partition = Partition::stored(count).unwrap();
        let half_rad = MARGIN_RAD / 2.0;
        let field = partition.field_rad(MARGIN_RAD).unwrap();
        let points = vectors(partition.directions());
        let squares = partition.squares();
        let bound = half_field(&squares, &points, &partition.facets, half_rad, 5e-6).unwrap();
        let worst = bound
            .worst
            .iter()
            .map(|p| squares::needed_by_best(&squares, p, half_rad.sin()).atan())
            .fold(0.0, f64::max);
        assert!(field - 2.0 * worst < 2.5e-5, "{count}: {field} {worst}");
    }
}

#[test]
fn fields_are_found_fast_enough_to_be_found_by_each_process() {
    for partition in stored() {
        for margin_deg in [0.0f64, 7.15] {
            let points = vectors(partition.directions());
            let half_rad = margin_deg.to_radians() / 2.0;
            let squares = partition.squares();
            let bound =
                half_field(&squares, &points, &partition.facets, half_rad, TOLERANCE_RAD).unwrap();
            assert!(bound.triangles < 1_000_000, "{}: {}", partition.len(), bound.triangles);
        }
    }
}

#[test]
fn neighbours_on_the_icosahedron_are_five() {
    let partition = Partition::icosahedron();
    let directions = partition.directions();
    for from in 0..12 {
        let near = (0..12).filter(|&to| {
            let distance = directions[from].angle(&directions[to]).to_degrees();
            (distance - 63.4349).abs() < 1e-3
        });
        assert_eq!(near.count(), 5);
    }
}

#[test]
fn views_have_the_spheres_resolution() {
    let partition = Partition::icosahedron();
    let views = partition.views(MARGIN_RAD, PIXELS_PER_RADIAN).unwrap();
    assert!(views.iter().all(|view| view.focal_px == PIXELS_PER_RADIAN));
    let field = partition.field_rad(MARGIN_RAD).unwrap();
    assert!(views.iter().all(|view| {
        let excess = view.field_rad() - field;
        (0.0..3.0 / PIXELS_PER_RADIAN).contains(&excess)
    }));
    for (view, direction) in views.iter().zip(partition.directions()) {
        assert!(view.direction_in_camera().angle(direction) < 1e-7);
    }
}

#[test]
fn impossible_views_are_refused_with_the_cure() {
    let partition = Partition::icosahedron();
    for (margin, resolution) in
        [(-0.1, 600.0), (2.0, 600.0), (f64::NAN, 600.0), (0.1, 0.0), (0.1, f64::NAN)]
    {
        assert!(partition.views(margin, resolution).is_err(), "{margin} {resolution}");
    }
    let four = Partition::stored(4).unwrap();
    let error = four.views(MARGIN_RAD, 600.0).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("largest margin of so many is 3."), "{text}");
    assert!(text.contains("the fewest views for this margin are 5"), "{text}");
    let PartitionError::Field { largest_margin_rad, .. } = error else { panic!("{text}") };
    assert!(four.views(largest_margin_rad.unwrap(), 600.0).is_ok());
    assert!(Partition::stored(5).unwrap().views(MARGIN_RAD, 600.0).is_ok());
    let text = partition.views(2.4, 600.0).unwrap_err().to_string();
    assert!(text.contains("no number of views does"), "{text}");
}

#[test]
fn impossible_numbers_are_refused() {
    for count in [0, 3, 129] {
        let error = Partition::of(Method::Covering, count, 1).unwrap_err();
        assert_eq!(error, PartitionError::Count { count });
    }
    assert!(Partition::new(vec![Vector3::x_axis(); 4], vec![0.0; 4]).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    #[test]
    fn whatever_is_as_wide_as_the_margin_lies_wholly_in_a_view(
        seed in 0u64..1_000_000,
        count in 6usize..=32,
        margin_deg in 0.0..25.0f64,
    ) {
        let margin_rad = margin_deg.to_radians();
        let views = Partition::stored(count).unwrap().views(margin_rad, PIXELS_PER_RADIAN).unwrap();
        let middle = Chance::stream(seed, 0).direction();
        prop_assert!(is_held(&views, &middle, margin_rad / 2.0));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4))]
    #[test]
    fn whatever_is_computed_covers(count in 33usize..=60, seed in 0u64..1000, is_paper: bool) {
        let method = if is_paper { Method::Paper } else { Method::Covering };
        let partition = Partition::compute(method, count, seed).unwrap();
        let proved = 2.0 * covering_radius_rad(partition.directions());
        prop_assert!((partition.covering_diameter_rad() - proved).abs() < 1e-9);
        let views = partition.views(MARGIN_RAD, PIXELS_PER_RADIAN).unwrap();
        let mut random = Chance::stream(seed, 1);
        for _ in 0..50 {
            prop_assert!(is_held(&views, &random.portable_direction(), MARGIN_RAD / 2.0));
        }
    }
}
