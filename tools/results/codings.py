#!/usr/bin/env python3
"""Flies the same simulated flights in pictures that are coded in different ways: what does each ask of covariances?

    make results PARTS=codings

Each flight is recorded as JPEG, frame by frame. FFmpeg codes these pictures anew, and they are flown again, with
`fusion.coding` as images and as video. The table has the NEES of the measurements, where 3 is right. Needs Debian's
ffmpeg and `make python`.
"""

import json
import shutil
import subprocess
import sys

from mcap.reader import make_reader

from results import ROOT, WORK, call, fly, pooled

SEEDS = range(9411, 9417)
FRAMES = 60
PIXELS = 3840 * 1920
# In limited range, and without B pictures: as cameras send it.
LIMITED = ["-vf", "scale=in_range=full:out_range=tv,format=yuv420p", "-color_range", "tv"]
H264 = [*LIMITED, "-c:v", "libx264", "-bf", "0"]
# Of each: FFmpeg's options.
CODINGS = {
    "MJPEG, FFmpeg's quality 8": ["-c:v", "mjpeg", "-q:v", "8"],
    "H.264, each by itself, 80 Mbit/s": [*H264, "-b:v", "80M", "-g", "1"],
    "H.264, 80 Mbit/s": [*H264, "-b:v", "80M"],
    "H.264, 40 Mbit/s": [*H264, "-b:v", "40M"],
    "H.264, 20 Mbit/s": [*H264, "-b:v", "20M"],
    "H.264, 10 Mbit/s": [*H264, "-b:v", "10M"],
    "H.264 with B pictures, 20 Mbit/s": [*H264, "-b:v", "20M", "-bf", "3"],
    "H.265, 20 Mbit/s": [*LIMITED, "-c:v", "libx265", "-b:v", "20M", "-x265-params", "bframes=0:log-level=error"],
}
BETWEEN = [name for name in CODINGS if name.startswith("H.26") and "by itself" not in name]


def simulated(seed, folder):
    """Flies a simulated flight and records it. Gives its poses, truth and rotations, and the recording."""
    recorded = folder / str(seed)
    settings = [f"simulator.seed={seed}", f"simulator.frames={FRAMES}", f"recording.folder={recorded}",
                "recording.frames=every", "recording.every=1"]
    for old in (ROOT / recorded).glob("*.mcap"):
        old.unlink()
    arguments = [word for setting in settings for word in ("--set", setting)]
    _, *files, _ = fly(arguments, "lossless", f"codings-{seed}", None, f"codings-{seed}")
    return files, next((ROOT / recorded).glob("*.mcap"))


def coded(recording, options, out):
    """Codes the pictures of a recording anew."""
    command = ["ffmpeg", "-y", "-v", "error", "-f", "image2pipe", "-c:v", "mjpeg", "-r", "30", "-i", "-", *options, str(out)]
    ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE)
    count = 0
    for picture in pictures(recording):
        ffmpeg.stdin.write(picture)
        count += 1
    ffmpeg.stdin.close()
    if count != FRAMES:
        sys.exit(f"codings: {recording} has {count} pictures of {FRAMES}")
    if ffmpeg.wait() != 0:
        sys.exit(f"codings: {' '.join(command)} ended with {ffmpeg.returncode}")
    return out


def pictures(recording):
    """The JPEG pictures of a recording, in order. Each is the last field of its message."""
    with open(recording, "rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/flockeye/frame/image"]):
            yield message.data[message.data.index(b"\xff\xd8\xff"):]


def flown(sources, truths, coding):
    """Poses and truth of flights through these sources."""
    files = []
    for seed, source, truth in zip(SEEDS, sources, truths):
        arguments = ["--source", str(source), "--set", f"fusion.coding={coding}"]
        _, poses, *_ = fly(arguments, "lossless", f"codings-{seed}-{coding}", truth, f"codings-{seed}")
        files.append((poses, truth))
    return files


def line(name, coding, files, total_bytes):
    """What `flockeye eval` says of some flights."""
    poses, truth = pooled(files, "codings")[:2]
    said = json.loads(call(["eval", "--poses", str(poses), "--truth", str(truth), "--json"]))
    bits = f"{8 * total_bytes / (len(SEEDS) * FRAMES * PIXELS):.2f}" if total_bytes else ""
    nees = [f"{of['mean']:5.2f} ({of['low']:.2f} to {of['high']:.2f})"
            for of in (said["nees"]["measurements"][part] for part in ("position", "rotation"))]
    print(f"{name:<34} {bits:>10}  {coding:<8} {said['measured']:>8} {said['false_poses']:>6}  {nees[0]:<21}  {nees[1]}", flush=True)


def main():
    if not shutil.which("ffmpeg"):
        sys.exit("codings: ffmpeg is missing. Cure: install Debian's ffmpeg")
    folder = WORK / "codings"
    (ROOT / folder).mkdir(parents=True, exist_ok=True)
    print(f"{'pictures':<34} {'bits/pixel':>10}  {'flown as':<8} {'measured':>8} {'false':>6}  {'NEES of positions':<21}  of rotations")
    flights = [simulated(seed, folder) for seed in SEEDS]
    truths = [files[1] for files, _ in flights]
    recordings = [recording for _, recording in flights]
    line("as the simulator draws them", "images", [files[:2] for files, _ in flights], 0)
    size = sum(len(picture) for recording in recordings for picture in pictures(recording))
    line("JPEG, quality 90", "images", flown(recordings, truths, "images"), size)
    for name, options in CODINGS.items():
        videos = [coded(recording, options, recording.with_suffix(".mkv")) for recording in recordings]
        size = sum(video.stat().st_size for video in videos)
        for coding in ["images", "video"] if name in BETWEEN else ["images"]:
            line(name, coding, flown(videos, truths, coding), size)


if __name__ == "__main__":
    main()
