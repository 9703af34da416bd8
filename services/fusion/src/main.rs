//! The fusion stage's process.

fn main() -> std::process::ExitCode {
    flockeye_fusion::main()
}
