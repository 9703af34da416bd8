//! The ports around the node.

use anyhow::Context as _;
use flockeye_config::{Flow, Ros2};
use flockeye_contract::{Peers, Tracks};
use flockeye_network::utc_from_monotonic;
use flockeye_ros2::{Ros2Error, Ros2Node, Ros2Parameters};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::newest::Newest;
use flockeye_runtime::ports::{Ports, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::{neighbours_of, odometry_of};

/// Period of the check of the link with the router, nanoseconds.
const LOOK_NS: i64 = 500_000_000;

/// Publishes tracks and peers' sightings as messages of ROS 2.
pub(crate) struct Ros2Stage {
    tracks: Subscriber<Tracks>,
    peers: Subscriber<Peers>,
    node: Ros2Node,
    newest: Newest,
    flow: Flow,
    routers: String,
    counters: SharedCounters,
    failures: Throttle,
    look_ns: i64,
}

impl Stage for Ros2Stage {
    const NAME: &'static str = "ros2";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let pipeline = &context.resolved.pipeline;
        let settings = pipeline.ros2.as_ref().context("ros2 is not in the configuration")?;
        Ok(Self {
            tracks: ports.subscriber()?,
            peers: ports.subscriber()?,
            node: Ros2Node::open(&parameters(settings), &pipeline.observer.name)?,
            newest: Newest::default(),
            flow: pipeline.flow(),
            routers: settings.connect.join(", "),
            counters: context.counters.clone(),
            failures: Throttle::default(),
            look_ns: 0,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        while let Some(message) = self.tracks.receive()? {
            let stamp = &message.header.stamp;
            let (stamp_utc_ns, _) = utc_from_monotonic(clock::exposure_ns(stamp, self.flow));
            let neighbours = neighbours_of(message.items(), stamp, stamp_utc_ns, &mut self.newest);
            for neighbour in &neighbours {
                self.note(self.node.publish_neighbour(neighbour));
            }
            if !neighbours.is_empty() {
                self.note(self.node.publish_transforms(&neighbours));
            }
        }
        while let Some(message) = self.peers.receive()? {
            for sighting in message.items() {
                let (stamp_utc_ns, _) = utc_from_monotonic(sighting.exposure_ns);
                if let Some(seen) = odometry_of(sighting, stamp_utc_ns) {
                    self.note(self.node.publish_odometry(&seen));
                }
            }
        }
        let now_ns = clock::monotonic_ns();
        if now_ns >= self.look_ns {
            self.look(now_ns);
        }
        Ok(Step::WaitUntil(self.look_ns))
    }
}

impl Ros2Stage {
    fn note(&mut self, published: Result<(), Ros2Error>) {
        let what = "a message for ROS 2 is not published";
        self.counters.note_sent(published, &mut self.failures, what);
    }

    /// Reports whether the router is linked.
    fn look(&mut self, now_ns: i64) {
        self.look_ns = now_ns + LOOK_NS;
        let is_open = self.node.is_open();
        self.counters.note_link(is_open, now_ns);
        self.counters.set_detail(match is_open {
            true => format!("linked with {}", self.routers),
            false => format!("no router at {} yet", self.routers),
        });
    }
}

fn parameters(settings: &Ros2) -> Ros2Parameters {
    Ros2Parameters {
        domain: settings.domain,
        connect: settings.connect.clone(),
        namespace: settings.namespace.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_that_cannot_work_is_refused_with_its_cure() {
        let settings = Ros2 { connect: vec!["7447".into()], ..Ros2::default() };
        let opened = Ros2Node::open(&parameters(&settings), "wren");
        let error = opened.map(drop).map_err(|error| error.to_string());
        assert!(error.is_err_and(|error| error.contains("connect[0]")));
    }
}
