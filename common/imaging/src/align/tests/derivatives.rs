//! The model's derivatives against differences of the model.

use super::*;

/// The model of one facet at a pixel; `None` where it does not face the camera.
fn modelled(
    print: &BodyPrint,
    state: &State,
    pinhole: &Pinhole,
    at: Vector2<f64>,
    facet: usize,
    fixed_blur: Option<&Scene<'_>>,
) -> Option<Modelled> {
    let fresh = Scene::of(print, state, pinhole, 0.0, 0.5);
    fresh.facet(0, facet)?;
    let scene = match fixed_blur {
        None => fresh,
        Some(fixed) => {
            let [mut seen, blurred] = [fresh.halves, fixed.halves.clone()];
            seen[0].blurred.clone_from(&blurred[0].blurred);
            Scene { halves: seen, ..fresh }
        }
    };
    Some(model(
        &scene,
        state,
        0,
        std::iter::once(facet),
        std::iter::empty(),
        0.3,
        &pinhole.direction(at),
    ))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    /// Derivatives by pose and levels against differences of the model. The point spread on each
    /// facet is held fixed, as in a step of the solver.
    #[test]
    fn derivatives_are_those_of_the_model(
        euler in prop::array::uniform3(-3.0..3.0f64),
        range_m in 0.5..3.0f64,
        across in prop::array::uniform2(-0.7..0.7f64),
        path in prop::array::uniform2(-6.0..6.0f64),
        response in prop::option::of(-0.7..0.7f64),
    ) {
        let print = print_of(&body(0));
        let pose = Isometry3::from_parts(
            Translation3::new(0.05 * range_m, -0.03 * range_m, range_m),
            UnitQuaternion::from_euler_angles(euler[0], euler[1], euler[2]),
        );
        let pinhole = Pinhole { focal_px: 611.0, centre_px: Vector2::new(50.0, 50.0) };
        let state = State {
            levels: (0..print.facets.len()).map(|k| [0.5 + 0.01 * k as f64, 0.04]).collect(),
            response: response.unwrap_or(0.0),
            ..State::new(&print, pose, &Prior::new(1.0, Vector2::from(path), None, 1.0))
        };
        let visible = visible_facets(&print, &pose, &pinhole);
        for (index, facet) in visible.iter().enumerate() {
            let printed = &print.facets[index];
            let camera_from_facet = pose * printed.markers_from_facet;
            let middle = camera_from_facet * Point3::from(printed.middle().coords.push(0.0));
            let cosine = (camera_from_facet * Vector3::z()).dot(&middle.coords.normalize());
            if facet.is_none() || cosine < 0.4 { continue }
            let point = camera_from_facet * Point3::new(across[0] * 0.025, across[1] * 0.025, 0.0);
            let at = pinhole.project(&point.coords).expect("ahead");
            let base = Scene::of(&print, &state, &pinhole, 0.0, 0.5);
            let model = |state: &State| modelled(&print, state, &pinhole, at, index, Some(&base)).expect("seen");
            let now = model(&state);
            let largest = now.by_common[..6].iter().fold(0.0f64, |a, b| a.max(b.abs()));
            for k in 0..6 {
                let step = 5e-5;
                let mut change = [0.0; 6];
                change[k] = step;
                let shift = Vector3::new(change[0], change[1], change[2]);
                let turn = Vector3::new(change[3], change[4], change[5]);
                let at_pose = |pose| model(&State { patch_from_markers: pose, ..state.clone() }).radiance;
                let numeric = (at_pose(moved(&pose, shift, turn)) - at_pose(moved(&pose, -shift, -turn))) / (2.0 * step);
                let limit = 0.02 * (numeric.abs() + largest) + 0.5;
                prop_assert!((numeric - now.by_common[k]).abs() < limit, "facet {index}, unknown {k}: {numeric} and {}", now.by_common[k]);
            }
            let bent = model(&State { response: state.response + 0.01, ..state.clone() }).radiance;
            let numeric = (bent - now.radiance) / 0.01;
            prop_assert!((numeric - now.by_common[super::super::state::RESPONSE]).abs() < 1e-9, "facet {index}: {numeric}");
            if response.is_some() {
                // Levels enter the bend twice, and squared.
                let (_, by_white, by_black) = now.levels()[0];
                for (level, by) in [by_white, by_black].into_iter().enumerate() {
                    let at = |change: f64| {
                        let mut other = state.clone();
                        other.levels[index][level] += change;
                        model(&other).radiance
                    };
                    let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
                    prop_assert!((numeric - by).abs() < 1e-3, "facet {index}, level {level}: {numeric} and {by}");
                }
                continue;
            }
            let [white, black] = state.levels[index];
            let (_, by_white, by_black) = now.levels()[0];
            // Radiance is linear in both levels, because the code blur is zero here.
            for (level, by) in [by_white, by_black].into_iter().enumerate() {
                let mut brighter = state.clone();
                brighter.levels[index][level] += 0.25;
                let numeric = (model(&brighter).radiance - now.radiance) / 0.25;
                prop_assert!((numeric - by).abs() < 1e-6, "facet {index}, level {level}: {numeric} and {by}");
            }
            let radiance = white * by_white + black * by_black;
            // Where the pixel sees the facet.
            let place = across.map(|share| share * 0.025);
            for (by, place) in now.by_gradient.iter().zip(place) {
                prop_assert!((by - radiance * place).abs() < 1e-9, "facet {index}: {by}");
            }
        }
    }
}

proptest! {
    /// Derivatives by the path against differences. The Gaussians of its parts stay.
    #[test]
    fn derivatives_by_the_path_are_those_of_the_facet(
        across in prop::array::uniform2(-0.035..0.035f64),
        path in prop::array::uniform2(-0.02..0.02f64),
        parts in 2..6u8,
    ) {
        let print = print_of(&body(0));
        let facet = print.facets.iter().find(|facet| facet.cells.is_some()).expect("a marker");
        let spread = Matrix2::new(4.0, 1.5, 1.5, 3.0) * 1e-6;
        let (at, path) = (Vector2::from(across), Vector2::from(path));
        let shares = |path| {
            let blurred = BlurredFacet::new(facet, &spread, &path, parts);
            [blurred.coverage(at), blurred.black(at)]
        };
        let now = shares(path);
        for axis in 0..2 {
            let mut change = Vector2::zeros();
            change[axis] = 2e-4;
            let (more, less) = (shares(path + change), shares(path - change));
            for (k, share) in now.iter().enumerate() {
                let numeric = (more[k].value - less[k].value) / 4e-4;
                let by = share.by_path[axis];
                prop_assert!((numeric - by).abs() < 0.5 + 0.02 * by.abs(), "{k} {axis}: {numeric} and {by}");
            }
        }
    }
}
