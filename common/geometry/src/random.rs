//! Repeatable random numbers: the same for the same seed on every machine and in every process.

use nalgebra::Vector3;

/// SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014).
#[derive(Debug, Clone)]
#[allow(unreachable_pub, reason = "fixtures export it")]
pub struct Chance(u64);

impl Chance {
    /// Starts from a seed.
    #[cfg(any(test, feature = "fixtures"))]
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The generator of one `stream` of a seed; streams of one seed are unrelated.
    pub(crate) fn stream(seed: u64, stream: u64) -> Self {
        let mut chance = Self(seed);
        chance.0 = chance.bits() ^ stream.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        chance.bits();
        chance
    }

    /// The next 64 bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1): the upper 53 bits, which a double holds exactly.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// One of 0 .. `count`.
    pub(crate) fn below(&mut self, count: usize) -> usize {
        (self.bits() % count as u64) as usize
    }

    /// Returns a uniform point on the sphere, from a point of the ball by rejection. Transcendental
    /// functions would differ in their last bit between machines.
    pub(crate) fn portable_direction(&mut self) -> Vector3<f64> {
        loop {
            let mut signed = || 2.0 * self.unit() - 1.0;
            let point = Vector3::new(signed(), signed(), signed());
            let square = point.norm_squared();
            if (1e-4..=1.0).contains(&square) {
                return point / square.sqrt();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_generator_is_the_published_one() {
        // First outputs of SplitMix64 for the seed 1234567 (Rosetta Code).
        let mut chance = Chance::new(1_234_567);
        let first: Vec<u64> = (0..3).map(|_| chance.bits()).collect();
        assert_eq!(
            first,
            [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]
        );
    }

    #[test]
    fn directions_are_even_and_streams_differ() {
        let mut chance = Chance::stream(1, 0);
        let mean = (0..10_000).map(|_| chance.portable_direction()).sum::<Vector3<f64>>() / 1e4;
        assert!(mean.norm() < 0.03, "{mean}");
        assert_ne!(Chance::stream(1, 0).bits(), Chance::stream(1, 1).bits());
    }
}
