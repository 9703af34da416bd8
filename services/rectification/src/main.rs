//! The rectification stage's process.

fn main() -> std::process::ExitCode {
    flockeye_rectification::main()
}
