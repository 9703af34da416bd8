//! A swarm as a map of characters, seen from above.

use flockeye_peer::DronePlace;

/// Characters in a row, and rows. A character is about twice as high as wide.
const COLUMNS: usize = 61;
const ROWS: usize = 21;
/// Minimum distance from the middle to the upper edge, metres.
const LEAST_M: f64 = 1.0;

/// Map of the drones from above: forward is up, left is left. `own` is the middle.
pub(crate) fn map(own: &str, places: &[DronePlace]) -> String {
    let flat = |place: &DronePlace| {
        let position = place.own_from_drone.a_from_b.translation.vector;
        (position.x, position.y)
    };
    let farthest = places.iter().map(flat).map(|(x, y)| x.abs().max(y.abs()));
    // Rounded scale, metres, so that the map does not change with each pose.
    let half_m = farthest.fold(LEAST_M, f64::max).ceil();
    let mut cells = vec![vec!['\u{b7}'; COLUMNS]; ROWS];
    // A few dots suffice as a scale.
    for (row, line) in cells.iter_mut().enumerate() {
        for (column, cell) in line.iter_mut().enumerate() {
            if row % 5 != 0 || column % 10 != 0 {
                *cell = ' ';
            }
        }
    }
    let mut write = |x: f64, y: f64, text: &str| {
        let row = (1.0 - x / half_m) / 2.0 * (ROWS - 1) as f64;
        let column = (1.0 - y / half_m) / 2.0 * (COLUMNS - 1) as f64;
        if !(row.is_finite() && column.is_finite()) {
            return;
        }
        let row = (row.round() as usize).min(ROWS - 1);
        let first = (column.round() as usize).min(COLUMNS - 1);
        for (cell, letter) in cells[row][first..].iter_mut().zip(text.chars()) {
            *cell = letter;
        }
    };
    write(0.0, 0.0, &format!("+{own}"));
    for place in places {
        let (x, y) = flat(place);
        write(x, y, &format!("*{}", place.name));
    }
    let lines: Vec<String> =
        cells.iter().map(|line| line.iter().collect::<String>().trim_end().to_owned()).collect();
    format!("{}\nup is forward, {half_m} m from the middle to each edge", lines.join("\n"))
}

#[cfg(test)]
mod tests {
    use flockeye_contract::SwarmWay;
    use flockeye_peer::UncertainPose;
    use nalgebra::{Isometry3, Matrix6};

    use super::*;

    fn place(name: &str, x: f64, y: f64) -> DronePlace {
        let a_from_b = Isometry3::translation(x, y, 0.0);
        DronePlace {
            name: name.into(),
            own_from_drone: UncertainPose { a_from_b, covariance: Matrix6::identity() },
            way: SwarmWay::Direct,
            through: None,
            seen_s: 0.0,
            pairs: 1,
        }
    }

    #[test]
    fn forward_is_up_and_left_is_left() {
        let text = map(
            "own",
            &[place("kite", 2.0, 0.0), place("wren", 0.0, 2.0), place("far", f64::NAN, 0.0)],
        );
        let lines: Vec<&str> = text.lines().collect();
        let at = |name: &str| {
            lines.iter().enumerate().find_map(|(row, line)| Some((row, line.find(name)?)))
        };
        let column =
            |name: &str| at(name).map(|(row, byte)| (row, lines[row][..byte].chars().count()));
        assert_eq!(column("+own"), Some((10, 30)));
        assert_eq!(column("*kite"), Some((0, 30)));
        assert_eq!(column("*wren"), Some((10, 0)));
        assert!(lines.last().is_some_and(|line| line.contains("2 m")));
    }
}
