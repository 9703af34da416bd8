//! The simulator stage's process.

fn main() -> std::process::ExitCode {
    flockeye_simulator::main()
}
