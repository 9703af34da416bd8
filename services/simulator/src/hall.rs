//! The observer's surroundings: a flight hall with many objects that resemble distant markers.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::scatter::{at_cell, clouds, floor, mix};

/// Distances of walls, floor and ceiling from the camera, metres.
const HALF_LENGTH: f32 = 7.5;
const HALF_WIDTH: f32 = 4.6;
const FLOOR: f32 = -1.4;
const CEILING: f32 = 2.9;

/// A box that stands on the floor.
#[derive(Debug)]
struct Crate {
    low: [f32; 3],
    high: [f32; 3],
    reflectance: f32,
}

/// A sheet on a wall, printed with random cells.
#[derive(Debug)]
struct Poster {
    wall: usize,
    /// Centre (along the wall, height), metres; `half`: half the side, metres.
    middle: [f32; 2],
    half: f32,
    cells: f32,
    seed: u64,
}

/// The hall: light as a function of direction.
#[derive(Debug)]
pub(crate) struct Hall {
    seed: u64,
    crates: Vec<Crate>,
    /// Indices of the boxes that may be hit in each of [`SECTORS`].
    in_sector: Vec<Vec<usize>>,
    posters: Vec<Poster>,
}

/// Number of sectors round the vertical, each with a list of its boxes.
const SECTORS: usize = 256;

impl Hall {
    pub(crate) fn new(seed: u64) -> Self {
        let mut random = StdRng::seed_from_u64(mix(seed ^ 0x6861_6c6c));
        let crates: Vec<Crate> = (0..22).map(|_| draw_crate(&mut random)).collect();
        let may_be_met = |sector: usize| {
            (0..crates.len()).filter(|&number| crates[number].lies_in(sector)).collect()
        };
        let in_sector = (0..SECTORS).map(may_be_met).collect();
        let posters = (0..14)
            .map(|k| {
                let wall = k % 4;
                let room = if wall < 2 { HALF_LENGTH } else { HALF_WIDTH } - 1.0;
                Poster {
                    wall,
                    middle: [random.random_range(-room..room), random.random_range(-0.4..1.6)],
                    half: random.random_range(0.15..0.55),
                    cells: f32::from(random.random_range(6u8..14)),
                    seed: random.random(),
                }
            })
            .collect();
        Self { seed, crates, in_sector, posters }
    }

    /// Linear light from the direction `ray` (unit vector; x along the hall, z up), as a share of
    /// full scale. Lamps and windows exceed 1.
    pub(crate) fn light(&self, ray: [f32; 3]) -> f32 {
        let to_plane = |from: f32, along: f32| from / if along == 0.0 { 1e-9 } else { along };
        let [x, y, z] = ray;
        let to_end = to_plane(HALF_LENGTH.copysign(x), x);
        let to_side = to_plane(HALF_WIDTH.copysign(y), y);
        let to_level = to_plane(if z > 0.0 { CEILING } else { FLOOR }, z);
        let distance = to_end.min(to_side).min(to_level);
        if let Some(light) = self.crate_light(ray, distance) {
            return light;
        }
        let at = ray.map(|component| component * distance);
        if distance == to_level {
            if z > 0.0 { self.ceiling(at) } else { self.floor(at) }
        } else if distance == to_side {
            self.wall(usize::from(y < 0.0), at[0], at[2])
        } else {
            self.wall(2 + usize::from(x < 0.0), at[1], at[2])
        }
    }

    fn floor(&self, [x, y, _]: [f32; 3]) -> f32 {
        let (u, v) = (x / 0.6, y / 0.6);
        let (i, j) = (floor(u), floor(v));
        let is_joint = (u - i).min(v - j) < 0.012;
        let tile = if fraction((i + j) / 2.0) < 0.5 { 0.30 } else { 0.11 };
        let wear = 0.7
            + 0.25 * at_cell(self.seed, i as i32, j as i32)
            + 0.3 * clouds(self.seed ^ 1, x * 4.0, y * 4.0)
            + 0.2 * clouds(self.seed ^ 2, x * 23.0, y * 23.0);
        if is_joint { 0.05 } else { tile * wear * 0.8 }
    }

    fn ceiling(&self, [x, y, _]: [f32; 3]) -> f32 {
        // Lamps every 3 m along the hall, in two rows.
        let along = from_nearest(x / 3.0 - 0.5) * 3.0;
        let aside = y.abs() - 2.0;
        if along.abs() < 0.6 && aside.abs() < 0.16 {
            return 3.0;
        }
        let glow = 0.5 * (-(along * along + 1.5 * aside * aside) * 1.6).exp();
        let girder = from_nearest(x / 2.5).abs() * 2.5;
        let lattice = fraction(y * 2.4 + girder * 6.0) < 0.2;
        let steel = girder < 0.02 || (0.16..0.18).contains(&girder) || (girder < 0.18 && lattice);
        if steel { 0.05 + 0.2 * glow } else { 0.16 + glow + 0.05 * clouds(self.seed ^ 3, x, y) }
    }

    fn wall(&self, wall: usize, along: f32, height: f32) -> f32 {
        if let Some(light) = self.poster_light(wall, along, height) {
            return light;
        }
        let share = (height - FLOOR) / (CEILING - FLOOR);
        let stain = clouds(self.seed ^ (4 + wall as u64), along * 0.9, height * 0.9);
        let mut light = (0.13 + 0.16 * share) * (0.85 + 0.3 * stain);
        if wall == 0 && (1.0..2.2).contains(&height) {
            // Windows with frames between the panes.
            let pane = fraction(along / 0.9);
            let is_frame = pane < 0.06 || (height - 1.6).abs() < 0.025;
            let is_window = fraction(along / 3.6) < 0.5;
            if is_window {
                return if is_frame {
                    0.10
                } else {
                    1.3 + 0.6 * clouds(self.seed ^ 9, along, height)
                };
            }
        }
        let line = |value: f32, spacing: f32, width: f32| {
            from_nearest(value / spacing).abs() * spacing < width
        };
        if line(along, 2.5, 0.09) {
            light *= 0.45;
        }
        if line(along, 1.25, 0.012) || line(height, 0.85, 0.012) {
            light *= 0.6;
        }
        // A net hangs before the two long walls.
        if wall < 2 && height < 1.0 && (line(along, 0.16, 0.007) || line(height, 0.16, 0.007)) {
            light *= 0.45;
        }
        light
    }

    fn poster_light(&self, wall: usize, along: f32, height: f32) -> Option<f32> {
        self.posters.iter().filter(|poster| poster.wall == wall).find_map(|poster| {
            let u = (along - poster.middle[0]) / poster.half;
            let v = (height - poster.middle[1]) / poster.half;
            if u.abs().max(v.abs()) > 1.0 {
                return None;
            }
            if u.abs().max(v.abs()) > 0.85 {
                return Some(0.45);
            }
            let cell = |w: f32| ((w / 0.85 + 1.0) / 2.0 * poster.cells) as i32;
            Some(if at_cell(poster.seed, cell(u), cell(v)) < 0.5 { 0.04 } else { 0.5 })
        })
    }

    /// Light of the nearest box within `limit` metres, if the ray hits one.
    fn crate_light(&self, ray: [f32; 3], limit: f32) -> Option<f32> {
        // No box is higher than the camera.
        if ray[2] > 0.0 {
            return None;
        }
        let mut nearest = limit;
        let mut light = None;
        for &number in &self.in_sector[sector_of(ray[0], ray[1])] {
            let object = &self.crates[number];
            let (mut enter, mut leave, mut side) = (0.0f32, nearest, 0);
            for (axis, along) in ray.iter().enumerate() {
                let inverse = 1.0 / along;
                let (a, b) = (object.low[axis] * inverse, object.high[axis] * inverse);
                if a.min(b) > enter {
                    (enter, side) = (a.min(b), axis);
                }
                leave = leave.min(a.max(b));
            }
            if enter < leave && enter > 0.0 {
                nearest = enter;
                let shade = [0.75, 0.6, 1.0][side];
                let [u, v] = [ray[(side + 1) % 3] * enter, ray[(side + 2) % 3] * enter];
                let grain = 0.85 + 0.3 * clouds(self.seed ^ 7, u * 9.0, v * 9.0);
                light = Some(object.reflectance * shade * grain);
            }
        }
        light
    }
}

/// Fractional part: the number minus its floor.
fn fraction(value: f32) -> f32 {
    value - floor(value)
}

/// Signed difference to the nearest whole number.
fn from_nearest(value: f32) -> f32 {
    value - floor(value + 0.5)
}

/// A random box along the walls, at least 3 m from the camera.
fn draw_crate(random: &mut StdRng) -> Crate {
    let along_side = random.random_bool(0.6);
    let sign = if random.random_bool(0.5) { 1.0 } else { -1.0 };
    let (x, y) = if along_side {
        (random.random_range(-7.0..7.0), sign * random.random_range(3.6..4.3))
    } else {
        (sign * random.random_range(5.5..7.0), random.random_range(-4.2..4.2f32))
    };
    let half = [0, 1].map(|_| random.random_range(0.12..0.35f32));
    let height = random.random_range(0.2..1.1f32);
    Crate {
        low: [x - half[0], y - half[1], FLOOR],
        high: [x + half[0], y + half[1], FLOOR + height],
        reflectance: random.random_range(0.02..0.6f32),
    }
}

impl Crate {
    /// Whether a part of the box is in a sector. The sectors of its corners bound it, because it is
    /// convex and less than 180 degrees wide.
    fn lies_in(&self, sector: usize) -> bool {
        let corner = |k: usize| {
            let [x, y] = [[self.low[0], self.high[0]][k & 1], [self.low[1], self.high[1]][k >> 1]];
            sector_of(x, y)
        };
        let first = corner(0);
        // Signed number of sectors from a corner, because the range may wrap round.
        let from_first = |sector: usize| {
            let ahead = (sector + SECTORS - first) % SECTORS;
            if ahead < SECTORS / 2 { ahead as i32 } else { ahead as i32 - SECTORS as i32 }
        };
        let corners = [0, 1, 2, 3].map(|k| from_first(corner(k)));
        let reach = corners.iter().fold([0, 0], |[low, high], &at| [low.min(at), high.max(at)]);
        // One more sector on each side allows for rounding.
        (reach[0] - 1..=reach[1] + 1).contains(&from_first(sector))
    }
}

/// The sector of a horizontal direction. Sectors differ in width, so that no angle must be
/// computed.
fn sector_of(x: f32, y: f32) -> usize {
    // Rises from 0 to 4 over a turn: position along a square round the origin.
    let share = y / (x.abs() + y.abs()).max(f32::MIN_POSITIVE);
    let way = if x < 0.0 {
        2.0 - share
    } else if share < 0.0 {
        4.0 + share
    } else {
        share
    };
    ((way * (SECTORS as f32 / 4.0)) as usize).min(SECTORS - 1)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    #[test]
    fn every_point_of_a_box_lies_in_one_of_its_sectors() {
        let mut random = StdRng::seed_from_u64(1);
        for _ in 0..500 {
            let object = draw_crate(&mut random);
            for _ in 0..200 {
                let [x, y] = [0, 1].map(|k| random.random_range(object.low[k]..=object.high[k]));
                assert!(object.lies_in(sector_of(x, y)), "{x} {y} in {object:?}");
                assert!(!object.lies_in(sector_of(-x, -y)), "{x} {y} behind {object:?}");
            }
        }
        let sectors = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0), (0.0, 0.0)];
        let sectors = sectors.map(|(x, y)| sector_of(x, y));
        assert_eq!(sectors, [0, SECTORS / 4, SECTORS / 2, SECTORS * 3 / 4, 0]);
    }

    #[test]
    fn the_hall_has_light_in_every_direction_and_much_contrast() {
        let hall = Hall::new(1);
        let (mut dark, mut bright) = (0, 0);
        for k in 0..20_000 {
            // Spread evenly over the sphere along a spiral.
            let z = 1.0 - (k as f32 + 0.5) / 10_000.0;
            let (sin, cos) = (k as f32 * 2.399_963).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let light = hall.light([r * cos, r * sin, z]);
            assert!(light.is_finite() && light > 0.0 && light <= 3.0, "{light} at {k}");
            dark += i32::from(light < 0.08);
            bright += i32::from(light > 1.0);
        }
        assert!(dark > 1000 && bright > 200, "{dark} dark, {bright} bright");
        assert!(hall.light([0.0, 0.0, 1.0]).is_finite() && hall.light([1.0, 0.0, 0.0]).is_finite());
    }
}
