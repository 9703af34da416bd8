//! The capture stage's process.

fn main() -> std::process::ExitCode {
    flockeye_capture::main()
}
