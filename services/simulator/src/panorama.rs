//! The panorama behind the bodies for any camera: painted once in several sizes, looked up by
//! direction and yaw.

use std::f64::consts::{PI, TAU};

use crate::backdrop::painted;
use crate::parameters::WorldParameters;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;
use crate::tiles::{ImageTile, TILE};

/// Stored units per unit of the square root of light.
const ROOT_STEPS: f32 = 8192.0;
/// Entries of the table from roots to levels: up to light 4, which exceeds the lamps.
const ROOTS: usize = 16_384;
/// Minimum and maximum width of a panorama, columns.
const WIDTHS: [f64; 2] = [64.0, 8192.0];

/// Longitudes and latitudes of a row of pixels. Units: 1/65536 turn from the first column, and
/// 1/65536 of half a turn from the pole.
type PlaceRow = [[u16; TILE]; 2];

/// Positions of a tile's pixels in the panorama.
#[derive(Debug)]
pub(crate) struct Outlook {
    /// Index of the panorama with the best resolution for this tile.
    panorama: usize,
    places: [PlaceRow; TILE],
}

/// Panoramas of the hall, each with twice the resolution of the one before.
#[derive(Debug)]
pub(crate) struct Panoramas {
    sizes: Vec<Panorama>,
    /// Level and sigma for each root of light.
    encoded: Vec<[u8; 2]>,
}

#[derive(Debug)]
struct Panorama {
    width: usize,
    height: usize,
    /// Square roots of linear light. The first column is repeated after each row, and the last row
    /// once.
    roots: Vec<u16>,
}

impl Panoramas {
    /// The panoramas for `bands` of tiles, and the positions of each tile's pixels in them.
    pub(crate) fn new(
        parameters: &WorldParameters,
        bands: &[Vec<ImageTile>],
        sensor: &ImageSensor,
    ) -> (Self, Vec<Vec<Outlook>>) {
        let camera = &parameters.camera;
        let usual = camera.pixels_per_radian();
        let doublings = |tile: &ImageTile| {
            // Limit for the rim of a very wide plane: a panorama much finer than the image is too
            // expensive.
            let most = f64::from(camera.width().max(camera.height())) / PI;
            let wanted = tile.density.pixels_per_radian().clamp(usual / 8.0, usual.max(most));
            (wanted / usual).log2().round() as i32
        };
        let all = || bands.iter().flatten();
        let [least, most] = [all().map(doublings).min(), all().map(doublings).max()]
            .map(|doublings| doublings.unwrap_or(0));
        let sizes = (least..=most)
            .map(|doublings| Panorama::new(parameters, usual * f64::from(doublings).exp2()))
            .collect();
        let light = |root: usize| ((root as f32 + 0.5) / ROOT_STEPS).powi(2);
        let encoded = (0..ROOTS)
            .map(|root| [sensor.level(light(root)), sensor.sigma_of_light(light(root))])
            .collect();
        let outlook = |tile: &ImageTile| Outlook::new(tile, (doublings(tile) - least) as usize);
        let outlooks = bands.iter().map(|band| band.iter().map(outlook).collect()).collect();
        (Self { sizes, encoded }, outlooks)
    }

    /// Writes levels and sigmas of a row of a tile, for an observer turned left by `yaw` radians.
    pub(crate) fn fill(
        &self,
        tile: &ImageTile,
        outlook: &Outlook,
        row: usize,
        yaw: f64,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let panorama = &self.sizes[outlook.panorama];
        let [turns, heights] = &outlook.places[row];
        let first = panorama.first_turn(yaw);
        let mut put = |column: usize| {
            let root = panorama.root(turns[column], heights[column], first);
            [levels[column], sigmas[column]] = self.encoded[usize::from(root)];
        };
        if tile.seen[row] == u16::MAX {
            (0..TILE).for_each(&mut put);
        } else {
            tile.seen_in(row).for_each(&mut put);
        }
    }
}

impl Panorama {
    fn new(parameters: &WorldParameters, pixels_per_radian: f64) -> Self {
        let half = (pixels_per_radian * PI).clamp(WIDTHS[0] / 2.0, WIDTHS[1] / 2.0).ceil() as usize;
        let grid = SphereGrid::new(2 * half, half);
        let light = painted(parameters, &grid, parameters.observer_yaw_rate());
        let last = (ROOTS - 1) as u16;
        let root = |light: &f32| ((light.max(0.0).sqrt() * ROOT_STEPS) as u16).min(last);
        let mut roots = Vec::with_capacity((grid.width + 1) * (grid.height + 1));
        let rows = light.chunks_exact(grid.width);
        for row in rows.clone().chain(rows.last()) {
            roots.extend(row.iter().chain(row.first()).map(root));
        }
        Self { width: grid.width, height: grid.height, roots }
    }

    /// Offset of longitudes for a yaw, in units of 2^-32 turns. Column positions then start at the
    /// centre of the first column.
    fn first_turn(&self, yaw: f64) -> u32 {
        let turns = -yaw / TAU - 0.5 / self.width as f64;
        // Rounding may give 2^32, which the cast makes 0.
        ((turns - turns.floor()) * 2f64.powi(32)) as u64 as u32
    }

    /// Root of the light at a position, interpolated.
    #[inline]
    fn root(&self, turn: u16, height: u16, first: u32) -> u16 {
        let turn = u64::from((u32::from(turn) << 16).wrapping_add(first));
        // Positions in 1/256 columns and rows.
        let across = (turn * self.width as u64) >> 24;
        let down = ((usize::from(height) * self.height) >> 8).saturating_sub(128);
        let (column, row) = ((across >> 8) as usize, (down >> 8).min(self.height - 1));
        let (s, t) = ((across & 255) as i32, (down & 255) as i32);
        let at = row * (self.width + 1) + column;
        let mix = |one: i32, other: i32, share: i32| one + (((other - one) * share) >> 8);
        let pair = |at: usize| mix(i32::from(self.roots[at]), i32::from(self.roots[at + 1]), s);
        mix(pair(at), pair(at + self.width + 1), t) as u16
    }
}

impl Outlook {
    fn new(tile: &ImageTile, panorama: usize) -> Self {
        let mut places = [[[0; TILE]; 2]; TILE];
        for (row, places) in places.iter_mut().enumerate() {
            for column in tile.seen_in(row) {
                let [x, y, z] = [0, 1, 2].map(|axis| f64::from(tile.rays[row][axis][column]));
                let turn = 0.5 - y.atan2(x) / TAU;
                let height = 0.5 - z.atan2(x.hypot(y)) / PI;
                // A full turn wraps to 0; latitudes are clamped at the poles.
                places[0][column] = (turn * 65_536.0).round() as u32 as u16;
                places[1][column] = (height * 65_536.0).round().clamp(0.0, 65_535.0) as u16;
            }
        }
        Self { panorama, places }
    }
}
