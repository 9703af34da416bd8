//! The `flockeye-replay` command.

fn main() -> std::process::ExitCode {
    flockeye_runtime::logs::init();
    flockeye_replay::commands::run()
}
