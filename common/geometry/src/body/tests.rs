#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::Vector3;
use proptest::prelude::*;

use super::solid::Solid;
use super::*;

fn bodies(list: Vec<Body>) -> Result<Bodies, BodiesError> {
    Bodies::new("DICT_5X5_250".into(), list)
}

#[test]
fn the_preset_is_the_published_solid() {
    let body = squares("alpha", 0.0625, 0.05, 0);
    assert_eq!(body.markers.len(), 17);
    // Corner values of an independently made body of the same size (its first two markers).
    let top = &body.markers[0].corners[0];
    assert!((top - Point3::new(0.025, 0.025, 0.075_444_174)).norm() < 1e-8);
    let ring = &body.markers[1].corners[2];
    assert!((ring - Point3::new(0.071_024_756, 0.025, 0.035_669_417)).norm() < 1e-8);
    for marker in &body.markers {
        assert!(marker.normal().dot(&marker.centre().coords.normalize()) > 0.999_999);
        assert!((marker.side() - 0.05).abs() < 1e-12);
    }
}

#[test]
fn shared_ids_are_all_named() {
    let error = bodies(vec![squares("a", 0.06, 0.05, 0), squares("b", 0.06, 0.05, 15)])
        .expect_err("ids 15 and 16 are shared")
        .to_string();
    assert!(error.contains("id 15 belongs to 'a' and to 'b'"), "{error}");
    assert!(error.contains("id 16 belongs"), "{error}");
}

#[test]
fn inward_and_crooked_markers_are_refused() {
    let mut body = squares("a", 0.06, 0.05, 0);
    body.markers[3].corners.reverse();
    body.markers[4].corners[0].x += 0.02;
    let error = bodies(vec![body]).expect_err("two markers are wrong").to_string();
    assert!(error.contains("marker 3 of body 'a' looks inwards"), "{error}");
    assert!(error.contains("marker 4 of body 'a' is no square"), "{error}");
}

#[test]
fn owners_are_found_and_strangers_not() {
    let bodies =
        bodies(vec![squares("a", 0.06, 0.05, 0), squares("b", 0.06, 0.05, 17)]).expect("fine");
    assert_eq!((bodies.owner(16), bodies.owner(17), bodies.owner(34)), (Some(0), Some(1), None));
}

#[test]
fn folded_squares_are_refused() {
    let mut body = squares("a", 0.06, 0.05, 0);
    let out = body.markers[2].normal() * 0.004;
    body.markers[2].corners[3] += out;
    let error = bodies(vec![body]).expect_err("a corner is bent up").to_string();
    assert!(error.contains("marker 2 of body 'a' is not flat"), "{error}");
}

/// What every body's facets have to be.
fn assert_sound(body: &Body) {
    for (index, facet) in body.facets().iter().enumerate() {
        let count = facet.outline.len();
        assert!((facet.normal.norm() - 1.0).abs() < 1e-9);
        for k in 0..count {
            let at = |n: usize| facet.outline[(k + n) % count];
            assert!(facet.normal.dot(&(at(1) - at(0))).abs() < 1e-9, "facet {index} is not flat");
            let turn = (at(1) - at(0)).cross(&(at(2) - at(1)));
            assert!(turn.dot(&facet.normal) > 0.0, "facet {index} does not turn left at {k}");
        }
        assert!(facet.normal.dot(&facet.outline[0].coords) >= 0.0, "facet {index} looks inwards");
    }
    for (k, marker) in body.markers.iter().enumerate() {
        let holders = body.facets().iter().filter(|facet| facet.holds(marker, 1e-9));
        let carried: Vec<_> = holders.map(|facet| facet.marker).collect();
        assert_eq!(carried, [Some(k)], "marker {} of {}", marker.id, body.name);
    }
}

#[test]
fn the_preset_has_all_26_facets() {
    let body = squares("alpha", 0.08, 0.05, 0);
    let count = |sides: usize, is_blank: bool| {
        let facets = body.facets().iter();
        facets.filter(|f| f.outline.len() == sides && f.marker.is_none() == is_blank).count()
    };
    assert_eq!((count(4, false), count(4, true), count(3, true)), (17, 1, 8));
    assert_eq!(body.facets().len(), 26);
    for facet in body.facets() {
        let next = facet.outline.iter().cycle().skip(1);
        for (from, to) in facet.outline.iter().zip(next) {
            assert!(((to - from).norm() - 0.08).abs() < 1e-12);
        }
    }
    let bottom = body.facets().iter().find(|facet| facet.normal.z < -0.99).unwrap();
    assert_eq!((bottom.outline.len(), bottom.marker), (4, None));
    assert_sound(&body);
}

#[test]
fn the_flown_body_is_cut_below_its_belt() {
    let body = truncated("flown", &TruncatedSizes::default(), 17);
    let ids: Vec<u32> = body.markers.iter().map(|marker| marker.id).collect();
    assert_eq!(ids, (17..34).collect::<Vec<_>>());
    let sides: Vec<usize> = body.facets().iter().map(|facet| facet.outline.len()).collect();
    assert_eq!(sides[..13], [4; 13]);
    assert_eq!(sides[13..], [3, 3, 3, 3, 8]);
    assert_eq!(body.facets()[17].marker, None);
    assert!((body.facets()[17].normal + Vector3::z()).norm() < 1e-9, "the mount is below");
    assert_eq!(body.facets()[12].normal, Vector3::z(), "the 13th is on top");
    // Small markers lie towards the belt, where their triangle is wider, and whole on it.
    for (marker, facet) in body.markers[13..].iter().zip(&body.facets()[13..]) {
        assert!((marker.side() - 0.023_283).abs() < 1e-12);
        let middle = facet.outline.iter().map(|p| p.coords).sum::<Vector3<f64>>() / 3.0;
        let aside = marker.centre().coords - middle;
        assert!((aside.norm() - 0.003_901).abs() < 1e-9 && aside.z < 0.0, "{aside}");
        let edge = (facet.outline[1] - facet.outline[0]).norm();
        assert!((edge - 0.075).abs() < 1e-12);
        let centre = marker.centre();
        let scale = (0.023_283 + 0.010) / 0.023_283;
        let white = marker.corners.map(|corner| centre + (corner - centre) * scale);
        let white = Marker { id: marker.id, corners: white };
        assert!(facet.holds(&white, 1e-9), "5 mm of white all round");
    }
    assert_sound(&body);
}

#[test]
fn a_cube_has_five_markers_and_a_plate_one_facet() {
    let body = cube("box", 0.1, 0.08, 3);
    let normals: Vec<_> = body.markers.iter().map(|marker| marker.normal()).collect();
    let axes = [Vector3::z(), Vector3::x(), Vector3::y(), -Vector3::x(), -Vector3::y()];
    assert!(normals.iter().zip(axes).all(|(normal, axis)| (normal - axis).norm() < 1e-9));
    assert!(body.markers.iter().all(|m| (m.centre().coords.norm() - 0.05).abs() < 1e-12));
    assert_eq!((body.facets().len(), body.facets()[5].marker), (6, None));
    assert_sound(&body);

    let body = plate("sign", 0.3, 0.2, 7);
    assert_eq!((body.facets().len(), body.markers[0].id), (1, 7));
    // Its top left is forward and to the left, seen from above.
    assert!((body.markers[0].corners[0] - Point3::new(0.1, 0.1, 0.0)).norm() < 1e-12);
    assert_sound(&body);
}

/// The JSON form of a body, with more keys for each body.
fn json(body: &Body, more: &str) -> String {
    let markers: Vec<_> = body
        .markers
        .iter()
        .map(|marker| {
            let corners = marker.corners.map(|corner| [corner.x, corner.y, corner.z]);
            serde_json::json!({"id": marker.id, "corners": corners, "turn_deviation_rad": 0.1})
        })
        .collect();
    let markers = serde_json::Value::from(markers);
    format!(
        r#"{{"dictionary": "DICT_5X5_250", "bodies": {{"{}": {{"markers": {markers}{more}}}}}}}"#,
        body.name
    )
}

#[test]
fn a_file_of_the_preset_has_the_presets_facets() {
    let preset = squares("alpha", 0.0625, 0.05, 0);
    let read = Bodies::from_json(&json(&preset, "")).unwrap();
    let read = read.get(0).unwrap();
    assert_sound(read);
    assert_eq!(read.facets().len(), 26);
    for facet in preset.facets() {
        let is_same = |other: &&Facet| {
            other.marker == facet.marker
                && (other.normal - facet.normal).norm() < 1e-6
                && other.outline.len() == facet.outline.len()
                && (facet.outline.iter())
                    .all(|p| other.outline.iter().any(|q| (q - p).norm() < 1e-6))
        };
        assert_eq!(read.facets().iter().filter(is_same).count(), 1, "{facet:?}");
    }
    // Wider white, of the whole body, reaches as far as it says.
    let plate = Body::new("plate", preset.markers[5..6].to_vec());
    let read = Bodies::from_json(&json(&plate, r#", "quiet_zone_m": 0.01"#)).unwrap();
    let outline = &read.get(0).unwrap().facets()[0].outline;
    assert!(((outline[1] - outline[0]).norm() - 0.07).abs() < 1e-9);
}

#[test]
fn bodies_without_a_hull_have_their_own_squares_alone() {
    let markers = squares("alpha", 0.0625, 0.05, 0).markers;
    let plate = Body::new("plate", markers[5..6].to_vec());
    assert_eq!(plate.facets().len(), 1);
    assert_sound(&plate);

    let mut hollow = markers.clone();
    let inwards = hollow[1].normal() * -0.02;
    hollow[1].corners.iter_mut().for_each(|corner| *corner += inwards);
    let hollow = Body::new("hollow", hollow);
    assert_eq!(hollow.facets().len(), 17);
    assert_sound(&hollow);

    // Two on one side of a box: two squares instead of that side.
    let cube = |id: u32, normal: Vector3<f64>, across: Vector3<f64>, aside: f64| {
        let up = normal.cross(&across);
        let centre = normal * 0.1 + across * aside;
        let at = |x: f64, y: f64| Point3::from(centre + (across * x + up * y) * 0.02);
        Marker { id, corners: [at(-1.0, 1.0), at(1.0, 1.0), at(1.0, -1.0), at(-1.0, -1.0)] }
    };
    let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
    let sides =
        [cube(0, x, y, -0.05), cube(1, x, y, 0.05), cube(2, z, x, 0.0), cube(3, -z, x, 0.0)];
    let boxed = Body::new("box", sides.to_vec());
    let sides: Vec<_> = boxed.facets().iter().map(|f| (f.marker, f.outline.len())).collect();
    assert_eq!(sides[..4], [0, 1, 2, 3].map(|k| (Some(k), 4)));
    assert!(sides[4..].iter().all(|(marker, _)| marker.is_none()));
    assert_sound(&boxed);
}

#[test]
fn facets_may_be_given_and_are_checked() {
    let preset = squares("a", 0.0625, 0.05, 0);
    let outlines = |facets: &[Facet]| {
        let corners = |facet: &Facet| facet.outline.iter().map(|p| [p.x, p.y, p.z]).collect();
        let list: Vec<Vec<[f64; 3]>> = facets.iter().map(corners).collect();
        format!(r#", "facets": {}"#, serde_json::json!(list))
    };
    // Markers a millimetre off are still on their facets.
    let mut glued = preset.clone();
    let shift = Vector3::new(0.001, -0.001, 0.0005);
    glued.markers[7].corners.iter_mut().for_each(|corner| *corner += shift);
    let read = Bodies::from_json(&json(&glued, &outlines(preset.facets()))).unwrap();
    assert_eq!(read.get(0).unwrap().facets().len(), 26);
    assert_eq!(read.get(0).unwrap().facets()[7].marker, Some(7));

    let refused = |facets: &[Facet]| {
        Bodies::from_json(&json(&preset, &outlines(facets))).unwrap_err().to_string()
    };
    let error = refused(&preset.facets()[1..]);
    assert!(error.contains("marker 0 of body 'a' lies on none"), "{error}");
    let mut facets = preset.facets().to_vec();
    let out = facets[4].normal * 0.01;
    facets[4].outline[0] += out;
    facets[19].outline.truncate(2);
    let middle = facets[3].outline.iter().map(|p| p.coords).sum::<Vector3<f64>>() / 4.0;
    facets[3].outline.insert(1, Point3::from(middle));
    facets[5].outline.swap(0, 1);
    let error = refused(&facets);
    for wanted in [
        "4 of body 'a' is not flat",
        "19 of body 'a' has 2",
        "3 of body 'a' is not convex",
        "5 of body 'a' has no area",
    ] {
        assert!(error.contains(&format!("facet {wanted}")), "{error}");
    }
    let mut wide = preset.facets().to_vec();
    let middle = wide[0].outline.iter().map(|p| p.coords).sum::<Vector3<f64>>() / 4.0;
    wide[0].outline.iter_mut().for_each(|p| *p = Point3::from(middle + (p.coords - middle) * 9.0));
    let twice = {
        let mut twice = preset.clone();
        let aside = Vector3::new(0.1, 0.0, 0.0);
        twice.markers[1].corners = twice.markers[0].corners.map(|corner| corner + aside);
        twice
    };
    let error = Bodies::from_json(&json(&twice, &outlines(&wide))).unwrap_err().to_string();
    assert!(error.contains("markers 0 and 1 of body 'a' lie on one facet"), "{error}");
    let error = Bodies::from_json(&json(&preset, r#", "quiet_zone_m": -0.01"#)).unwrap_err();
    assert!(error.to_string().contains("quiet_zone_m of body 'a' is -0.01"), "{error}");
}

#[test]
fn hundreds_of_markers_are_refused_at_once() {
    let one = squares("a", 0.06, 0.05, 0).markers.remove(0);
    let markers = (0..5000).map(|id| Marker { id, ..one.clone() });
    let error = bodies(vec![Body::new("a", markers.collect())]).unwrap_err().to_string();
    assert!(error.contains("body 'a' has 5000 markers; at most 100 are allowed"), "{error}");
}

proptest! {
    #[test]
    fn presets_are_sound_at_any_size(edge in 0.01..2.0f64, share in 0.1..1.0f64) {
        assert_sound(&squares("alpha", edge, share * edge, 3));
        assert_sound(&cube("alpha", edge, share * edge, 3));
        assert_sound(&plate("alpha", edge, share * edge, 3));
        let sizes = TruncatedSizes {
            edge_m: edge,
            marker_m: share * edge,
            small_marker_m: 0.4 * share * edge,
            small_shift_m: 0.05 * edge,
        };
        assert_sound(&truncated("alpha", &sizes, 3));
    }

    #[test]
    fn a_hull_holds_its_points(steps in prop::collection::vec(prop::array::uniform3(-2i8..=2), 6..20)) {
        // On a grid, so that many lie in one plane.
        let points = steps.iter().map(|step| Point3::from(step.map(|x| 0.5 * f64::from(x))));
        let solid = Solid::hull(points.collect(), &[]);
        prop_assume!(!solid.faces.is_empty() && !solid.is_flat());
        let mut ends = 0;
        for face in &solid.faces {
            prop_assert!(solid.corners.iter().all(|p| face.height(p) < 1e-9));
            prop_assert!(face.corners.iter().all(|p| face.height(p).abs() < 1e-9));
            ends += face.corners.len();
        }
        // Euler: corners - edges + faces = 2, each edge between two faces.
        let is_on = |p: &&Point3<f64>| solid.faces.iter().any(|face| face.corners.contains(p));
        let corners = solid.corners.iter().filter(is_on).count();
        prop_assert_eq!(corners + solid.faces.len(), ends / 2 + 2);
    }
}
