//! Names of pipelines on a machine.

/// Whether `name` can be an instance's: 1 to 31 letters, digits, `-` and `_`. It becomes the name
/// of a folder that is emptied, so nothing that leads elsewhere (`..`, a path) is one.
pub fn is_instance_name(name: &str) -> bool {
    (1..=31).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte))
}
