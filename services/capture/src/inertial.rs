//! Inertial sensor of a recording: samples of a CSV file or of a recorded flight, sent with their
//! frames.

use std::path::Path;

use anyhow::Context as _;
use flockeye_config::{InertialSource, Pipeline};
use flockeye_contract::{FrameStamp, ImuHeader, ImuSample, Imus, MAX_IMU_SAMPLES};
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_tables::ImuRow;

use crate::SourcePicture;
use crate::recorded_flight::FlightClock;

/// Reach of the samples beyond an exposure, in addition to `camera.latency_ms`, seconds: up to the
/// arrival of the picture.
const BEYOND_S: f64 = 0.01;

/// Samples of a file, and the position in it.
#[derive(Debug)]
pub(crate) struct RecordedSensor {
    rows: Vec<ImuRow>,
    next: usize,
    epoch: u32,
    /// Offset from the sensor's time to the camera's, seconds.
    time_offset_s: f64,
    latency_s: f64,
}

enum SampleSource {
    /// A separate file.
    File(RecordedSensor),
    /// The recording itself, with its pictures.
    Flight(FlightClock),
}

pub(crate) struct InertialPort {
    sensor: SampleSource,
    imus: Publisher<Imus>,
    generation: u32,
}

impl RecordedSensor {
    /// Reads the samples of a file.
    ///
    /// # Errors
    /// The file cannot be read, is empty, or its times do not rise.
    pub(crate) fn read(path: &Path, pipeline: &Pipeline) -> anyhow::Result<Self> {
        let rows: Vec<ImuRow> = flockeye_tables::read(path).context("inertial.source")?;
        anyhow::ensure!(!rows.is_empty(), "inertial.source: {} has no samples", path.display());
        if let Some(k) = rows.windows(2).position(|pair| pair[1].t_s <= pair[0].t_s) {
            let (line, t_s) = (k + 3, rows[k + 1].t_s);
            anyhow::bail!(
                "inertial.source: {}, line {line}: t_s {t_s} is not later than the line before. Cure: sort \
                 the lines by their time, one of each",
                path.display()
            );
        }
        Ok(Self::of(rows, pipeline))
    }

    fn of(rows: Vec<ImuRow>, pipeline: &Pipeline) -> Self {
        let time_offset_s = pipeline.inertial.time_offset_ms * 1e-3;
        let latency_s = pipeline.camera.latency_ms * 1e-3;
        Self { rows, next: 0, epoch: 0, time_offset_s, latency_s }
    }

    pub(crate) fn begin_epoch(&mut self) {
        self.next = 0;
        self.epoch += 1;
    }

    /// Takes the samples up to a frame's arrival that were not sent yet, on the frame's clock.
    pub(crate) fn until(&mut self, stamp: &FrameStamp) -> Vec<ImuSample> {
        let until_s = stamp.stream_ns as f64 * 1e-9 + self.latency_s + BEYOND_S;
        let zero_ns = stamp.exposure_ns - stamp.stream_ns;
        let rest = self.rows.get(self.next..).unwrap_or_default();
        let count = rest.partition_point(|row| row.t_s + self.time_offset_s <= until_s);
        self.next += count;
        rest[..count]
            .iter()
            .map(|row| ImuSample {
                at_ns: zero_ns + (row.t_s * 1e9).round() as i64,
                rate: row.rate.into(),
                specific_force: row.specific_force.map_or([f64::NAN; 3], Into::into),
            })
            .collect()
    }
}

impl InertialPort {
    /// Opens the recording's sensor, if one is configured.
    pub(crate) fn open(
        pipeline: &Pipeline,
        generation: u32,
        ports: &mut Ports,
    ) -> anyhow::Result<Option<Self>> {
        let sensor = match pipeline.inertial.parsed_source() {
            Ok(InertialSource::Recorded(path)) => {
                SampleSource::File(RecordedSensor::read(&path, pipeline)?)
            }
            Ok(InertialSource::Recording) => SampleSource::Flight(FlightClock::default()),
            _ => return Ok(None),
        };
        Ok(Some(Self { sensor, imus: ports.publisher()?, generation }))
    }

    /// Sends the samples up to a frame's arrival. Call it before the frame is sent, so that
    /// egomotion has them first.
    pub(crate) fn send_before(
        &mut self,
        picture: &SourcePicture,
        stamp: &FrameStamp,
    ) -> anyhow::Result<()> {
        let rows = match &mut self.sensor {
            SampleSource::File(sensor) => vec![(sensor.epoch, sensor.until(stamp))],
            SampleSource::Flight(clock) => clock.samples_of(picture, stamp),
        };
        let sent_ns = clock::monotonic_ns();
        for (epoch, samples) in rows {
            let header = ImuHeader { sent_ns, epoch, generation: self.generation };
            for samples in samples.chunks(MAX_IMU_SAMPLES) {
                self.imus.send(header, samples)?;
            }
        }
        Ok(())
    }

    pub(crate) fn begin_epoch(&mut self) {
        match &mut self.sensor {
            SampleSource::File(sensor) => sensor.begin_epoch(),
            SampleSource::Flight(clock) => clock.begin_epoch(),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::fs::write;

    fn pipeline(overrides: &[&str]) -> Pipeline {
        let overrides: Vec<String> = overrides.iter().map(|&text| text.into()).collect();
        Pipeline::parse("", &overrides, "x").unwrap()
    }

    fn stamp(stream_ms: i64, exposure_ms: i64) -> FrameStamp {
        let (stream_ns, exposure_ns) = (stream_ms * 1_000_000, exposure_ms * 1_000_000);
        FrameStamp { stream_ns, exposure_ns, ..FrameStamp::default() }
    }

    fn read(text: &str, overrides: &[&str]) -> anyhow::Result<RecordedSensor> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("imu.csv");
        write(&path, text).unwrap();
        RecordedSensor::read(&path, &pipeline(overrides))
    }

    fn sent(sensor: &mut RecordedSensor, stamp: FrameStamp) -> Vec<i64> {
        sensor.until(&stamp).iter().map(|sample| sample.at_ns / 1_000_000).collect()
    }

    #[test]
    fn samples_go_with_their_frames_once_on_the_frames_clock() {
        let text = "t_s,gx,gy,gz\n-0.02,0,0,1\n0.0,0,0,1\n0.02,0,0,1\n0.04,0,0,1\n0.06,0,0,1\n";
        let mut sensor = read(text, &[]).unwrap();
        assert_eq!(sent(&mut sensor, stamp(0, 1000)), [980, 1000]);
        assert_eq!(sent(&mut sensor, stamp(0, 1000)), Vec::<i64>::new());
        assert_eq!(sent(&mut sensor, stamp(33, 1033)), [1020, 1040]);
        assert_eq!(sent(&mut sensor, stamp(200, 1200)), [1060]);
        assert_eq!(sent(&mut sensor, stamp(400, 1400)), Vec::<i64>::new());
        sensor.begin_epoch();
        assert_eq!(sent(&mut sensor, stamp(0, 2000)), [1980, 2000]);
        // A sensor that is 20 ms behind, and a camera that is 20 ms late.
        let mut sensor = read(text, &["inertial.time_offset_ms=20"]).unwrap();
        assert_eq!(sent(&mut sensor, stamp(0, 1000)), [980]);
        let mut sensor = read(text, &["camera.latency_ms=20"]).unwrap();
        assert_eq!(sent(&mut sensor, stamp(0, 1000)), [980, 1000, 1020]);
    }

    #[test]
    fn what_is_wrong_with_a_file_is_said_with_its_place() {
        let refused = |text: &str| format!("{:#}", read(text, &[]).unwrap_err());
        assert!(refused("t_s,gx,gy\n").contains("has no column gz"));
        assert!(refused("t_s,gx,gy,gz\n").contains("has no samples"));
        let text = "t_s,gx,gy,gz\n0,0,0,0\n0.01,0,0,0\n0.01,0,0,0\n";
        assert!(refused(text).contains("line 4: t_s 0.01 is not later"), "{}", refused(text));
        assert!(refused("t_s,gx,gy,gz\n0,0,much,0\n").contains("line 2, column gy: 'much'"));
    }
}
