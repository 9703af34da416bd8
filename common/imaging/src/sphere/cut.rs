//! Cuts views tile by tile, and distributes them over threads.

use std::sync::{Mutex, PoisonError};

use super::any_camera::CameraMapping;
use super::cut_request::{Cut, Interpolation};
use super::equirectangular::EquirectangularMapping;
use super::fixed_point::{LANES, put};
use super::image::SphereImage;
use super::mapping::{Mapping, TileFit};
use super::patch::{MAX_ROWS, Strip, ViewTile};
use super::sample::sample_by;

/// Widest tile, pixels.
const MAX_COLUMNS: u32 = 32;

/// Rows of a view that one thread cuts at a time.
const BAND_ROWS: u32 = 4 * MAX_ROWS;

/// Pixels that are cut faster than a thread starts.
const MIN_PIXELS_PER_THREAD: usize = 20_000;

/// Neighbouring rows of a view.
pub(super) struct RowBand<'a> {
    pub cut: &'a Cut,
    /// The first row.
    pub y: u32,
    pub rows: u32,
    /// The output from the first row on, with rows `stride` bytes apart.
    pub out: &'a mut [u8],
    pub stride: usize,
}

/// Cuts one view. `out` and the view have been checked.
pub(super) fn cut_view(sphere: &SphereImage<'_>, cut: &Cut, out: &mut [u8], stride: usize) {
    cut_band(sphere, RowBand { cut, y: 0, rows: cut.view.size_px, out, stride });
}

/// Cuts checked views, with rows as far apart as each is wide, on up to `threads` threads.
pub(super) fn cut_views(
    sphere: &SphereImage<'_>,
    cuts: &[Cut],
    outputs: &mut [&mut [u8]],
    threads: usize,
) {
    let pixels: usize = cuts.iter().map(|cut| (cut.view.size_px as usize).pow(2)).sum();
    let threads = threads.min(pixels / MIN_PIXELS_PER_THREAD);
    if threads <= 1 {
        for (cut, out) in cuts.iter().zip(outputs) {
            cut_view(sphere, cut, out, cut.view.size_px as usize);
        }
        return;
    }
    let bands = cuts.iter().zip(outputs).flat_map(|(cut, out)| {
        let stride = cut.view.size_px as usize;
        let out = &mut out[..stride * stride];
        out.chunks_mut(BAND_ROWS as usize * stride).enumerate().map(move |(k, out)| {
            let rows = (out.len() / stride) as u32;
            RowBand { cut, y: k as u32 * BAND_ROWS, rows, out, stride }
        })
    });
    let bands = Mutex::new(bands);
    let work = || {
        loop {
            // A panic in another thread poisons the lock; the scope passes the panic on.
            let next = bands.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some(band) = next else { break };
            cut_band(sphere, band);
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads {
            scope.spawn(work);
        }
        work();
    });
}

/// Implementations that cut views. All give the same bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kernel {
    /// Pixel by pixel.
    Plain,
    /// Eight columns at once, each pixel loaded by itself.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Eight columns at once, loaded by the gather instruction.
    #[cfg(target_arch = "x86_64")]
    Avx2Gather,
}

impl Kernel {
    /// The fastest one for this processor.
    pub(super) fn of_processor() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            return if super::fetch::gathers() { Self::Avx2Gather } else { Self::Avx2 };
        }
        Self::Plain
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Plain => "no vector instructions",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Gather => "AVX2 with gathers",
        }
    }

    /// Whether this kernel works on this processor for this image.
    pub(super) fn works_on(self, sphere: &SphereImage<'_>) -> bool {
        match self {
            Self::Plain => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 | Self::Avx2Gather => {
                is_x86_feature_detected!("avx2") && sphere.stride() <= super::avx2::MAX_STRIDE
            }
        }
    }
}

fn cut_band(sphere: &SphereImage<'_>, band: RowBand<'_>) {
    cut_band_by(Kernel::of_processor(), sphere, band);
}

/// Cuts with this kernel, or with the plain one where it does not work.
pub(super) fn cut_band_by(kernel: Kernel, sphere: &SphereImage<'_>, band: RowBand<'_>) {
    match band.cut.interpolation {
        Interpolation::Bilinear => cut_band_with::<false>(kernel, sphere, band),
        Interpolation::Cubic => cut_band_with::<true>(kernel, sphere, band),
    }
}

fn cut_band_with<const CUBIC: bool>(kernel: Kernel, sphere: &SphereImage<'_>, band: RowBand<'_>) {
    match kernel {
        // SAFETY: `works_on` has checked that the processor has AVX2, and that the stride is within
        // its limit.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 if kernel.works_on(sphere) => unsafe {
            cut_band_avx2::<false, CUBIC>(sphere, band);
        },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2Gather if kernel.works_on(sphere) => unsafe {
            cut_band_avx2::<true, CUBIC>(sphere, band);
        },
        _ => cut_tiles::<CUBIC>(sphere, band, |strip, rows, out, stride| {
            cut_strip::<CUBIC>(sphere, strip, rows, out, stride);
        }),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn cut_band_avx2<const GATHERED: bool, const CUBIC: bool>(
    sphere: &SphereImage<'_>,
    band: RowBand<'_>,
) {
    // Numbers of neighbours that a position has before and after itself.
    let (before, after) = if CUBIC { (1, 2) } else { (0, 1) };
    // Range of the positions whose neighbours all lie in the image, 1/65536 px.
    let inside = [sphere.camera.width(), sphere.camera.height()]
        .map(|side| [before << 16, ((side as i32 - after) << 16) - 1]);
    cut_tiles::<CUBIC>(sphere, band, |strip, rows, out, stride| {
        let computed = rows.next_multiple_of(4) as i32;
        let [column, line] = strip;
        if !(column.stays_within(computed, inside[0]) & line.stays_within(computed, inside[1])) {
            cut_strip::<CUBIC>(sphere, strip, rows, out, stride);
        } else if CUBIC {
            // SAFETY: both coordinates were checked over the rows rounded up to fours, with the
            // cubic's neighbourhood, and `works_on` has checked the stride before this function was
            // called.
            unsafe { super::avx2::cut_strip_cubic::<GATHERED>(sphere, strip, rows, out, stride) };
        } else {
            // SAFETY: as above, with the neighbourhood of two by two pixels.
            unsafe { super::avx2::cut_strip::<GATHERED>(sphere, strip, rows, out, stride) };
        }
    });
}

/// Cuts a strip pixel by pixel, also across the seam.
#[inline(always)]
fn cut_strip<const CUBIC: bool>(
    sphere: &SphereImage<'_>,
    strip: &Strip,
    rows: usize,
    out: &mut [u8],
    stride: usize,
) {
    let [mut column, mut line] = *strip;
    for row in 0..rows {
        let mut greys = [0; LANES];
        for (k, grey) in greys.iter_mut().enumerate() {
            *grey = sample_by::<CUBIC>(sphere, [column.value[k], line.value[k]]);
        }
        put(out, stride, row, greys);
        column.advance();
        line.advance();
    }
}

/// Divides a band into tiles and cuts each of them: strip by strip with `cut_strip`, and where the
/// mapping cannot be interpolated, pixel by pixel.
#[inline(always)]
fn cut_tiles<const CUBIC: bool>(
    sphere: &SphereImage<'_>,
    band: RowBand<'_>,
    cut_strip: impl Fn(&Strip, usize, &mut [u8], usize),
) {
    let camera = sphere.camera.at_distance(band.cut.distance_m);
    let view = &band.cut.view;
    match camera.as_equirectangular() {
        Some(camera) => {
            let mapping = EquirectangularMapping::new(camera, view);
            cut_tiles_by::<CUBIC>(&mapping, sphere, band, cut_strip);
        }
        None => {
            let mapping = CameraMapping::new(&camera, view);
            cut_tiles_by::<CUBIC>(&mapping, sphere, band, cut_strip);
        }
    }
}

#[inline(always)]
fn cut_tiles_by<const CUBIC: bool>(
    mapping: &impl Mapping,
    sphere: &SphereImage<'_>,
    band: RowBand<'_>,
    cut_strip: impl Fn(&Strip, usize, &mut [u8], usize),
) {
    let RowBand { cut, y: top, rows, out, stride } = band;
    let size = cut.view.size_px;
    let mut pending = Vec::new();
    for y in (0..rows).step_by(MAX_ROWS as usize) {
        for x in (0..size).step_by(MAX_COLUMNS as usize) {
            let width = (size - x).min(MAX_COLUMNS);
            // Whole strips: the last tile overlaps with its left neighbour.
            let whole = width.next_multiple_of(LANES as u32).min(size);
            let height = (rows - y).min(MAX_ROWS);
            pending.push(ViewTile { x: x + width - whole, y: top + y, width: whole, height });
            while let Some(tile) = pending.pop() {
                let at = (tile.y - top) as usize * stride + tile.x as usize;
                // A view narrower than a strip has no whole strips.
                let is_whole = tile.width.is_multiple_of(LANES as u32);
                match if is_whole { mapping.fit(tile) } else { TileFit::Split } {
                    TileFit::Interpolated(patch) => {
                        for first in (0..tile.width).step_by(LANES) {
                            let out = &mut out[at + first as usize..];
                            cut_strip(&patch.strip(first), tile.height as usize, out, stride);
                        }
                    }
                    TileFit::Blank => {
                        for line in out[at..].chunks_mut(stride).take(tile.height as usize) {
                            line[..tile.width as usize].fill(0);
                        }
                    }
                    TileFit::Split => match halves(tile) {
                        Some(halves) => pending.extend(halves),
                        None => cut_exactly::<CUBIC>(mapping, sphere, tile, &mut out[at..], stride),
                    },
                }
            }
        }
    }
}

/// The halves of a tile, of whole strips. `None` for the smallest tiles.
fn halves(tile: ViewTile) -> Option<[ViewTile; 2]> {
    let smallest = LANES as u32;
    if tile.width > smallest && tile.width >= tile.height {
        let width = (tile.width / 2).next_multiple_of(smallest);
        let rest = ViewTile { x: tile.x + width, width: tile.width - width, ..tile };
        Some([ViewTile { width, ..tile }, rest])
    } else if tile.height > smallest {
        let height = tile.height / 2;
        let rest = ViewTile { y: tile.y + height, height: tile.height - height, ..tile };
        Some([ViewTile { height, ..tile }, rest])
    } else {
        None
    }
}

/// Cuts a tile no wider than `LANES` with the exact mapping of each pixel.
#[inline(always)]
fn cut_exactly<const CUBIC: bool>(
    mapping: &impl Mapping,
    sphere: &SphereImage<'_>,
    tile: ViewTile,
    out: &mut [u8],
    stride: usize,
) {
    for row in 0..tile.height {
        let (columns, lines) = mapping.positions(tile.x, tile.y + row);
        let line = &mut out[row as usize * stride..][..tile.width as usize];
        for (grey, at) in line.iter_mut().zip(columns.into_iter().zip(lines)) {
            *grey = sample_by::<CUBIC>(sphere, at.into());
        }
    }
}
