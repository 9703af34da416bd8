//! Publishers and their slowest readers, over real shared memory.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::rc::Rc;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use flockeye_config::{Pipeline, Profile, Resolved};
use flockeye_contract::{FrameStamp, ViewHeader, Views};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber, create_services};
use iceoryx2::prelude::{Node, NodeBuilder, SignalHandlingMode, ipc};

const SIDE_PX: usize = 8;
const WATCHDOG: Duration = Duration::from_secs(60);

fn budget(profile: Profile) -> Budget {
    let mut pipeline = Pipeline { profile, ..Pipeline::default() };
    pipeline.rectification.overdue_ms = 50.0;
    Budget::for_views_of(&Resolved::of(pipeline).unwrap(), SIDE_PX as u32)
}

fn node_of(instance: &Instance) -> Rc<Node<ipc::Service>> {
    let builder = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&instance.iceoryx2().unwrap());
    Rc::new(builder.create().unwrap())
}

/// Ports of a process of a running instance.
fn ports_of(instance: &Instance, profile: Profile) -> Ports {
    Ports::new(node_of(instance), budget(profile), SharedCounters::default())
}

fn buffer(profile: Profile) -> u64 {
    budget(profile).topic::<Views>().usual_buffer as u64
}

/// Runs `body` with an instance of its own, and fails when it does not come back.
fn with_instance(name: &str, profile: Profile, body: impl FnOnce(&Instance) + Send + 'static) {
    let instance = Instance::named(&format!("test-{name}-{}", std::process::id()));
    let (done, finished) = mpsc::channel();
    let test = thread::spawn(move || {
        let ownership = instance.take().unwrap();
        let node = node_of(&instance);
        let services = create_services::<Views>(&node, budget(profile).topic::<Views>()).unwrap();
        body(&instance);
        drop((services, node, ownership));
        assert!(instance.shared_memory().is_empty(), "{:?}", instance.shared_memory());
        // The watchdog may be gone already.
        let _ = done.send(());
    });
    let is_over = finished.recv_timeout(WATCHDOG);
    assert!(is_over.is_ok() || test.is_finished(), "it hangs");
    test.join().unwrap();
}

fn send(publisher: &Publisher<Views>, sequence: u64) {
    let header = ViewHeader {
        stamp: FrameStamp { sequence, ..FrameStamp::default() },
        camera_from_view: [0.0, 0.0, 0.0, 1.0],
        focal_px: 8.0,
        size_px: SIDE_PX as u32,
        stride: SIDE_PX as u32,
        ..ViewHeader::default()
    };
    publisher.send(header, &[7; SIDE_PX * SIDE_PX]).unwrap();
}

fn received(subscriber: &mut Subscriber<Views>) -> Vec<u64> {
    std::iter::from_fn(|| subscriber.receive().unwrap())
        .map(|message| message.header.stamp.sequence)
        .collect()
}

#[test]
fn in_flight_the_newest_wins_and_nobody_waits() {
    with_instance("newest", Profile::Flight, |instance| {
        let mut ports = ports_of(instance, Profile::Flight);
        let mut reader = ports.subscriber::<Views>().unwrap();
        let publisher = ports.publisher::<Views>().unwrap();
        assert!(reader.connect().unwrap());
        let all = buffer(Profile::Flight) + 3;
        (0..all).for_each(|sequence| send(&publisher, sequence));
        assert_eq!(received(&mut reader), (3..all).collect::<Vec<_>>());
    });
}

#[test]
fn a_lossless_publisher_waits_for_a_slow_reader() {
    with_instance("slow", Profile::Repeat, |instance| {
        let all = 5 * buffer(Profile::Repeat);
        let (ready, is_ready) = mpsc::channel();
        let (full, is_full) = mpsc::channel();
        thread::scope(|scope| {
            let reader = scope.spawn(move || {
                let mut ports = ports_of(instance, Profile::Repeat);
                let mut reader = ports.subscriber::<Views>().unwrap();
                ready.send(reader.connect().unwrap()).unwrap();
                while !reader.connect().unwrap() {
                    thread::sleep(Duration::from_millis(1));
                }
                ready.send(true).unwrap();
                // Nothing is taken before the publisher has filled the lane.
                is_full.recv().unwrap();
                let mut seen = Vec::new();
                while (seen.len() as u64) < all {
                    seen.extend(received(&mut reader));
                }
                seen
            });
            assert!(!is_ready.recv().unwrap(), "nobody publishes yet");
            let publisher = ports_of(instance, Profile::Repeat).publisher::<Views>().unwrap();
            assert!(is_ready.recv().unwrap());
            for sequence in 0..all {
                if sequence == buffer(Profile::Repeat) {
                    full.send(()).unwrap();
                }
                send(&publisher, sequence);
            }
            assert_eq!(reader.join().unwrap(), (0..all).collect::<Vec<_>>());
        });
    });
}

#[test]
fn a_reader_that_takes_nothing_costs_a_lossless_publisher_one_wait() {
    with_instance("dead", Profile::Repeat, |instance| {
        let mut ports = ports_of(instance, Profile::Repeat);
        let mut dead = ports.subscriber::<Views>().unwrap();
        let mut reader = ports.subscriber::<Views>().unwrap();
        let publisher = ports.publisher::<Views>().unwrap();
        assert!(dead.connect().unwrap() && reader.connect().unwrap());
        // With a wait for each of them the watchdog would bite.
        let mut seen = Vec::new();
        for sequence in 0..2_000 {
            send(&publisher, sequence);
            seen.extend(received(&mut reader));
        }
        assert_eq!(seen, (0..2_000).collect::<Vec<_>>(), "who reads misses nothing");
        let kept = (0..buffer(Profile::Repeat)).collect::<Vec<_>>();
        assert_eq!(received(&mut dead), kept, "nothing gave way to what came later");
    });
}

/// The umask of the calling thread.
fn umask() -> String {
    let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
    status.lines().find(|line| line.starts_with("Umask:")).unwrap().to_owned()
}

#[test]
fn listeners_that_come_and_go_leave_the_umask_of_other_threads_alone() {
    with_instance("umask", Profile::Flight, |instance| {
        let before = umask();
        thread::scope(|scope| {
            let listening = [(); 2].map(|()| {
                scope.spawn(|| {
                    for _ in 0..200 {
                        ports_of(instance, Profile::Flight).subscriber::<Views>().unwrap();
                    }
                })
            });
            while listening.iter().any(|thread| !thread.is_finished()) {
                assert_eq!(umask(), before);
            }
        });
        assert_eq!(umask(), before);
    });
}
