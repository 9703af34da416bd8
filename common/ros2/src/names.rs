//! Conversion of drones' names to valid ROS names.
//!
//! A drone's name may have `-` and `.`, and begin with a digit. A name in a ROS topic cannot (ROS
//! 2's design article "Topic and Service name mapping to DDS").

use std::collections::{BTreeMap, btree_map::Entry};

use flockeye_contract::wire::{is_name, shortened};

use crate::error::{MAX_DRONES, Ros2Error};

/// A drone's name in ROS. Each run of characters that are neither letter nor digit becomes one `_`.
/// A name that does not begin with a letter gets an `n` before it: `kite-2` is `kite_2`, and `7` is
/// `n7`. So two names may become the same.
pub fn ros_name(name: &str) -> String {
    let mut mapped = String::with_capacity(name.len() + 1);
    if !name.starts_with(|first: char| first.is_ascii_alphabetic()) {
        mapped.push('n');
    }
    for character in name.chars() {
        if character.is_ascii_alphanumeric() {
            mapped.push(character);
        } else if !mapped.ends_with('_') {
            mapped.push('_');
        }
    }
    mapped
}

/// The topic of a neighbour's poses. `namespace` is the observer's, such as `/wren`, `target` a
/// name in ROS.
pub fn pose_topic(namespace: &str, target: &str) -> String {
    format!("{namespace}/neighbours/{target}/pose")
}

/// The topic of all transforms.
pub const TRANSFORMS: &str = "/tf";

/// The other drones, each with a name of its own in ROS.
#[derive(Debug)]
pub(crate) struct Names {
    observer: String,
    observer_ros: String,
    by_ros: BTreeMap<String, String>,
}

impl Names {
    pub(crate) fn new(observer: &str) -> Self {
        Self {
            observer: observer.into(),
            observer_ros: ros_name(observer),
            by_ros: BTreeMap::new(),
        }
    }

    /// Returns the name in ROS of the drone `name`. A new drone is added.
    pub(crate) fn admit(&mut self, name: &str) -> Result<String, Ros2Error> {
        let refused = |reason| Ros2Error::Name { name: shortened(name), reason };
        if !is_name(name) {
            return Err(refused("has no name of 1 to 31 letters, digits, '-', '_' or '.'"));
        }
        if name == self.observer {
            return Err(refused("is the observer itself"));
        }
        let mapped = ros_name(name);
        let collides = |other: &str| Ros2Error::Collision {
            name: name.into(),
            other: other.into(),
            ros_name: mapped.clone(),
        };
        if mapped == self.observer_ros {
            return Err(collides(&self.observer));
        }
        let is_full = self.by_ros.len() == MAX_DRONES;
        match self.by_ros.entry(mapped.clone()) {
            Entry::Occupied(known) if known.get() != name => return Err(collides(known.get())),
            Entry::Occupied(_) => {}
            Entry::Vacant(_) if is_full => {
                return Err(Ros2Error::TooManyDrones(name.into()));
            }
            Entry::Vacant(new) => {
                if mapped != name {
                    tracing::info!("drone '{name}' is '{mapped}' in ROS, for its rules of names");
                }
                new.insert(name.into());
            }
        }
        Ok(mapped)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn names_become_what_ros_allows() {
        for (name, mapped) in [
            ("kite", "kite"),
            ("Kite_2", "Kite_2"),
            ("kite-2", "kite_2"),
            ("kite.2", "kite_2"),
            ("a-._b", "a_b"),
            ("7", "n7"),
            ("-x", "n_x"),
            ("_x", "n_x"),
            ("...", "n_"),
        ] {
            assert_eq!(ros_name(name), mapped, "{name}");
        }
    }

    #[test]
    fn two_drones_that_would_be_one_are_refused() {
        let mut names = Names::new("wren.1");
        assert_eq!(names.admit("kite-2").unwrap(), "kite_2");
        assert_eq!(names.admit("kite-2").unwrap(), "kite_2", "the first goes on");
        let error = names.admit("kite.2").expect_err("collides").to_string();
        assert!(error.contains("'kite.2' and drone 'kite-2'") && error.contains("Cure"), "{error}");
        let error = names.admit("wren-1").expect_err("collides with the observer");
        assert!(matches!(error, Ros2Error::Collision { .. }), "{error}");
        let error = names.admit("wren.1").expect_err("is the observer");
        assert!(error.to_string().contains("observer itself"), "{error}");
    }

    #[test]
    fn drones_are_bounded_and_known_ones_go_on() {
        let mut names = Names::new("wren");
        (0..MAX_DRONES).for_each(|k| drop(names.admit(&format!("t{k}")).unwrap()));
        assert!(matches!(names.admit("one-more"), Err(Ros2Error::TooManyDrones(_))));
        names.admit("t0").unwrap();
    }

    proptest! {
        #[test]
        fn whatever_is_admitted_is_a_name_in_ros(name in "\\PC{0,40}|[-_.a-zA-Z0-9]{1,31}") {
            let Ok(mapped) = Names::new("wren").admit(&name) else { return Ok(()) };
            prop_assert!(mapped.len() <= flockeye_contract::wire::MAX_NAME_CHARS + 1);
            prop_assert!(mapped.starts_with(|first: char| first.is_ascii_alphabetic()));
            let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'_';
            prop_assert!(mapped.bytes().all(is_plain) && !mapped.contains("__"));
        }
    }
}
