//! The node among real sessions on the loopback interface: routers, and those that listen to them.
//!
//! Nothing here waits for a fixed time: a test waits for what must happen, and its watchdog fails
//! it when that does not.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::{
    collections::BTreeSet,
    net::TcpListener,
    sync::{
        Arc,
        atomic::{AtomicI64, Ordering::SeqCst},
    },
    thread,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use common::{Relay, free_port, neighbour, parameters, router, seen, session, tcp, until, watched};
use flockeye_ros2::{
    Ros2Error, Ros2Node, Ros2Parameters, keys,
    messages::{MessageType, PoseWithCovarianceStamped, Ros2Message, Time},
};
use zenoh::{Session, Wait, sample::Sample};

const POSE: MessageType = MessageType::PoseWithCovarianceStamped;
const KITE: &str = "/wren/neighbours/kite/pose";

/// The keys of all liveliness tokens in domain 3.
fn tokens(session: &Session) -> BTreeSet<String> {
    let replies = session.liveliness().get("@ros2_lv/3/**").wait().unwrap();
    replies
        .into_iter()
        .filter_map(|reply| Some(reply.result().ok()?.key_expr().to_string()))
        .collect()
}

fn bytes(sample: &Sample) -> (Vec<u8>, Vec<u8>) {
    let attachment = sample.attachment().expect("an attachment").to_bytes().into_owned();
    (sample.payload().to_bytes().into_owned(), attachment)
}

fn number(bytes: &[u8]) -> i64 {
    i64::from_le_bytes(bytes.try_into().unwrap())
}

/// Publishes a pose and waits until it was handed to Zenoh.
fn publish(node: &Ros2Node, target: &str) {
    let before = node.counters().sent;
    node.publish_neighbour(&neighbour(target)).unwrap();
    until(|| (node.counters().sent > before).then_some(()));
}

#[test]
fn the_node_and_its_publishers_are_announced_and_withdrawn() {
    watched(|| {
        let port = free_port();
        let router = router(port);
        let node = Ros2Node::open(&parameters(port), "wren").unwrap();
        until(|| node.is_open().then_some(()));
        let alone = until(|| Some(tokens(&router)).filter(|tokens| tokens.len() == 1));
        let token = alone.first().unwrap().clone();
        let identity = keys::NodeIdentity {
            domain: 3,
            session: token.split('/').nth(2).unwrap().into(),
            namespace: "/wren".into(),
            name: "flockeye".into(),
        };
        assert_eq!(token, identity.token());
        let linked: Vec<_> = router.info().peers_zid().wait().map(|zid| zid.to_string()).collect();
        assert!(linked.is_empty(), "the node is a client, not a peer: {linked:?}");

        publish(&node, "kite");
        let kite = neighbour("kite");
        node.publish_transforms(std::slice::from_ref(&kite)).unwrap();
        until(|| (node.counters().sent == 2).then_some(()));
        node.publish_odometry(&seen("kite")).unwrap();
        let wanted = BTreeSet::from([
            token,
            identity.publisher_token(1, KITE, POSE),
            identity.publisher_token(2, "/tf", MessageType::TfMessage),
            identity.publisher_token(3, "/wren/seen_by/kite/odometry", MessageType::Odometry),
        ]);
        until(|| (tokens(&router) == wanted).then_some(()));
        drop(node);
        until(|| tokens(&router).is_empty().then_some(()));
    });
}

#[test]
fn a_message_has_its_bytes_its_number_its_time_and_its_publisher() {
    watched(|| {
        let port = free_port();
        let router = router(port);
        let samples = router.declare_subscriber(keys::topic_key(3, KITE, POSE)).wait().unwrap();
        let node = Ros2Node::open(&parameters(port), "wren").unwrap();
        until(|| node.is_open().then_some(()));

        let now_ns = || {
            let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
            i64::try_from(since.as_nanos()).unwrap()
        };
        let (before_ns, mut published, mut heard) = (now_ns(), 0, Vec::new());
        // The first may go before the subscription has come: each that is heard has its number all
        // the same.
        while heard.len() < 3 {
            publish(&node, "kite");
            published += 1;
            while let Ok(Some(sample)) = samples.recv_timeout(Duration::from_millis(50)) {
                heard.push((published, sample));
            }
        }
        let token = tokens(&router).into_iter().find(|token| token.contains("/MP/")).unwrap();
        for (published, sample) in heard {
            let (payload, attachment) = bytes(&sample);
            assert_eq!(attachment.len(), keys::ATTACHMENT_BYTES);
            assert_eq!(number(&attachment[..8]), published, "numbers rise from 1");
            let sent_ns = number(&attachment[8..16]);
            assert!((before_ns..=now_ns()).contains(&sent_ns), "{before_ns} {sent_ns}");
            assert_eq!(attachment[16], 16);
            assert_eq!(attachment[17..], keys::gid(&token));
            assert_eq!(payload, expected().to_cdr().unwrap());
        }
    });
}

/// [`neighbour`] as a message.
fn expected() -> PoseWithCovarianceStamped {
    let neighbour = neighbour("kite");
    let mut message = PoseWithCovarianceStamped::default();
    message.header.frame_id = "wren/base_link".into();
    message.header.stamp = Time::from_utc_ns(neighbour.stamp_utc_ns).unwrap();
    message.pose.position = neighbour.position;
    message.pose.orientation = neighbour.orientation;
    for (k, value) in neighbour.covariance.into_iter().enumerate() {
        message.pose.covariance[k / 6][k % 6] = value;
    }
    message
}

/// Hears of kite, whatever it takes; the publisher goes on until then.
fn assert_heard(session: &Session, node: &Ros2Node) {
    let samples = session.declare_subscriber(keys::topic_key(3, KITE, POSE)).wait().unwrap();
    let sample = until(|| {
        node.publish_neighbour(&neighbour("kite")).unwrap();
        samples.recv_timeout(Duration::from_millis(50)).unwrap()
    });
    assert_eq!(bytes(&sample).0, expected().to_cdr().unwrap());
}

#[test]
fn a_router_is_found_when_it_comes_and_when_it_comes_again() {
    watched(|| {
        let nobody = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = nobody.local_addr().unwrap().port();
        let node = Ros2Node::open(&parameters(port), "wren").unwrap();
        node.publish_neighbour(&neighbour("kite")).unwrap();
        // It has tried by now.
        drop(nobody.accept().unwrap());
        assert!(!node.is_open());
        drop(nobody);

        let first = router(port);
        assert_heard(&first, &node);
        assert!(node.is_open());
        first.close().wait().unwrap();
        drop(first);
        let second = router(port);
        assert_heard(&second, &node);
        until(|| (tokens(&second).len() == 2).then_some(()));
    });
}

/// Such as Flockeye's own gateway, which listens on the port of ROS's router by default.
#[test]
fn a_session_that_passes_nothing_on_is_no_router() {
    watched(|| {
        let port = free_port();
        let gateway = session("peer", Some(port), None);
        let relay = Relay::start(port);
        let node = Ros2Node::open(&parameters(relay.port), "wren").unwrap();
        node.publish_neighbour(&neighbour("kite")).unwrap();
        // The second time it knows of the first.
        until(|| (relay.links.load(SeqCst) == 2).then_some(()));
        assert_eq!((node.is_open(), node.counters().sent), (false, 0));
        gateway.close().wait().unwrap();
        drop(gateway);
        let router = router(port);
        assert_heard(&router, &node);
    });
}

/// Neither a port where nobody listens nor one where somebody accepts and then says nothing holds
/// the caller up.
#[test]
fn routers_out_of_reach_hold_nothing_up() {
    watched(|| {
        let mute = TcpListener::bind("127.0.0.1:0").unwrap();
        let mute_port = mute.local_addr().unwrap().port();
        let connect = vec![tcp(free_port()), tcp(mute_port)];
        let parameters = Ros2Parameters { connect, ..parameters(0) };
        let start = Instant::now();
        let node = Ros2Node::open(&parameters, "wren").unwrap();
        for _ in 0..1_000 {
            node.publish_neighbour(&neighbour("kite")).unwrap();
            node.publish_transforms(&[neighbour("kite"), neighbour("swift")]).unwrap();
            node.publish_odometry(&seen("kite")).unwrap();
        }
        assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
        let counters = node.counters();
        assert_eq!(counters.failed, 0);
        assert_eq!((node.is_open(), counters.sent), (false, 0));
        assert_eq!(counters.overwritten, 3 * 999, "one waits for each topic");
        drop(node);
    });
}

#[test]
fn a_link_that_stalls_holds_nobody_up_and_then_has_what_is_current() {
    watched(|| {
        let port = free_port();
        let router = router(port);
        let relay = Relay::start(port);
        let (count, newest) = (Arc::new(AtomicI64::new(0)), Arc::new(AtomicI64::new(0)));
        let _subscriber = router
            .declare_subscriber(keys::topic_key(3, KITE, POSE))
            .callback({
                let (count, newest) = (count.clone(), newest.clone());
                move |sample| {
                    newest.store(number(&bytes(&sample).1[..8]), SeqCst);
                    count.fetch_add(1, SeqCst);
                }
            })
            .wait()
            .unwrap();
        let node = Ros2Node::open(&parameters(relay.port), "wren").unwrap();
        assert_heard(&router, &node);

        relay.stalled.store(true, SeqCst);
        let mut longest = Duration::ZERO;
        let before = node.counters().sent;
        // More than a megabyte: more than all the buffers on the way hold.
        while node.counters().sent < before + 4_000 {
            let start = Instant::now();
            node.publish_neighbour(&neighbour("kite")).unwrap();
            longest = longest.max(start.elapsed());
            // Leaves the lock to the other side.
            thread::sleep(Duration::from_micros(100));
        }
        assert!(longest < Duration::from_secs(1), "{longest:?}");
        assert_eq!(node.counters().failed, 0);
        relay.stalled.store(false, SeqCst);

        let stalled_until = i64::try_from(node.counters().sent).unwrap();
        until(|| {
            publish(&node, "kite");
            (newest.load(SeqCst) > stalled_until).then_some(())
        });
        // What could not go out was dropped, not kept for later.
        let heard = count.load(SeqCst);
        assert!(heard < stalled_until / 2, "{heard} of {stalled_until}");

        relay.stalled.store(true, SeqCst);
        // Ends all the same; the watchdog says if not.
        drop(node);
    });
}

#[test]
fn one_bad_neighbour_costs_the_others_nothing() {
    watched(|| {
        let port = free_port();
        let router = router(port);
        let key = keys::topic_key(3, "/tf", MessageType::TfMessage);
        let samples = router.declare_subscriber(key).wait().unwrap();
        let node = Ros2Node::open(&parameters(port), "wren").unwrap();
        let mut nowhere = neighbour("swift");
        nowhere.position[1] = f64::NAN;
        let all = ["kite-2", "kite.2", "wren", "a/b", "robin"].map(neighbour);
        let all: Vec<_> = [vec![nowhere], all.to_vec()].concat();
        let sample = until(|| {
            let refused = node.publish_transforms(&all).expect_err("the first is refused");
            assert!(matches!(refused, Ros2Error::Pose { .. }), "{refused}");
            samples.recv_timeout(Duration::from_millis(50)).unwrap()
        });
        let payload = bytes(&sample).0;
        let has = |text: &str| payload.windows(text.len()).any(|part| part == text.as_bytes());
        assert_eq!(payload[4..8], [2, 0, 0, 0], "two transforms");
        assert!(has("kite_2_seen_by_wren\0") && has("robin_seen_by_wren\0"));

        let collides = node.publish_neighbour(&neighbour("kite.2")).expect_err("collides");
        assert!(matches!(collides, Ros2Error::Collision { .. }), "{collides}");
        let itself = node.publish_odometry(&seen("wren")).expect_err("is the observer");
        assert!(matches!(itself, Ros2Error::Name { .. }), "{itself}");
        assert!(node.counters().failed >= 3);
    });
}

#[test]
fn names_and_namespaces_that_ros_does_not_allow() {
    let refused = |parameters: &Ros2Parameters, observer: &str| {
        Ros2Node::open(parameters, observer).expect_err("refused").to_string()
    };
    assert!(refused(&parameters(1), "a/b").contains("'a/b'"));
    let namespace = Ros2Parameters { namespace: "swarm".into(), ..parameters(1) };
    assert!(refused(&namespace, "wren").starts_with("namespace"));
}

#[test]
fn a_namespace_is_before_all_but_tf() {
    watched(|| {
        let port = free_port();
        let router = router(port);
        let parameters = Ros2Parameters { namespace: "/swarm".into(), ..parameters(port) };
        let node = Ros2Node::open(&parameters, "wren-1").unwrap();
        node.publish_neighbour(&neighbour("kite")).unwrap();
        node.publish_transforms(&[neighbour("kite")]).unwrap();
        let tokens = until(|| Some(tokens(&router)).filter(|tokens| tokens.len() == 3));
        let has = |text: &str| tokens.iter().any(|token| token.contains(text));
        assert!(has("/NN/%/%swarm%wren_1/flockeye"), "{tokens:?}");
        assert!(has("/flockeye/%swarm%wren_1%neighbours%kite%pose/"), "{tokens:?}");
        assert!(has("/flockeye/%tf/"), "{tokens:?}");
    });
}
