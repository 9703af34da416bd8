//! Directions of the pixels of an equirectangular image, as tables for the renderer.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// The grid of an equirectangular image, with tables of sines and cosines.
#[derive(Debug)]
pub(crate) struct SphereGrid {
    pub width: usize,
    pub height: usize,
    /// Cosine and sine of each column's longitude.
    pub columns: Vec<[f32; 2]>,
    /// Cosine and sine of each row's latitude.
    pub rows: Vec<[f32; 2]>,
}

impl SphereGrid {
    pub(crate) fn new(width: usize, height: usize) -> Self {
        let pair = |angle: f64| [angle.cos() as f32, angle.sin() as f32];
        let longitude = |column: usize| PI - (column as f64 + 0.5) * TAU / width as f64;
        let latitude = |row: usize| FRAC_PI_2 - (row as f64 + 0.5) * PI / height as f64;
        Self {
            width,
            height,
            columns: (0..width).map(|column| pair(longitude(column))).collect(),
            rows: (0..height).map(|row| pair(latitude(row))).collect(),
        }
    }

    /// Rows that a circle of `radius` radians round `latitude` touches.
    pub(crate) fn rows_of_circle(&self, latitude: f64, radius: f64) -> std::ops::Range<usize> {
        let row = |latitude: f64| (FRAC_PI_2 - latitude) / PI * self.height as f64 - 0.5;
        let first = row(latitude + radius).floor().max(0.0) as usize;
        let end = (row(latitude - radius).ceil() + 1.0).clamp(0.0, self.height as f64) as usize;
        first..end
    }

    /// Runs of columns of `row` inside the circle of `radius` radians round a direction: one or
    /// two, as (first, end). Near a pole inside the circle, they are all columns.
    pub(crate) fn runs_of_circle(
        &self,
        row: usize,
        longitude: f64,
        latitude: f64,
        radius: f64,
    ) -> impl Iterator<Item = (usize, usize)> + use<> {
        let whole = || self.runs(0, self.width);
        let [cos_row, sin_row] = self.rows[row].map(f64::from);
        let across = cos_row * latitude.cos();
        // Spherical law of cosines, solved for the difference of longitudes.
        let cosine = (radius.cos() - sin_row * latitude.sin()) / across;
        if across < 1e-9 || cosine <= -1.0 {
            return whole();
        }
        let half = cosine.min(1.0).acos() * self.width as f64 / TAU;
        let middle = (PI - longitude) / TAU * self.width as f64 - 0.5;
        let first = (middle - half).floor() as i64;
        let end = (middle + half).ceil() as i64 + 1;
        if end - first >= self.width as i64 {
            whole()
        } else {
            self.runs(first, (end - first) as usize)
        }
    }

    /// Runs of `count` columns from `first`, which counts modulo the image's width.
    fn runs(&self, first: i64, count: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let width = self.width;
        let first = first.rem_euclid(width as i64) as usize;
        let end = first + count.min(width);
        [(first, end.min(width)), (0, end.saturating_sub(width))]
            .into_iter()
            .filter(|(first, end)| first < end)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use flockeye_geometry::camera::{Equirectangular, SpherePixel};

    use super::*;

    #[test]
    fn every_pixel_of_a_circle_is_in_its_rows_and_spans() {
        let grid = SphereGrid::new(256, 128);
        let camera = Equirectangular { width: 256, height: 128 };
        for (longitude, latitude, radius) in
            [(0.1, 0.2, 0.3), (PI, -0.4, 0.2), (-3.0, 1.4, 0.3), (2.0, -1.5, 0.25), (0.0, 1.2, 0.1)]
        {
            let middle = nalgebra::Vector3::new(
                f64::cos(latitude) * f64::cos(longitude),
                f64::cos(latitude) * f64::sin(longitude),
                f64::sin(latitude),
            );
            let mut drawn = 0;
            for row in 0..grid.height {
                let in_rows = grid.rows_of_circle(latitude, radius).contains(&row);
                let mut covered = vec![false; grid.width];
                if in_rows {
                    grid.runs_of_circle(row, longitude, latitude, radius)
                        .for_each(|(a, b)| covered[a..b].fill(true));
                }
                for (column, covered) in covered.into_iter().enumerate() {
                    let ray = camera.ray(SpherePixel::new(column as f64, row as f64));
                    if ray.angle(&middle) < radius {
                        assert!(covered, "{column} {row} of {longitude} {latitude} {radius}");
                    }
                    drawn += usize::from(covered);
                }
            }
            assert!(drawn < grid.width * grid.height / 2, "{drawn} pixels for {radius}");
        }
    }
}
