"""A fusion in place of Flockeye's own that only says in which direction neighbours are, in Python.

    flockeye swap fusion --accept-worse -- python3 examples/bearings.py

Needs `pip install clients/python numpy`. A neighbour is reported at one metre along the mean of its markers' rays,
with a covariance that says that only the direction is known. It keeps no track: every frame stands for itself. Plans
sweep the whole sphere.
"""

import time
from collections import defaultdict

import numpy as np

from flockeye import NONE, Stage, set_text
from flockeye.contract import (
    DETECTION, FRAME_END, PLAN, TRACK, FrameStamp, MeasuredBy, PlanHeader, PlannedView, SearchMode,
    StopRule, Track, TrackHeader, TrackState, ViewKind,
)  # fmt: skip

# Room in one message.
MAX_TRACKS = 16
# Tiles that a lossless run searches of each frame.
TILES_OF_A_FRAME = 4
# Standard deviation along the line of sight, and of the attitude, which nothing is known of.
UNKNOWN_M, UNKNOWN_RAD = 1.0, 3.0


class Frame:
    """What was said of one frame."""

    def __init__(self, stamp):
        self.stamp, self.end, self.views = FrameStamp.from_buffer_copy(stamp), None, set()
        self.begun_s = time.monotonic()
        self.rays = defaultdict(list)

    def is_complete(self):
        return self.end is not None and all(index in self.views for index in range(self.end))


def order(stamp):
    """A frame's place among all frames."""
    return (stamp.source_generation, stamp.epoch, stamp.sequence)


class Bearings:
    """The sphere's tiles, the bodies' markers, and the frames that are open."""

    def __init__(self, stage):
        resolved = stage.pipeline["resolved"]
        self.stage = stage
        self.tiles = resolved["partitions"]
        self.budget = min(TILES_OF_A_FRAME, len(self.tiles))
        self.names, self.target_of = {}, {}
        for name, body in resolved["bodies"]["bodies"].items():
            self.names[body["target"]] = name
            self.target_of.update((marker["id"], body["target"]) for marker in body["markers"])
        mount = resolved["observer_from_camera"]
        self.position = np.array(mount["position"])
        x, y, z, w = mount["orientation"]
        self.observer_from_camera = lambda v: v + 2 * np.cross((x, y, z), np.cross((x, y, z), v) + w * v)
        self.deadline_s = stage.pipeline["fusion"]["deadline_ms"] * 1e-3
        self.frames, self.ended, self.plan_id, self.next_tile = {}, None, 0, 0
        self.tracks = stage.publisher(TRACK, MAX_TRACKS)
        self.plans = stage.publisher(PLAN, len(self.tiles))

    def plan(self, after):
        """Where to look next: the tiles in turn."""
        self.plan_id += 1
        header = PlanHeader(
            plan_id=self.plan_id,
            made_ns=time.monotonic_ns(),
            has_after=after is not None,
            generation=self.stage.generation,
            stop_rule=StopRule.DEADLINE,
            mode=SearchMode.ROI,
            view_budget=self.budget,
        )
        if after is not None:
            header.after = after
        tiles = [(self.next_tile + k) % len(self.tiles) for k in range(len(self.tiles))]
        self.next_tile = (self.next_tile + self.budget) % len(self.tiles)
        self.plans.send(header, [self.planned(tile) for tile in tiles])
        self.stage.published()

    def planned(self, tile):
        view = PlannedView(
            focal_px=self.tiles[tile]["focal_px"],
            size_px=self.tiles[tile]["size_px"],
            kind=ViewKind.PARTITION,
            tile=tile,
            target=NONE,
        )
        view.camera_from_view[:] = self.tiles[tile]["camera_from_view"]
        return view

    def open(self, stamp):
        """The frame of a stamp; None if it has ended."""
        if self.ended is not None and order(stamp) <= self.ended:
            return None
        return self.frames.setdefault(order(stamp), Frame(stamp))

    def on_record(self, header, markers):
        frame = self.open(header.stamp)
        # Of two records of one view the first counts.
        if frame is None or header.view_index in frame.views:
            return
        frame.views.add(header.view_index)
        for marker in markers:
            if marker.id in self.target_of:
                frame.rays[self.target_of[marker.id]] += [np.array(ray) for ray in marker.rays_in_camera]

    def on_end(self, header):
        frame = self.open(header.stamp)
        if frame is not None:
            frame.end = header.views_issued

    def end_frames(self):
        """Ends what is complete or overdue, and what is older: it was under way when this process began, or its worker
        died."""
        overdue_s = time.monotonic() - self.deadline_s
        complete = [
            place for place, frame in self.frames.items() if frame.is_complete() or frame.begun_s < overdue_s
        ]
        for place in sorted(self.frames):
            if not complete or place > max(complete):
                break
            frame = self.frames.pop(place)
            self.ended = place
            self.report(frame)
            self.plan(frame.stamp)

    def report(self, frame):
        found = [self.track(target, rays) for target, rays in sorted(frame.rays.items())][:MAX_TRACKS]
        header = TrackHeader(stamp=frame.stamp, generation=self.stage.generation, is_last=1)
        self.tracks.send(header, found)
        self.stage.published()

    def track(self, target, rays):
        """A neighbour one metre off, along the mean of its markers' rays."""
        bearing = self.observer_from_camera(np.mean(rays, axis=0))
        bearing /= np.linalg.norm(bearing)
        across = np.std([self.observer_from_camera(ray) for ray in rays], axis=0).max() / 2 + 1e-3
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = across**2 * np.eye(3) + UNKNOWN_M**2 * np.outer(bearing, bearing)
        covariance[3:, 3:] = UNKNOWN_RAD**2 * np.eye(3)
        track = Track(
            target=target, state=TrackState.MEASURED, measured_by=MeasuredBy.DECODED, markers=len(rays) // 4
        )
        set_text(track.name, self.names[target])
        for name in ("", "measured_", "predicted_"):
            pose = getattr(track, f"{name}observer_from_target")
            pose.position[:] = self.position + bearing
            pose.orientation[:] = (0, 0, 0, 1)
            getattr(track, f"{name}covariance")[:] = covariance.flatten()
        return track


def main():
    with Stage("fusion") as stage:
        detections, frame_ends = stage.subscriber(DETECTION), stage.subscriber(FRAME_END)
        bearings = Bearings(stage)
        bearings.plan(None)
        stage.ready("bearings alone, in Python")
        for _ in stage.turns(detections, frame_ends):
            for message in detections.waiting():
                bearings.on_record(message.header, message.items)
            for message in frame_ends.waiting():
                bearings.on_end(message.header)
            bearings.end_frames()
            stage.queued(len(bearings.frames))
            stage.due(0.05)


if __name__ == "__main__":
    main()
