//! The inertial stage's process.

fn main() -> std::process::ExitCode {
    flockeye_inertial::main()
}
