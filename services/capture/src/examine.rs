//! Checks of this machine for a source (`flockeye doctor`).

use std::path::Path;
use std::process::Command;

use flockeye_config::Pipeline;
use flockeye_runtime::findings::Finding;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::SourceSpec;

/// Usual codecs of recordings and cameras: name, and GStreamer's media type.
const CODECS: [(&str, &str); 3] =
    [("H.264", "video/x-h264"), ("H.265", "video/x-h265"), ("JPEG", "image/jpeg")];

pub(crate) fn examine(pipeline: &Pipeline) -> Vec<Finding> {
    if let Err(error) = gst::init() {
        return vec![Finding::problem(
            "gstreamer",
            error.to_string(),
            "install gstreamer1.0-plugins-base",
        )];
    }
    let mut findings = vec![Finding::fine("gstreamer", gst::version_string().to_string())];
    match pipeline.source.input.parse() {
        Err(error) => findings.push(Finding::problem(
            "source",
            format!("{}: {error}", pipeline.source.input),
            "source.input, or --source",
        )),
        Ok(spec) => findings.extend(needs(&spec, pipeline)),
    }
    findings.extend(CODECS.map(|(codec, caps)| decoder(codec, caps)));
    findings
}

/// Findings about a source's elements and its device.
fn needs(spec: &SourceSpec, pipeline: &Pipeline) -> Vec<Finding> {
    match spec {
        SourceSpec::Theta => {
            let mut findings =
                vec![element("thetauvcsrc", "build libuvc-theta, and then gstthetauvc")];
            findings.extend(theta_library());
            findings
        }
        SourceSpec::V4l2(device) => vec![
            element("v4l2src", "install gstreamer1.0-plugins-good"),
            modes(device, (pipeline.camera.width, pipeline.camera.height)),
        ],
        SourceSpec::File(path) | SourceSpec::Flight(path) | SourceSpec::Folder(path) => {
            vec![match path.metadata() {
                Ok(_) => Finding::fine("source", path.display().to_string()),
                Err(error) => Finding::problem(
                    "source",
                    format!("{}: {error}", path.display()),
                    "source.input, or --source",
                ),
            }]
        }
        SourceSpec::Description(text) => vec![Finding::fine("source", text.clone())],
    }
}

fn element(name: &str, cure: &str) -> Finding {
    match gst::ElementFactory::find(name) {
        Some(_) => Finding::fine("gstreamer", format!("{name} is there")),
        None => Finding::problem("gstreamer", format!("there is no {name}"), cure),
    }
}

/// Finding about GStreamer's preferred decoder: hardware or software.
fn decoder(codec: &str, caps: &str) -> Finding {
    let caps = gst::Caps::new_empty_simple(caps);
    let kinds = gst::ElementFactoryType::DECODER | gst::ElementFactoryType::MEDIA_VIDEO;
    let images = gst::ElementFactoryType::DECODER | gst::ElementFactoryType::MEDIA_IMAGE;
    let found = [kinds, images].into_iter().find_map(|kinds| {
        let factories = gst::ElementFactory::factories_with_type(kinds, gst::Rank::MARGINAL);
        let mut able: Vec<_> =
            factories.into_iter().filter(|factory| factory.can_sink_any_caps(&caps)).collect();
        able.sort_by_key(|factory| std::cmp::Reverse(factory.rank()));
        able.into_iter().next()
    });
    match found {
        None => Finding::warning(
            "decoder",
            format!("nothing decodes {codec}"),
            "install gstreamer1.0-libav",
        ),
        Some(factory) => {
            let is_hardware =
                factory.metadata("klass").is_some_and(|class| class.contains("Hardware"));
            match is_hardware {
                true => Finding::fine("decoder", format!("{codec}: {} (hardware)", factory.name())),
                false => Finding::note(
                    "decoder",
                    format!("{codec}: {} (software, which takes processor time)", factory.name()),
                ),
            }
        }
    }
}

fn modes(device: &Path, (width, height): (u32, u32)) -> Finding {
    const TOPIC: &str = "camera";
    let name = device.display();
    if let Err(error) = std::fs::File::options().read(true).write(true).open(device) {
        let cure = match error.kind() {
            std::io::ErrorKind::PermissionDenied => "let the user be in the group video",
            _ => "plug the camera in; v4l2-ctl --list-devices shows the devices",
        };
        return Finding::problem(TOPIC, format!("{name}: {error}"), cure);
    }
    let caps = || -> Option<gst::Caps> {
        let source = gst::ElementFactory::make("v4l2src").build().ok()?;
        source.set_property("device", &*device.to_string_lossy());
        source.set_state(gst::State::Ready).ok()?;
        let caps = source.static_pad("src")?.query_caps(None);
        // The caps are read already, so an error here is harmless.
        let _ = source.set_state(gst::State::Null);
        Some(caps)
    };
    let Some(caps) = caps() else {
        return Finding::problem(
            TOPIC,
            format!("{name} does not open"),
            "end the program that has it: fuser -v shows which",
        );
    };
    let sizes: std::collections::BTreeSet<(i32, i32)> = caps
        .iter()
        .filter_map(|mode| Some((mode.get("width").ok()?, mode.get("height").ok()?)))
        .collect();
    let is_there = sizes.contains(&(width as i32, height as i32));
    let listed: Vec<_> = sizes.iter().map(|(width, height)| format!("{width}x{height}")).collect();
    match is_there || sizes.is_empty() {
        true => Finding::fine(TOPIC, format!("{name} has {width}x{height}")),
        false => Finding::problem(
            TOPIC,
            format!("{name} has no {width}x{height}, but {}", listed.join(", ")),
            "camera.width and camera.height",
        ),
    }
}

/// Finding about the libuvc of Ricoh's driver: Debian's version lacks the camera's formats.
fn theta_library() -> Option<Finding> {
    const TOPIC: &str = "camera";
    let plugin = gst::ElementFactory::find("thetauvcsrc")?.plugin()?.filename()?;
    let said = Command::new("ldd").arg(&plugin).output().ok()?;
    let said = String::from_utf8_lossy(&said.stdout).into_owned();
    Some(match library(&said, "libuvc") {
        None => Finding::note(TOPIC, format!("{} names no libuvc", plugin.display())),
        Some(path) if path.starts_with("/lib/") || path.starts_with("/usr/lib/") => {
            Finding::problem(
                TOPIC,
                format!(
                    "Ricoh's driver uses Debian's libuvc ({path}), which does not know the Theta"
                ),
                "install libuvc-theta to /usr/local, then ldconfig; or remove libuvc0",
            )
        }
        Some(path) => Finding::fine(TOPIC, format!("Ricoh's driver uses {path}")),
    })
}

/// Path of a library in the output of `ldd`.
fn library<'s>(said: &'s str, name: &str) -> Option<&'s str> {
    let line = said.lines().find(|line| line.trim_start().starts_with(name))?;
    let path = line.split_once("=>")?.1.trim();
    Some(path.split_once(" (").map_or(path, |(path, _)| path))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_runtime::findings::Gravity;

    fn found(input: &str) -> Vec<Finding> {
        let mut pipeline = Pipeline::default();
        pipeline.source.input = input.to_owned();
        examine(&pipeline)
    }

    #[test]
    fn what_is_missing_is_named_with_its_cure() {
        let problems = |input: &str| {
            let findings = found(input);
            let grave = |finding: &Finding| finding.gravity == Gravity::Problem;
            findings.into_iter().filter(grave).collect::<Vec<_>>()
        };
        let camera = problems("v4l2:/dev/video-none");
        let [camera] = &camera[..] else { panic!("{camera:?}") };
        assert!(camera.what.starts_with("/dev/video-none: "), "{camera:?}");
        assert!(camera.cure.as_ref().unwrap().contains("v4l2-ctl"), "{camera:?}");
        assert!(problems("missing.mp4")[0].what.contains("missing.mp4"));
        assert_eq!(problems("gst:videotestsrc"), []);
    }

    #[test]
    fn decoders_are_listed() {
        let findings = found("gst:videotestsrc");
        let decoders = findings.iter().filter(|finding| finding.topic == "decoder");
        assert_eq!(decoders.count(), CODECS.len());
    }

    #[test]
    fn a_library_is_found_in_what_ldd_says() {
        let said = "\tlinux-vdso.so.1 (0x0)\n\tlibuvc.so.0 => /usr/local/lib/libuvc.so.0 (0x7f)\n";
        assert_eq!(library(said, "libuvc"), Some("/usr/local/lib/libuvc.so.0"));
        assert_eq!(library(said, "libusb"), None);
    }
}
