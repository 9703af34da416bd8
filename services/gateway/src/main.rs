//! The gateway stage's process.

fn main() -> std::process::ExitCode {
    flockeye_gateway::main()
}
