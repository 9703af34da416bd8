//! A detector that is written from docs/CONTRACT.md alone, without the runtime. It acknowledges
//! every view, and never finds a marker.
//!
//! With an argument it misbehaves in one way:
//!
//! | argument | what it does |
//! | --- | --- |
//! | `mute` | receives views and answers none |
//! | `hold` | receives views, keeps them and answers none |
//! | `spin` | receives nothing and uses a whole processor |
//! | `hang` | reports that it is ready, and then sends nothing |
//! | `late` | never reports that it is ready |
//! | `lie` | sends before each record one whose hit count is larger than its markers |
//! | `impersonate` | sends before each record one of a worker that does not exist |
//! | `leave` | ends after it has replaced another process |

use std::error::Error;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use flockeye_contract::{
    CONTRACT_VERSION, DetectionHeader, Detections, HandOver, HandOverState, HandOvers, Health,
    Healths, StageState, Topic, VERSION_ATTRIBUTE, ViewHeader, Views,
};
use iceoryx2::config::Config;
use iceoryx2::node::Node;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::*;

fn main() -> Result<(), Box<dyn Error>> {
    set_log_level(LogLevel::Fatal);
    let misdeed = std::env::args().nth(1).unwrap_or_default();
    let folder = PathBuf::from(std::env::var("FLOCKEYE_INSTANCE_DIR")?);
    let worker: u32 = std::env::var("FLOCKEYE_REPLICA")?.parse()?;
    let generation: u32 = std::env::var("FLOCKEYE_GENERATION")?.parse()?;
    let file = folder.join("iceoryx2.toml");
    let config = Config::from_file(&FilePath::new(file.to_string_lossy().as_bytes())?)?;
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>()?;

    // Each worker has its own lane of views.
    let lane: ServiceName = format!("{}/{worker}", Views::NAME).as_str().try_into()?;
    let version = AttributeVerifier::new()
        .require(&VERSION_ATTRIBUTE.try_into()?, &CONTRACT_VERSION.try_into()?)?;
    let views = node
        .service_builder(&lane)
        .publish_subscribe::<[u8]>()
        .user_header::<ViewHeader>()
        .open_with_attributes(&version)?
        .subscriber_builder()
        .create()?;
    let wake = node.service_builder(&lane).event().open()?.listener_builder().create()?;
    let records = Output::<Detections>::open(&node, &version)?;
    let health = Output::<Healths>::open(&node, &version)?;

    let name: ServiceName = HandOvers::NAME.try_into()?;
    let hand_overs = node
        .service_builder(&name)
        .publish_subscribe::<[u8]>()
        .user_header::<HandOver>()
        .open_with_attributes(&version)?
        .subscriber_builder()
        .create()?;

    let start = Instant::now();
    let mut report = Health {
        stage: "detection".into(),
        detail: "finds nothing".into(),
        replica: worker,
        generation,
        pid: std::process::id(),
        state: StageState::Ready.code(),
        latency_median_ns: -1,
        latency_p99_ns: -1,
        ..Health::default()
    };
    if misdeed == "late" {
        report.state = StageState::Starting.code();
    }
    let mut next_report = start;
    let mut held = Vec::new();
    // The launcher ends this process with SIGTERM, which is not handled here.
    loop {
        if Instant::now() >= next_report {
            report.sent_ns = now_ns();
            health.send(report, &[])?;
            next_report = Instant::now() + Duration::from_millis(250);
        }
        match misdeed.as_str() {
            "hang" => std::thread::sleep(Duration::from_secs(600)),
            "spin" => continue,
            "leave" => {
                while let Some(word) = hand_overs.receive()? {
                    if word.user_header().state == HandOverState::TakenOver.code() {
                        return Ok(());
                    }
                }
            }
            _ => {}
        }
        wake.timed_wait(|_| {}, Duration::from_millis(100))?;
        if misdeed == "hold" {
            // The number of messages that it may hold is limited.
            while let Ok(Some(view)) = views.receive() {
                held.push(view);
            }
            continue;
        }
        while let Some(view) = views.receive()? {
            if misdeed == "mute" {
                continue;
            }
            let header = *view.user_header();
            report.taken += 1;
            report.published += 1;
            let sent_ns = now_ns();
            let acknowledged = DetectionHeader {
                stamp: header.stamp,
                plan_id: header.plan_id,
                taken_ns: header.taken_ns,
                issued_ns: header.issued_ns,
                received_ns: sent_ns,
                sent_ns,
                generation,
                view_index: header.view_index,
                attempt: header.attempt,
                worker,
                hits: 0,
                failed: 0,
                view_generation: header.generation,
                reserved: 0,
            };
            if misdeed == "lie" {
                records.send(DetectionHeader { hits: 3, ..acknowledged }, &[])?;
            }
            if misdeed == "impersonate" {
                records.send(DetectionHeader { worker: 99, ..acknowledged }, &[])?;
            }
            records.send(acknowledged, &[])?;
        }
    }
}

/// The publisher of a topic, and the event that wakes its subscribers.
struct Output<T: Topic> {
    publisher: Publisher<ipc::Service, [T::Item], T::Header>,
    notifier: Notifier<ipc::Service>,
}

impl<T: Topic> Output<T> {
    fn open(
        node: &Node<ipc::Service>,
        version: &AttributeVerifier,
    ) -> Result<Self, Box<dyn Error>> {
        let name: ServiceName = T::NAME.try_into()?;
        let publisher = node
            .service_builder(&name)
            .publish_subscribe::<[T::Item]>()
            .user_header::<T::Header>()
            .open_with_attributes(version)?
            .publisher_builder()
            .initial_max_slice_len(1)
            .create()?;
        let notifier = node.service_builder(&name).event().open()?.notifier_builder().create()?;
        Ok(Self { publisher, notifier })
    }

    fn send(&self, header: T::Header, items: &[T::Item]) -> Result<(), Box<dyn Error>>
    where
        T::Item: Copy,
    {
        let mut sample = self.publisher.loan_slice_uninit(items.len())?;
        *sample.user_header_mut() = header;
        sample.write_from_slice(items).send()?;
        self.notifier.notify()?;
        Ok(())
    }
}

fn now_ns() -> i64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}
