//! The autopilot stage's process.

fn main() -> std::process::ExitCode {
    flockeye_autopilot_stage::main()
}
