//! Cuts views tile by tile, and distributes them over threads.

use std::sync::{Mutex, PoisonError};

use super::any_camera::CameraMapping;
use super::cut_request::{Cut, Interpolation};
use super::equirectangular::EquirectangularMapping;
use super::fixed_point::LANES;
use super::image::SphereImage;
use super::mapping::{Fit, Mapping};
use super::patch::{MAX_ROWS, Strip, Tile};
use super::sample::{sample, sample_cubic};
use super::target::Target;

/// Widest tile, pixels.
const MAX_COLUMNS: u32 = 32;

/// Rows of a view that one thread cuts at a time.
const BAND_ROWS: u32 = 4 * MAX_ROWS;

/// Fewer pixels than this are cut in less time than a thread needs to start.
const MIN_PIXELS_PER_THREAD: usize = 20_000;

/// Neighbouring rows of a view.
pub(super) struct Band<'a> {
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
    cut_band(sphere, Band { cut, y: 0, rows: cut.view.size_px, out, stride });
}

/// Cuts views, with rows as far apart as each is wide, on up to `threads` threads. All have been checked.
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
            Band { cut, y: k as u32 * BAND_ROWS, rows, out, stride }
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
    pub fn of_processor() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            return if super::fetch::gathers() { Self::Avx2Gather } else { Self::Avx2 };
        }
        Self::Plain
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "no vector instructions",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Gather => "AVX2 with gathers",
        }
    }

    /// Whether this way of sampling works on this processor, for this image.
    pub fn works_on(self, sphere: &SphereImage<'_>) -> bool {
        match self {
            Self::Plain => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 | Self::Avx2Gather => {
                is_x86_feature_detected!("avx2") && sphere.stride() <= super::avx2::MAX_STRIDE
            }
        }
    }
}

fn cut_band(sphere: &SphereImage<'_>, band: Band<'_>) {
    cut_band_by(Kernel::of_processor(), sphere, band);
}

/// Cuts with this kernel, or with the plain one where it does not work.
pub(super) fn cut_band_by(kernel: Kernel, sphere: &SphereImage<'_>, band: Band<'_>) {
    match kernel {
        // SAFETY: `works_on` has checked that the processor has AVX2, and that the stride is within its limit.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 if kernel.works_on(sphere) => unsafe { cut_band_avx2::<false>(sphere, band) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2Gather if kernel.works_on(sphere) => unsafe {
            cut_band_avx2::<true>(sphere, band);
        },
        _ => cut_band_plain(sphere, band),
    }
}

fn cut_band_plain(sphere: &SphereImage<'_>, band: Band<'_>) {
    match band.cut.interpolation {
        Interpolation::Bilinear => cut_tiles(sphere, band, sample, |strip, rows, target| {
            cut_strip(sphere, sample, strip, rows, target);
        }),
        Interpolation::Cubic => cut_tiles(sphere, band, sample_cubic, |strip, rows, target| {
            cut_strip(sphere, sample_cubic, strip, rows, target);
        }),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn cut_band_avx2<const GATHERED: bool>(sphere: &SphereImage<'_>, band: Band<'_>) {
    let (columns, lines) = (sphere.camera.width() as i32, sphere.camera.height() as i32);
    // Range of the positions whose neighbours all lie in the image, 1/65536 px: `before` pixels in front of the
    // position, and `after` behind it.
    let inside = |before: i32, after: i32| {
        [columns, lines].map(|side| [before << 16, ((side - after) << 16) - 1])
    };
    let stays = |strip: &Strip, rows: usize, inside: [[i32; 2]; 2]| {
        let computed = rows.next_multiple_of(4) as i32;
        let [column, line] = &strip.series;
        column.stays_within(computed, inside[0]) & line.stays_within(computed, inside[1])
    };
    match band.cut.interpolation {
        Interpolation::Bilinear => {
            let inside = inside(0, 1);
            cut_tiles(sphere, band, sample, |strip, rows, target| {
                if stays(strip, rows, inside) {
                    // SAFETY: `stays` has checked both coordinates over the rows rounded up to fours, and
                    // `works_on` the stride before this function was called.
                    unsafe { super::avx2::cut_strip::<GATHERED>(sphere, strip, rows, target) };
                } else {
                    cut_strip(sphere, sample, strip, rows, target);
                }
            });
        }
        Interpolation::Cubic => {
            let inside = inside(1, 2);
            cut_tiles(sphere, band, sample_cubic, |strip, rows, target| {
                if stays(strip, rows, inside) {
                    // SAFETY: as above, with the cubic's wider neighbourhood.
                    unsafe {
                        super::avx2::cut_strip_cubic::<GATHERED>(sphere, strip, rows, target)
                    };
                } else {
                    cut_strip(sphere, sample_cubic, strip, rows, target);
                }
            });
        }
    }
}

/// The grey value of the sphere image at a position, 1/65536 px.
trait Sample: Fn(&SphereImage<'_>, [i32; 2]) -> u8 + Copy {}
impl<F: Fn(&SphereImage<'_>, [i32; 2]) -> u8 + Copy> Sample for F {}

/// Cuts a strip pixel by pixel, also across the seam.
#[inline(always)]
fn cut_strip(
    sphere: &SphereImage<'_>,
    sample: impl Sample,
    strip: &Strip,
    rows: usize,
    target: &mut Target<'_>,
) {
    let [mut column, mut line] = strip.series;
    for row in 0..rows {
        let mut greys = [0; LANES];
        for (k, grey) in greys.iter_mut().enumerate() {
            *grey = sample(sphere, [column.value[k], line.value[k]]);
        }
        target.put(row, greys);
        column.advance();
        line.advance();
    }
}

/// Divides a band into tiles and cuts each of them: strip by strip with `cut_strip`, and where the mapping cannot be
/// interpolated, pixel by pixel with `sample`.
#[inline(always)]
fn cut_tiles(
    sphere: &SphereImage<'_>,
    band: Band<'_>,
    sample: impl Sample,
    cut_strip: impl Fn(&Strip, usize, &mut Target<'_>),
) {
    let camera = sphere.camera.at_distance(band.cut.distance_m);
    let view = &band.cut.view;
    match camera.as_equirectangular() {
        Some(camera) => {
            let mapping = EquirectangularMapping::new(camera, view);
            cut_tiles_by(&mapping, sphere, band, sample, cut_strip);
        }
        None => {
            let mapping = CameraMapping::new(&camera, view);
            cut_tiles_by(&mapping, sphere, band, sample, cut_strip);
        }
    }
}

#[inline(always)]
fn cut_tiles_by(
    mapping: &impl Mapping,
    sphere: &SphereImage<'_>,
    band: Band<'_>,
    sample: impl Sample,
    cut_strip: impl Fn(&Strip, usize, &mut Target<'_>),
) {
    let Band { cut, y: top, rows, out, stride } = band;
    let size = cut.view.size_px;
    let mut pending = Vec::new();
    for y in (0..rows).step_by(MAX_ROWS as usize) {
        for x in (0..size).step_by(MAX_COLUMNS as usize) {
            let width = (size - x).min(MAX_COLUMNS);
            // Whole strips: the last tile overlaps with its left neighbour.
            let whole = width.next_multiple_of(LANES as u32).min(size);
            let height = (rows - y).min(MAX_ROWS);
            pending.push(Tile { x: x + width - whole, y: top + y, width: whole, height });
            while let Some(tile) = pending.pop() {
                let at = (tile.y - top) as usize * stride + tile.x as usize;
                // A view narrower than a strip has no whole strips.
                let is_whole = tile.width.is_multiple_of(LANES as u32);
                match if is_whole { mapping.fit(tile) } else { Fit::Split } {
                    Fit::Patch(patch) => {
                        for first in (0..tile.width).step_by(LANES) {
                            let out = &mut out[at + first as usize..];
                            let mut target = Target { out, stride };
                            cut_strip(&patch.strip(first), tile.height as usize, &mut target);
                        }
                    }
                    Fit::Blank => {
                        for line in out[at..].chunks_mut(stride).take(tile.height as usize) {
                            line[..tile.width as usize].fill(0);
                        }
                    }
                    Fit::Split => match halves(tile) {
                        Some(halves) => pending.extend(halves),
                        None => cut_exactly(mapping, sphere, sample, tile, &mut out[at..], stride),
                    },
                }
            }
        }
    }
}

/// The halves of a tile, of whole strips. `None` for the smallest tiles.
fn halves(tile: Tile) -> Option<[Tile; 2]> {
    let smallest = LANES as u32;
    if tile.width > smallest && tile.width >= tile.height {
        let width = (tile.width / 2).next_multiple_of(smallest);
        let rest = Tile { x: tile.x + width, width: tile.width - width, ..tile };
        Some([Tile { width, ..tile }, rest])
    } else if tile.height > smallest {
        let height = tile.height / 2;
        let rest = Tile { y: tile.y + height, height: tile.height - height, ..tile };
        Some([Tile { height, ..tile }, rest])
    } else {
        None
    }
}

/// Cuts a tile no wider than `LANES` with the exact mapping of each pixel.
#[inline(always)]
fn cut_exactly(
    mapping: &impl Mapping,
    sphere: &SphereImage<'_>,
    sample: impl Sample,
    tile: Tile,
    out: &mut [u8],
    stride: usize,
) {
    for row in 0..tile.height {
        let (columns, lines) = mapping.positions(tile.x, tile.y + row);
        let line = &mut out[row as usize * stride..][..tile.width as usize];
        for (grey, at) in line.iter_mut().zip(columns.into_iter().zip(lines)) {
            *grey = sample(sphere, at.into());
        }
    }
}
