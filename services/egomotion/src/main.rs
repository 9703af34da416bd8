//! The egomotion stage's process.

fn main() -> std::process::ExitCode {
    flockeye_egomotion::main()
}
