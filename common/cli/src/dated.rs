//! File names that contain the time at which the file was begun.

use std::time::SystemTime;

/// Candidate file names for a time, in order of preference: `STEM-20260102T030405Z`, then
/// `STEM-20260102T030405Z-1` and so on.
pub fn names(stem: &str, time: SystemTime) -> impl Iterator<Item = String> + use<> {
    let time = humantime::format_rfc3339_seconds(time).to_string().replace(['-', ':'], "");
    let first = format!("{stem}-{time}");
    (0_u32..).map(move |count| match count {
        0 => first.clone(),
        count => format!("{first}-{count}"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn several_of_a_second_are_numbered() {
        let time = SystemTime::UNIX_EPOCH + Duration::from_millis(1_700_000_000_900);
        let found: Vec<String> = names("lost", time).take(3).collect();
        let wanted =
            ["lost-20231114T221320Z", "lost-20231114T221320Z-1", "lost-20231114T221320Z-2"];
        assert_eq!(found, wanted);
    }
}
