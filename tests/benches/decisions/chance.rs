//! Random numbers that are the same in each run.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// A generator of random numbers, the same in each run.
pub struct Chance(u64);

impl Chance {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// A random number from 0 to 1.
    pub fn share(&mut self) -> f64 {
        // xorshift64
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A random direction.
    pub fn direction(&mut self) -> Vector3<f64> {
        loop {
            let at = Vector3::from_fn(|_, _| 2.0 * self.share() - 1.0);
            if (0.1..1.0).contains(&at.norm()) {
                return at.normalize();
            }
        }
    }

    /// A random attitude.
    pub fn attitude(&mut self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(self.direction() * std::f64::consts::PI * self.share())
    }

    /// A start with typical errors of corner poses and predictions.
    pub fn near(&mut self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let range_m = pose.translation.vector.norm();
        let off =
            self.direction() * 0.002 + pose.translation.vector * (0.02 * (self.share() - 0.5));
        let turn = UnitQuaternion::from_scaled_axis(self.direction() * 0.03);
        let position = pose.translation.vector + off * range_m.min(1.0);
        Isometry3::from_parts(Translation3::from(position), turn * pose.rotation)
    }
}
