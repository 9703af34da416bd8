//! The detection stage's process.

fn main() -> std::process::ExitCode {
    flockeye_detection::main()
}
