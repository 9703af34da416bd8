//! Message definitions in the form of ROS 2 (`ros2msg`): the fields of a message, then each type
//! that it contains.

use std::fmt::Write;

use flockeye_contract::description::{Kind, TypeDescription};

use crate::layout::{TopicLayout, numbers_of};

/// The separator between two definitions in one text.
const SEPARATOR: &str =
    "================================================================================\n";

/// The definition of a topic's messages, with the types that they contain.
pub fn of_topic(layout: &TopicLayout) -> String {
    let mut text = format!("flockeye_msgs/{} header\n", layout.header.name);
    match &layout.item {
        // Writing to a String cannot fail.
        Some(item) => drop(writeln!(text, "flockeye_msgs/{}[] items", item.name)),
        None => text += "uint64 payload_bytes\n",
    }
    let mut known = Vec::new();
    for described in [Some(&layout.header), layout.item.as_ref()].into_iter().flatten() {
        append(&mut text, layout, described, &mut known);
    }
    text
}

/// Appends a type and the types of its fields, each once.
fn append(
    text: &mut String,
    layout: &TopicLayout,
    described: &TypeDescription,
    known: &mut Vec<&'static str>,
) {
    if known.contains(&described.name) {
        return;
    }
    known.push(described.name);
    *text += SEPARATOR;
    // Writing to a String cannot fail.
    let _ = writeln!(text, "MSG: flockeye_msgs/{}", described.name);
    for field in &described.fields {
        let kind = match (&field.kind, numbers_of(&field.kind)) {
            (Kind::Type(inner), _) => format!("flockeye_msgs/{inner}"),
            (_, Some((number, count))) => {
                let array = count.map(|count| format!("[{count}]")).unwrap_or_default();
                format!("{}{array}", ros_number(number))
            }
            (_, None) => "string".to_owned(),
        };
        let _ = writeln!(text, "{kind} {}", field.name);
    }
    for field in &described.fields {
        if let Kind::Type(inner) = &field.kind
            && let Some(inner) = layout.type_named(inner)
        {
            append(text, layout, inner, known);
        }
    }
}

fn ros_number(name: &str) -> &'static str {
    match name {
        "u8" => "uint8",
        "u32" => "uint32",
        "u64" => "uint64",
        "i64" => "int64",
        "f32" => "float32",
        _ => "float64",
    }
}

/// `builtin_interfaces/msg/Time` and `std_msgs/msg/Header`, which other types contain.
macro_rules! header {
    () => {
        "================================================================================\n\
         MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
         ================================================================================\n\
         MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    };
}

/// `geometry_msgs/msg/PoseWithCovarianceStamped`.
pub const POSE: &str = concat!(
    "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    header!(),
    "================================================================================\n\
     MSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n\
     ================================================================================\n\
     MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n\
     ================================================================================\n\
     MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n\
     ================================================================================\n\
     MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
);

/// `tf2_msgs/msg/TFMessage`.
pub const TRANSFORMS: &str = concat!(
    "geometry_msgs/TransformStamped[] transforms\n\
     ================================================================================\n\
     MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n\
     geometry_msgs/Transform transform\n",
    header!(),
    "================================================================================\n\
     MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n\
     ================================================================================\n\
     MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n\
     ================================================================================\n\
     MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
);

/// `sensor_msgs/msg/Image`.
pub const IMAGE: &str = concat!(
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
     uint32 step\nuint8[] data\n",
    header!()
);

/// `sensor_msgs/msg/CompressedImage`.
pub const COMPRESSED_IMAGE: &str =
    concat!("std_msgs/Header header\nstring format\nuint8[] data\n", header!());

/// `foxglove_msgs/msg/CompressedVideo`.
pub const COMPRESSED_VIDEO: &str = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n\
     ================================================================================\n\
     MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

/// `flockeye_msgs/msg/Loss`: messages of a topic that are missing since the recording began.
pub const LOSS: &str = "string topic\nuint64 recorded\nuint64 refused\nuint64 missing\nuint64 buffer_full\n\
     uint64 queue_full\n";

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::layout::layouts;

    #[test]
    fn a_topics_definition_has_all_types_once() {
        let all = layouts();
        let detections = all.iter().find(|layout| layout.service == "flockeye/detection").unwrap();
        let text = of_topic(detections);
        assert!(text.starts_with(
            "flockeye_msgs/DetectionHeader header\nflockeye_msgs/DetectedMarker[] items\n====="
        ));
        assert!(text.contains("MSG: flockeye_msgs/DetectedMarker\nfloat64[12] rays_in_camera\n"));
        assert!(text.contains("float32[8] corners_in_view\n"));
        assert_eq!(text.matches("MSG: flockeye_msgs/FrameStamp\n").count(), 1);
        let frame = all.iter().find(|layout| layout.service == "flockeye/frame").unwrap();
        assert!(
            of_topic(frame).starts_with("flockeye_msgs/FrameHeader header\nuint64 payload_bytes\n")
        );
    }
}
