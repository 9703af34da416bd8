//! Publisher of the source's coded pictures, while it has subscribers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use flockeye_config::{Flow, Pipeline};
use flockeye_contract::{MAX_PACKET_BYTES, PacketHeader, Packets, VideoCodec};
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher};

use crate::FrameSource;
use crate::packet_tap::Packet;

/// The port, and the state of its subscribers.
pub(crate) struct PacketPort {
    port: Publisher<Packets>,
    /// Flag for the source: whether packets are requested.
    are_wanted: Arc<AtomicBool>,
    /// Number of subscribers at the last message that no packets exist.
    informed: usize,
    flow: Flow,
    latency_ns: i64,
    generation: u32,
    too_large: Throttle,
}

impl PacketPort {
    /// Opens the port. `are_wanted` is the flag for the source.
    pub(crate) fn open(
        pipeline: &Pipeline,
        generation: u32,
        are_wanted: Arc<AtomicBool>,
        ports: &mut Ports,
    ) -> anyhow::Result<Self> {
        let port = ports.side_publisher()?;
        let latency = Duration::try_from_secs_f64(pipeline.camera.latency_ms * 1e-3);
        let latency_ns = latency.map_or(0, |latency| latency.as_nanos() as i64);
        are_wanted.store(port.readers() > 0, Ordering::Relaxed);
        let (flow, too_large) = (pipeline.flow(), Throttle::default());
        Ok(Self { port, are_wanted, informed: 0, flow, latency_ns, generation, too_large })
    }

    pub(crate) fn attend(&mut self, source: &FrameSource, epoch: u32) -> anyhow::Result<()> {
        let readers = self.port.readers();
        self.are_wanted.store(readers > 0, Ordering::Relaxed);
        if readers == 0 {
            self.informed = 0;
            return Ok(());
        }
        for packet in source.take_packets() {
            self.send(&packet, epoch)?;
        }
        if source.codec() == Some(VideoCodec::None) && self.informed != readers {
            let source_generation = self.generation;
            self.port.send(PacketHeader { epoch, source_generation, ..Default::default() }, &[])?;
            self.informed = readers;
        }
        Ok(())
    }

    fn send(&mut self, packet: &Packet, epoch: u32) -> anyhow::Result<()> {
        let Packet { stream_ns, arrived_ns, sequence, codec, is_key, ref bytes } = *packet;
        if bytes.len() > MAX_PACKET_BYTES {
            if let Some(more_since) = self.too_large.admit() {
                tracing::warn!(
                    more_since,
                    "a coded picture of {} bytes is not passed on: {MAX_PACKET_BYTES} are the most",
                    bytes.len()
                );
            }
            return Ok(());
        }
        let exposure_ns = match self.flow {
            Flow::Lossless => stream_ns,
            Flow::Latest => arrived_ns - self.latency_ns,
        };
        let header = PacketHeader {
            stream_ns,
            exposure_ns,
            arrived_ns,
            sequence,
            epoch,
            source_generation: self.generation,
            codec: codec.code(),
            is_key: u32::from(is_key),
        };
        Ok(self.port.send(header, bytes)?)
    }
}
