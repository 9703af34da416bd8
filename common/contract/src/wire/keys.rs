//! The keys that observers speak under.

/// Most characters of a swarm's, an observer's or a target's name.
pub const MAX_NAME_CHARS: usize = 31;

/// Key under which `observer` reports all it sees, frame by frame.
pub fn frame_key(swarm: &str, observer: &str) -> String {
    format!("flockeye/{swarm}/{observer}/sees")
}

/// Key under which `observer` reports on `target`.
pub fn pose_key(swarm: &str, observer: &str, target: &str) -> String {
    format!("flockeye/{swarm}/{observer}/sees/{target}/pose")
}

/// Key under which `observer` reports on `target` while the track is not confirmed: it may be nobody.
pub fn tentative_key(swarm: &str, observer: &str, target: &str) -> String {
    format!("flockeye/{swarm}/{observer}/sees/{target}/tentative")
}

/// Key expression of all that `observer` says, or all in `swarm`.
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

/// Key of the liveliness token that says that `observer` publishes [`FrameReport`](super::FrameReport)s,
/// so that nobody needs to listen to its poses one by one too.
pub fn frames_token_key(swarm: &str, observer: &str) -> String {
    format!("flockeye/{swarm}/{observer}/alive/frames")
}

/// Key expression of all frame reports in `swarm`.
pub fn all_frames_key(swarm: &str) -> String {
    frame_key(swarm, "*")
}

/// Key expression of all liveliness tokens in `swarm`.
pub fn all_alive_key(swarm: &str) -> String {
    alive_key(swarm, "*")
}

/// Key expression of the tokens of all that publish frame reports.
pub fn all_frames_token_key(swarm: &str) -> String {
    frames_token_key(swarm, "*")
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
