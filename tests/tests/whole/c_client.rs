//! Stages in C: the library of `clients/c` as people install it, and the example.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::{Complaints, Detections, MeasuredBy, Tracks, Truths};
use flockeye_tests::onlooker::{join, subscribe};
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, absent, flockeye, run, succeeds};
use nalgebra::Vector3;

const DICTIONARY: &str = "bodies.dictionary=DICT_APRILTAG_36h11";

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Runs a program to its end, and returns what it wrote.
fn run_program(program: impl AsRef<std::ffi::OsStr>, arguments: &[&str]) -> String {
    let output = Command::new(program).args(arguments).output().expect("it can be started");
    let text =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert!(output.status.success(), "{arguments:?}: {text:?}");
    text[0].trim().to_owned()
}

/// Installs the library into `scratch`, as `make install-c` does, and returns the prefix.
fn install(scratch: &Scratch) -> String {
    let library = flockeye().with_file_name("libflockeye_stage.so");
    let prefix = scratch.path("prefix").to_str().expect("a plain path").to_owned();
    run_program(
        repository("clients/c/install"),
        &[library.to_str().expect("a plain path"), &prefix],
    );
    prefix
}

/// The program that `flockeye stage new detection --lang c` is a text of, written and built; `None`
/// where what it needs is absent.
fn new_detector(scratch: &Scratch) -> Option<String> {
    let has = |program: &str, arguments: &[&str]| {
        Command::new(program).args(arguments).output().is_ok_and(|output| output.status.success())
    };
    if !has("cmake", &["--version"]) || !has("pkg-config", &["--exists", "apriltag"]) {
        absent("c", "cmake and libapriltag-dev, which `make setup` installs");
        return None;
    }
    let folder = scratch.path("detection");
    let folder = folder.to_str().expect("a plain path");
    let output = succeeds(&["stage", "new", "detection", "--lang", "c", folder]);
    let (prefix, build) = (install(scratch), format!("{folder}/build"));
    let prefix = format!("-DCMAKE_PREFIX_PATH={prefix}");
    run_program("cmake", &["-S", folder, "-B", &build, &prefix, "-DCMAKE_C_FLAGS=-Werror"]);
    run_program("cmake", &["--build", &build]);
    let commands = output.lines().filter_map(|line| line.split_once(" -- "));
    let program = commands.map(|(_, program)| program.trim()).next();
    Some(program.expect("it says how to test it").to_owned())
}

#[test]
fn a_detector_in_c_takes_over_and_poses_are_as_true_as_its_corners() {
    let scratch = Scratch::new("c-detector");
    let Some(detector) = new_detector(&scratch) else { return };
    let set = [SMALL_FLIGHT, &[DICTIONARY, "fusion.align=false"]].concat();
    let mut flight = Flight::with_poses("c-detector", &[], &set);
    let name = flight.instance.name().to_owned();
    for worker in ["detection", "detection.1"] {
        let swap = ["swap", worker, "--within", "60s", "--accept-worse", "--", &detector];
        let (succeeded, output) = flight.ask(&swap);
        assert!(succeeded && output.contains("is swapped after"), "{output}\n{}", flight.output());
    }
    let mut ports = join(&mut flight);
    let mut tracks = subscribe::<Tracks>(&mut flight, &mut ports);
    let mut truths = subscribe::<Truths>(&mut flight, &mut ports);
    let mut detections = subscribe::<Detections>(&mut flight, &mut ports);
    let mut known = std::collections::BTreeMap::new();
    let (mut hits, mut errors_m) = (0, Vec::new());
    let start = Instant::now();
    while hits < 20 || errors_m.len() < 20 {
        while let Some(message) = detections.receive().expect("it can be read") {
            assert_eq!(message.header.failed, 0);
            hits += message.header.hits;
        }
        while let Some(message) = truths.receive().expect("it can be read") {
            known.insert(message.header.stamp.order(), message.items().to_vec());
        }
        while let Some(message) = tracks.receive().expect("it can be read") {
            let Some(bodies) = known.get(&message.header.stamp.order()) else { continue };
            let measured = message
                .items()
                .iter()
                .filter(|track| track.measured_by == MeasuredBy::Decoded.code());
            for track in measured {
                let body =
                    bodies.iter().find(|body| body.target == track.target).expect("it flies");
                let [found, really] = [track.observer_from_target, body.observer_from_target]
                    .map(|pose| Vector3::from(pose.position));
                errors_m.push((found - really).norm());
            }
        }
        assert!(start.elapsed() < WATCHDOG, "{hits} hits, {errors_m:?}:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(5));
    }
    errors_m.sort_by(f64::total_cmp);
    // A corner that is half a pixel off, or another corner's, is far more than this at 0.6 m.
    assert!(errors_m[errors_m.len() / 2] < 0.01, "{errors_m:?}");
    drop((tracks, truths, detections, ports));
    succeeds(&["stop", "--instance", &name]);
    flight.assert_ends_well();
}

#[test]
fn the_detector_in_c_keeps_the_contract_and_says_what_it_cannot_work_with() {
    let scratch = Scratch::new("c-conformance");
    let Some(detector) = new_detector(&scratch) else { return };
    let small = ["--set", "camera.width=1024", "--set", "camera.height=512"];
    let test = |more: &[&str]| {
        run(&[&["stage", "test", "detection"], &small[..], more, &["--", &detector]].concat())
    };
    let (succeeded, output) = test(&["--set", DICTIONARY]);
    assert!(succeeded, "{output}");
    let (succeeded, output) = test(&[]);
    assert!(
        !succeeded && output.contains("knows bodies.dictionary: DICT_APRILTAG_36h11 alone"),
        "{output}"
    );
}

/// A stage that uses the functions that the example does not.
const PROBE: &str = r#"
#include <assert.h>
#include <string.h>
#include <flockeye/stage.h>

int main(void) {
    assert(!flockeye_stage_open("detections"));
    assert(strstr(flockeye_error(), "detections is not in the contract"));
    assert(!flockeye_stage_open("detection"));
    assert(strstr(flockeye_error(), "FLOCKEYE_INSTANCE_DIR is not set"));
    flockeye_stage_close(NULL);
    return flockeye_now_ns() > 0 ? 0 : 1;
}
"#;

/// A stage that reads the configuration, also what is not there, and says that it was read.
const READER: &str = r#"
#include <assert.h>
#include <stdio.h>
#include <string.h>
#include <flockeye/stage.h>

static int fails_with(int outcome, const char *reason) {
    if (outcome == FLOCKEYE_FAILED && strstr(flockeye_error(), reason)) {
        return 1;
    }
    fprintf(stderr, "%d, '%s' instead of '%s'\n", outcome, flockeye_error(), reason);
    return 0;
}

int main(void) {
    flockeye_stage *stage = flockeye_stage_open("detection");
    double width, turn[4], numbers[3];
    char text[16];
    size_t tiles;
    assert(flockeye_stage_numbers(stage, "/camera/width", &width, 1) == FLOCKEYE_OK && width == 1024);
    const char *tile = "/resolved/partitions/0/camera_from_view";
    assert(flockeye_stage_numbers(stage, tile, turn, 4) == FLOCKEYE_OK);
    const double square = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3];
    assert(square > 0.999 && square < 1.001);
    assert(fails_with(flockeye_stage_numbers(stage, tile, numbers, 3), "has 4 numbers, not 3"));
    assert(fails_with(flockeye_stage_numbers(stage, "/camera/depth", numbers, 1), "has no /camera/depth"));
    assert(fails_with(flockeye_stage_numbers(stage, "/flow", numbers, 1), "not made of numbers"));
    assert(flockeye_stage_text(stage, "/camera/projection", text, 16) == FLOCKEYE_OK);
    assert(strcmp(text, "equirectangular") == 0);
    assert(fails_with(flockeye_stage_text(stage, "/camera/projection", text, 15), "takes 16 bytes, not 15"));
    assert(fails_with(flockeye_stage_text(stage, "/camera/width", text, 16), "is no text"));
    assert(flockeye_stage_count(stage, "/resolved/partitions", &tiles) == FLOCKEYE_OK && tiles > 1);
    assert(fails_with(flockeye_stage_count(stage, "/camera", &tiles), "is not a list"));
    uint32_t id = 0;
    while (!flockeye_stage_owns_marker(stage, id)) {
        id++;
    }
    const uint32_t target = flockeye_stage_target_of_marker(stage, id);
    assert(target != FLOCKEYE_NONE && flockeye_stage_target_name(stage, target)[0] != 0);
    assert(flockeye_stage_target_of_marker(stage, FLOCKEYE_NONE) == FLOCKEYE_NONE);
    assert(!flockeye_stage_target_name(stage, FLOCKEYE_NONE));
    flockeye_stage_close(stage);
    fprintf(stderr, "all of it was read\n");
    return FLOCKEYE_CANNOT_START;
}
"#;

/// A stage whose step does what is refused in a step, and passes that on.
const FAILING_STAGE: &str = r#"
#include <stdio.h>
#include <flockeye/stage.h>

static int step(void *context) {
    return flockeye_subscribe(context, FLOCKEYE_TOPIC_VIEW, 0) ? FLOCKEYE_OK : FLOCKEYE_FAILED;
}

int main(void) {
    flockeye_stage *stage = flockeye_stage_open("detection");
    if (flockeye_stage_run(stage, "fails in its first step", step, stage) != FLOCKEYE_OK) {
        fprintf(stderr, "%s\n", flockeye_error());
        return 1;
    }
    return 0;
}
"#;

/// A detection that answers each view by what the example does not use: memory that it borrows, the
/// loop's own clock, refusals and complaints.
const BORROWER: &str = r#"
#include <assert.h>
#include <string.h>
#include <flockeye/stage.h>

typedef struct {
    flockeye_stage *stage;
    flockeye_subscriber *views;
    flockeye_publisher *detections;
    int waits;
} worker;

static void answer(const worker *self, const flockeye_view_header *view) {
    flockeye_detection_header header;
    flockeye_answer(self->stage, view, flockeye_now_ns(), &header);
    assert(header.generation == flockeye_stage_generation(self->stage));
    flockeye_loan loan;
    assert(flockeye_loan_items(self->detections, 2, &loan) == FLOCKEYE_OK && loan.count == 2);
    flockeye_drop_loan(&loan);
    flockeye_drop_loan(&loan);
    assert(flockeye_send_loan(self->detections, &loan, &header) == FLOCKEYE_FAILED);
    assert(strstr(flockeye_error(), "sent or dropped before"));
    assert(flockeye_loan_items(self->detections, 1, &loan) == FLOCKEYE_OK && loan.count == 1);
    flockeye_detected_marker *marker = loan.items;
    memset(marker, 0, sizeof *marker);
    for (int corner = 0; corner < 4; corner++) {
        marker->rays_in_camera[corner][0] = 1;
        marker->deviations[corner] = 1e-3;
    }
    marker->id = 7;
    assert(flockeye_send_loan(self->detections, &loan, &header) == FLOCKEYE_OK);
}

static int step(void *context) {
    worker *self = context;
    flockeye_message message;
    int views = 0;
    while (flockeye_receive(self->views, &message) == FLOCKEYE_OK) {
        answer(self, message.header);
        flockeye_release(&message);
        flockeye_release(&message);
        views++;
    }
    self->waits += views == 0;
    if (self->waits == 100) {
        flockeye_stage_refuse(self->stage, "a hundred steps without a view");
    }
    flockeye_stage_complain(self->stage, 63, 1, "a probe of complaints");
    flockeye_stage_wake_within(self->stage, 1000000);
    return flockeye_update_connections(self->detections);
}

int main(void) {
    worker self = {.stage = flockeye_stage_open("detection")};
    assert(strstr(flockeye_stage_pipeline(self.stage), "\"camera\""));
    self.views = flockeye_subscribe(self.stage, FLOCKEYE_TOPIC_VIEW, flockeye_stage_replica(self.stage));
    self.detections = flockeye_advertise(self.stage, FLOCKEYE_TOPIC_DETECTION, 0);
    assert(self.views && self.detections);
    const int outcome = flockeye_stage_run(self.stage, "borrows its answers", step, &self);
    flockeye_subscriber_close(self.views);
    flockeye_publisher_close(self.detections);
    flockeye_stage_close(self.stage);
    return outcome == FLOCKEYE_OK ? 0 : 1;
}
"#;

/// Compiles a program against the library as pkg-config finds it.
fn compile(
    scratch: &Scratch,
    prefix: &str,
    source: &str,
    [compiler, language]: [&str; 2],
) -> String {
    let config = |what: &str| {
        let path = format!("--with-path={prefix}/lib/pkgconfig");
        run_program("pkg-config", &[&path, what, "flockeye-stage"])
    };
    let flags = format!("{} {}", config("--cflags"), config("--libs"));
    let file = scratch.path("source.c");
    std::fs::write(&file, source).expect("it can be written");
    let file = file.to_str().expect("a plain path");
    let program = scratch.path(compiler).to_str().expect("a plain path").to_owned();
    let mut arguments =
        vec!["-Wall", "-Wextra", "-Werror", language, file, "-xnone", "-o", &program];
    arguments.extend(flags.split_whitespace());
    run_program(compiler, &arguments);
    program
}

#[test]
fn the_library_is_found_by_pkg_config_and_says_why_it_fails_in_c_and_in_cpp() {
    let scratch = Scratch::new("c-probe");
    let prefix = install(&scratch);
    for language in [["cc", "-xc"], ["c++", "-xc++"]] {
        run_program(compile(&scratch, &prefix, PROBE, language), &[]);
    }
}

#[test]
fn a_step_that_fails_ends_the_stage_with_the_reason_of_the_call_that_failed() {
    let scratch = Scratch::new("c-failing");
    let stage = compile(&scratch, &install(&scratch), FAILING_STAGE, ["cc", "-xc"]);
    let small = ["--set", "camera.width=1024", "--set", "camera.height=512"];
    let (succeeded, output) =
        run(&[&["stage", "test", "detection"], &small[..], &["--", &stage]].concat());
    let wanted = "a step has ended with -1: ports are opened before `flockeye_stage_run`";
    assert!(!succeeded && output.contains(wanted), "{output}");
}

#[test]
fn a_stage_in_c_borrows_memory_wakes_by_itself_refuses_and_complains() {
    let scratch = Scratch::new("c-borrower");
    let stage = compile(&scratch, &install(&scratch), BORROWER, ["cc", "-xc"]);
    let command = format!(r#"stages.detection.command=["{stage}"]"#);
    let set = [SMALL_FLIGHT, &[command.as_str()]].concat();
    let mut flight = Flight::start("c-borrower", &[], &set);
    flight.wait_for("refused: a hundred steps without a view");
    let mut ports = join(&mut flight);
    let mut detections = subscribe::<Detections>(&mut flight, &mut ports);
    let mut complaints = subscribe::<Complaints>(&mut flight, &mut ports);
    let (mut answers, mut complained) = (0, 0);
    let start = Instant::now();
    while answers < 20 || complained == 0 {
        let so_far = format!("{answers} answers, {complained} complaints");
        assert!(start.elapsed() < WATCHDOG, "{so_far}:\n{}", flight.output());
        while let Some(message) = detections.receive().expect("it can be read") {
            let markers: Vec<_> = message.items().iter().map(|found| found.id).collect();
            assert_eq!(markers, [7]);
            answers += 1;
        }
        while let Some(message) = complaints.receive().expect("it can be read") {
            let said = message.header;
            complained +=
                u32::from(said.detail.to_string() == "a probe of complaints" && said.replica == 63);
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    drop((detections, complaints, ports));
    succeeds(&["stop", "--instance", flight.instance.name()]);
    flight.assert_ends_well();
}

#[test]
fn a_stage_in_c_reads_the_configuration_and_is_told_what_is_not_there() {
    let scratch = Scratch::new("c-reader");
    let stage = compile(&scratch, &install(&scratch), READER, ["cc", "-xc"]);
    let small = ["--set", "camera.width=1024", "--set", "camera.height=512"];
    let (succeeded, output) =
        run(&[&["stage", "test", "detection"], &small[..], &["--", &stage]].concat());
    assert!(!succeeded && output.contains("all of it was read"), "{output}");
}

#[test]
fn the_header_for_c_compiles_and_its_assertions_hold() {
    let header = repository("clients/c/include/flockeye/contract.h");
    let header = header.to_str().expect("a plain path");
    run_program("cc", &["-std=c11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-xc", header]);
}
