//! The panorama behind the bodies for any camera: painted once in several sizes, looked up by each
//! pixel's direction, turned with the observer's yaw.

use std::f64::consts::{PI, TAU};

use crate::backdrop::painted;
use crate::parameters::WorldParameters;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;
use crate::tiles::{ImageTile, TILE};

/// Steps of a stored value for each unit of light's root.
const ROOT_STEPS: f32 = 8192.0;
/// Values in the table from roots to levels: up to four times full scale, more than any lamp has.
const ROOTS: usize = 16_384;
/// Narrowest and widest panorama, columns.
const WIDTHS: [f64; 2] = [64.0, 8192.0];

/// Longitudes and latitudes of a row of pixels: parts of a turn leftwards of the panorama's first
/// column, and of half a turn down from the pole; 1/65536 each.
type PlaceRow = [[u16; TILE]; 2];

/// Where the pixels of a tile look in the panorama.
#[derive(Debug)]
pub(crate) struct Outlook {
    /// Which of the panoramas is about as fine as the image here.
    panorama: usize,
    places: [PlaceRow; TILE],
}

/// Panoramas of the hall, each twice as fine as the one before.
#[derive(Debug)]
pub(crate) struct Panoramas {
    sizes: Vec<Panorama>,
    /// Level and sigma of every root of light.
    encoded: Vec<[u8; 2]>,
}

#[derive(Debug)]
struct Panorama {
    width: usize,
    height: usize,
    /// Roots of linear light; the first column again after each row, and the last row again.
    roots: Vec<u16>,
}

impl Panoramas {
    /// The panoramas that `bands` of tiles need, and where each tile looks.
    pub(crate) fn new(
        parameters: &WorldParameters,
        bands: &[Vec<ImageTile>],
        sensor: &ImageSensor,
    ) -> (Self, Vec<Vec<Outlook>>) {
        let camera = &parameters.camera;
        let usual = camera.pixels_per_radian();
        let doublings = |tile: &ImageTile| {
            // A panorama of many more columns than the image, for the rim of a very wide plane, is
            // not worth its time and memory.
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

    /// What to add to a place's turn, in parts of 2^32, so that its whole columns count from the
    /// middle of the first one.
    fn first_turn(&self, yaw: f64) -> u32 {
        let turns = -yaw / TAU - 0.5 / self.width as f64;
        // Less than 2^32, but for rounding, which makes it that: 0 again.
        ((turns - turns.floor()) * 2f64.powi(32)) as u64 as u32
    }

    /// Root of the light at a place, interpolated.
    #[inline]
    fn root(&self, turn: u16, height: u16, first: u32) -> u16 {
        let turn = u64::from((u32::from(turn) << 16).wrapping_add(first));
        // In 256ths of columns and rows.
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
                // A whole turn is no turn; the poles are at the ends.
                places[0][column] = (turn * 65_536.0).round() as u32 as u16;
                places[1][column] = (height * 65_536.0).round().clamp(0.0, 65_535.0) as u16;
            }
        }
        Self { panorama, places }
    }
}
