//! The keys of what observers publish.

/// Maximum characters of a swarm's, an observer's or a target's name.
pub const MAX_NAME_CHARS: usize = 31;

/// Key of the frame reports of `observer`.
pub fn frame_key(swarm: &str, observer: &str) -> String {
    format!("flockeye/{swarm}/{observer}/sees")
}

/// Key expression of all that `observer` publishes, or of all in `swarm`.
pub fn all_keys(swarm: &str, observer: Option<&str>) -> String {
    match observer {
        Some(observer) => format!("flockeye/{swarm}/{observer}/**"),
        None => format!("flockeye/{swarm}/**"),
    }
}

/// Key of the liveliness token of `observer`.
pub fn alive_key(swarm: &str, observer: &str) -> String {
    format!("flockeye/{swarm}/{observer}/alive")
}

/// Key expression of all frame reports in `swarm`.
pub fn all_frames_key(swarm: &str) -> String {
    frame_key(swarm, "*")
}

/// Key expression of all liveliness tokens in `swarm`.
pub fn all_alive_key(swarm: &str) -> String {
    alive_key(swarm, "*")
}

/// Whether `name` can stand in a key: letters, digits, `-`, `_` and `.`, 1 to 31 of them.
pub fn is_name(name: &str) -> bool {
    (1..=MAX_NAME_CHARS).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_could_break_a_key_are_refused() {
        assert!(is_name("drone-1"));
        for name in ["", "a/b", "a*", "$", "ä", &"x".repeat(32)] {
            assert!(!is_name(name), "{name}");
        }
    }
}
