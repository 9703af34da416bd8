//! The ROS 2 stage's process.

fn main() -> std::process::ExitCode {
    flockeye_ros2_stage::main()
}
