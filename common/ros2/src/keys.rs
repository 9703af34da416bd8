//! Keys under which rmw_zenoh publishes and announces, and its attachment to each message.
//!
//! The format is that of `rmw_zenoh_cpp` 0.2.4 and later (`docs/design.md`, `liveliness_utils.cpp`
//! and `attachment_helpers.cpp` of ros2/rmw_zenoh).

use xxhash_rust::xxh3::xxh3_128;

use crate::messages::MessageType;

/// Quality of service of every publisher here, in the format of tokens. It contains only the
/// differences from rmw_zenoh's defaults: reliable, volatile, the last 42. Here it is the last 10,
/// as in ROS's default.
const QOS: &str = "::,10:,:,:,,";

/// Length of an attachment, bytes.
pub const ATTACHMENT_BYTES: usize = 33;

/// Key of the messages on `topic` (which begins with '/') in the ROS domain `domain`.
pub fn topic_key(domain: u32, topic: &str, message: MessageType) -> String {
    format!("{domain}/{}/{}/{}", topic.trim_matches('/'), message.dds_name(), message.hash())
}

/// The identity of a node in the ROS graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeIdentity {
    /// The ROS domain.
    pub domain: u32,
    /// The Zenoh session's identifier, hexadecimal.
    pub session: String,
    /// The node's namespace, beginning with '/'.
    pub namespace: String,
    /// The node's name.
    pub name: String,
}

impl NodeIdentity {
    /// Key of the liveliness token that announces the node.
    pub fn token(&self) -> String {
        self.entity_token(0, "NN")
    }

    /// Key of the liveliness token that announces the node's publisher number `entity` (from 1) on
    /// `topic`, which begins with '/'.
    pub fn publisher_token(&self, entity: u32, topic: &str, message: MessageType) -> String {
        format!(
            "{}/{}/{}/{}/{QOS}",
            self.entity_token(entity, "MP"),
            mangled(topic),
            message.dds_name(),
            message.hash(),
        )
    }

    /// A session has one node, so its number is always 0. The enclave, of ROS's security, is `/`.
    fn entity_token(&self, entity: u32, kind: &str) -> String {
        format!(
            "@ros2_lv/{}/{}/0/{entity}/{kind}/%/{}/{}",
            self.domain,
            self.session,
            mangled(&self.namespace),
            self.name
        )
    }
}

/// A name as one chunk of a key.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

/// The identifier of the publisher with the liveliness token `token`. It is the XXH3 hash of 128
/// bits, low half first, each half little-endian.
pub fn gid(token: &str) -> [u8; 16] {
    xxh3_128(token.as_bytes()).to_le_bytes()
}

/// The attachment of each message: number on its topic, from 1; time of sending, nanoseconds since
/// the Unix epoch; publisher. It is in Zenoh's serialization: integers little-endian, a length
/// before the array.
pub fn attachment(sequence: i64, sent_utc_ns: i64, gid: [u8; 16]) -> [u8; ATTACHMENT_BYTES] {
    let mut bytes = [0; ATTACHMENT_BYTES];
    bytes[..8].copy_from_slice(&sequence.to_le_bytes());
    bytes[8..16].copy_from_slice(&sent_utc_ns.to_le_bytes());
    bytes[16] = 16;
    bytes[17..].copy_from_slice(&gid);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node() -> NodeIdentity {
        NodeIdentity {
            domain: 7,
            session: "9a0e3b14f2c85d6170b1c2d3e4f5a6b7".into(),
            namespace: "/wren".into(),
            name: "flockeye".into(),
        }
    }

    #[test]
    fn topics_are_keyed_as_rmw_zenoh_keys_them() {
        assert_eq!(
            topic_key(0, "/wren/neighbours/kite/pose", MessageType::PoseWithCovarianceStamped),
            "0/wren/neighbours/kite/pose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/\
             RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
        );
        assert_eq!(
            topic_key(12, "/tf", MessageType::TfMessage),
            "12/tf/tf2_msgs::msg::dds_::TFMessage_/\
             RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
        );
    }

    #[test]
    fn tokens_are_keyed_as_rmw_zenoh_keys_them() {
        assert_eq!(
            node().token(),
            "@ros2_lv/7/9a0e3b14f2c85d6170b1c2d3e4f5a6b7/0/0/NN/%/%wren/flockeye"
        );
        assert_eq!(
            node().publisher_token(3, "/wren/seen_by/kite/odometry", MessageType::Odometry),
            "@ros2_lv/7/9a0e3b14f2c85d6170b1c2d3e4f5a6b7/0/3/MP/%/%wren/flockeye/\
             %wren%seen_by%kite%odometry/nav_msgs::msg::dds_::Odometry_/\
             RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0/::,10:,:,:,,"
        );
        let alone = NodeIdentity { namespace: "/".into(), ..node() };
        assert!(alone.token().ends_with("/NN/%/%/flockeye"), "a chunk may not be empty");
    }

    #[test]
    fn a_gid_is_the_hash_with_its_low_half_first() {
        let hex =
            |text: &str| gid(text).iter().map(|byte| format!("{byte:02x}")).collect::<String>();
        // XXH3's own test vector: 0x99aa06d3014798d8_6001c324468d497f.
        assert_eq!(hex(""), "7f498d4624c30160d8984701d306aa99");
        // The other values are from the reference implementation, which goes another way above 240
        // bytes.
        let token = node().publisher_token(1, "/tf", MessageType::TfMessage);
        assert_eq!(hex(&token), "0dfd03f2435bd2125908fef8ed8d771f");
        assert_eq!(hex(&"token/".repeat(50)), "9bb9d388c3c6c261a1b9a2c25944dc13");
    }

    #[test]
    fn an_attachment_is_number_time_and_publisher() {
        let gid = std::array::from_fn(|k| 0xa0 + k as u8);
        let bytes = attachment(1, 0x0102_0304_0506_0708, gid);
        assert_eq!(bytes[..8], [1, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bytes[8..16], [8, 7, 6, 5, 4, 3, 2, 1]);
        assert_eq!(bytes[16], 0x10);
        assert_eq!(bytes[17..], gid);
    }
}
