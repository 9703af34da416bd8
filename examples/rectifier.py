"""A rectification in place of Flockeye's own, in Python with numpy.

    flockeye swap rectification --accept-worse -- python3 examples/rectifier.py

Needs `pip install clients/python numpy`, and equirectangular frames. It is some twenty times as slow as Flockeye's
own: fewer views of each frame are cut.
"""

import time
from collections import deque

import numpy as np

from flockeye import NONE, Stage
from flockeye.contract import (
    DETECTION, FRAME, FRAME_END, PLAN, VIEW, FrameEnd, PlannedView, StopReason, StopRule, Transfer, ViewHeader,
    ViewKind,
)  # fmt: skip

# A plan older than this is not followed: fusion has died since.
STALE_PLAN_NS = 1_000_000_000


def order(stamp):
    """A frame's place among all frames."""
    return (stamp.source_generation, stamp.epoch, stamp.sequence)


def product(p, q):
    """The product of two quaternions x, y, z, w."""
    (a, b, c, d), (e, f, g, h) = p, q
    return (
        d * e + a * h + b * g - c * f,
        d * f - a * g + b * h + c * e,
        d * g + a * f - b * e + c * h,
        d * h - a * e - b * f - c * g,
    )


def turned(planned, exposure_ns):
    """A planned view's rotation at the exposure."""
    turn = np.array(planned.rate_in_camera) * (exposure_ns - planned.reference_ns) * 1e-9
    angle = np.linalg.norm(turn)
    if planned.reference_ns == 0 or angle < 1e-9:
        return tuple(planned.camera_from_view)
    axis = turn / angle * np.sin(angle / 2)
    turned = np.array(product((*axis, np.cos(angle / 2)), planned.camera_from_view))
    return tuple(turned / np.linalg.norm(turned))


class Cutter:
    """Cuts views from equirectangular frames."""

    def __init__(self):
        self._rays = {}

    def rays(self, size, focal):
        """Unit rays of a view's pixels, in the view's frame: x right, y down, z forward."""
        if (size, focal) not in self._rays:
            if len(self._rays) > 16:
                self._rays.clear()
            line = (np.arange(size, dtype=np.float32) - (size - 1) / 2) / focal
            x, y = np.meshgrid(line, line)
            self._rays[size, focal] = np.stack([x, y, np.ones_like(x)])
        return self._rays[size, focal]

    def cut(self, image, rotation, focal, size, out):
        """Samples the sphere between its pixels."""
        height, width = image.shape
        x, y, z, w = rotation
        matrix = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ], np.float32)  # fmt: skip
        forward, left, up = np.tensordot(matrix, self.rays(size, focal), 1)
        u = (0.5 - np.arctan2(left, forward) / (2 * np.pi)) * width - 0.5
        v = (0.5 - np.arctan2(up, np.hypot(forward, left)) / np.pi) * height - 0.5
        column, row = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
        s, t = u - column, v - row
        # Rows end at the poles; columns go round.
        first, second = column % width, (column + 1) % width
        above, below = np.clip(row, 0, height - 1), np.clip(row + 1, 0, height - 1)
        light = (1 - t) * ((1 - s) * image[above, first] + s * image[above, second])
        light += t * ((1 - s) * image[below, first] + s * image[below, second])
        np.copyto(out, (light + 0.5).astype(np.uint8))


class Rectifier:
    """Follows plans, keeps a few views in flight for each worker, and ends frames."""

    def __init__(self, stage):
        self.stage = stage
        resolved, settings = stage.pipeline["resolved"], stage.pipeline["rectification"]
        self.window = settings["window"]
        self.overdue_ns = int(settings["overdue_ms"] * 1e6)
        self.workers = range(resolved["workers"])
        self.side = resolved["largest_view_px"]
        self.frames = stage.subscriber(FRAME)
        self.plans = stage.subscriber(PLAN)
        self.answers = stage.subscriber(DETECTION)
        self.lanes = [stage.publisher(VIEW.lane(worker), self.side**2) for worker in self.workers]
        self.frame_ends = stage.publisher(FRAME_END)
        self.cutter = Cutter()
        self.sweep = [self.swept(tile, view) for tile, view in enumerate(resolved["partitions"])]
        self.next_tile = 0
        self.plan, self.frame = None, None

    def swept(self, tile, view):
        planned = PlannedView(
            focal_px=view["focal_px"], size_px=view["size_px"], kind=ViewKind.PARTITION, tile=tile, target=NONE
        )
        planned.camera_from_view[:] = view["camera_from_view"]
        return planned

    def on_plan(self, message):
        header = type(message.header).from_buffer_copy(message.header)
        views = [PlannedView.from_buffer_copy(view) for view in message.items]
        wrong = next((view for view in views if not self.can_cut(view)), None)
        if wrong is not None:
            self.stage.refuse(f"plan {header.plan_id}: a view of {wrong.size_px} px, focal length {wrong.focal_px}")
            return
        self.plan = (header, views)

    def can_cut(self, view):
        norm = np.linalg.norm(np.array(view.camera_from_view))
        return 1 <= view.size_px <= self.side and 1 <= view.focal_px <= 262144 and abs(norm - 1) < 1e-3

    def take_up(self, message):
        """Begins a frame, which is kept until all of its views are acknowledged."""
        header = message.header
        camera = self.stage.pipeline["camera"]
        if (header.width, header.height) != (camera["width"], camera["height"]) or header.pixel_format > 1:
            raise ValueError(f"{header.width}x{header.height} pixels of format {header.pixel_format}")
        rows = np.frombuffer(message.pixels(), np.uint8)[: header.stride * header.height]
        self.image = rows.reshape(header.height, header.stride)[:, : header.width]
        self.frame = message.keep()
        self.taken_ns = time.monotonic_ns()
        followed = self.plan
        is_stale = followed is None or self.taken_ns - followed[0].made_ns > STALE_PLAN_NS
        if followed is None or (is_stale and not self.stage.is_lossless):
            count = len(self.sweep)
            views = [self.sweep[(self.next_tile + k) % count] for k in range(count)]
            self.next_tile = (self.next_tile + 1) % count
            self.plan_id, self.rule, self.budget = 0, StopRule.DEADLINE, 1
            self.gamma = 0.0
        else:
            views = followed[1]
            self.plan_id, self.rule, self.budget = followed[0].plan_id, followed[0].stop_rule, followed[0].view_budget
            self.gamma = followed[0].gamma
        self.views = deque(enumerate(views))
        self.issued = 0
        self.has_hit, self.is_ended = False, False
        # Index: (worker, attempt, when it was given, the planned view).
        self.in_flight = {}

    def on_answer(self, header):
        given = self.in_flight.get(header.view_index)
        is_same_frame = order(header.stamp) == order(self.frame.header.stamp)
        if given and is_same_frame and header.attempt <= given[1]:
            self.has_hit |= header.hits > 0
            del self.in_flight[header.view_index]

    def free_worker(self):
        """The worker with the fewest views, if it has room; none that was silent for too long."""
        loads = [sum(given[0] == worker for given in self.in_flight.values()) for worker in self.workers]
        worker = min(self.workers, key=lambda worker: loads[worker])
        return worker if loads[worker] < self.window else None

    def reason_to_stop(self, is_newer_there):
        if self.rule == StopRule.FIRST_HIT and self.has_hit:
            return StopReason.HIT
        if not self.views:
            return StopReason.COMPLETE
        if self.rule == StopRule.DEADLINE and self.issued > 0:
            is_region = self.views[0][1].kind == ViewKind.ROI
            if self.stage.is_lossless:
                return StopReason.BUDGET if self.issued >= self.budget else None
            if is_newer_there and not is_region:
                return StopReason.NEWER
        return None

    def give(self, index, attempt, planned, worker):
        """Cuts a view into the memory of the worker's lane."""
        frame = self.frame.header
        size = planned.size_px
        with self.lanes[worker].loan(size * size) as loan:
            rotation = turned(planned, frame.stamp.exposure_ns)
            out = np.frombuffer(loan.pixels(), np.uint8).reshape(size, size)
            self.cutter.cut(self.image, rotation, planned.focal_px, size, out)
            header = loan.header
            for name, _ in ViewHeader._fields_:
                if hasattr(planned, name):
                    setattr(header, name, getattr(planned, name))
                elif hasattr(frame, name):
                    setattr(header, name, getattr(frame, name))
            if self.gamma > 0:
                # Fusion has learned that the frame's own response is wrong.
                header.transfer, header.gamma = Transfer.GAMMA, self.gamma
            header.camera_from_view[:] = rotation
            header.plan_id, header.taken_ns = self.plan_id, self.taken_ns
            header.generation = self.stage.generation
            header.view_index, header.attempt, header.worker = index, attempt, worker
            header.stride, header.issued_ns = size, time.monotonic_ns()
        self.in_flight[index] = (worker, attempt, time.monotonic_ns(), planned)
        self.stage.published()

    def step(self, is_newer_there):
        """Does one piece of work for the frame; False if there is nothing to do but to wait."""
        if self.frame is None:
            return False
        now_ns = time.monotonic_ns()
        for index, (worker, attempt, given_ns, planned) in list(self.in_flight.items()):
            others = [other for other in self.workers if other != worker] or [worker]
            if now_ns - given_ns > self.overdue_ns:
                if self.is_ended and is_newer_there:
                    # The frame makes room for a newer one: nobody needs its view any more.
                    del self.in_flight[index]
                    return True
                self.give(index, attempt + 1, planned, others[attempt % len(others)])
                return True
        if not self.is_ended:
            reason = self.reason_to_stop(is_newer_there)
            if reason is not None:
                self.end(reason)
                return True
            worker = self.free_worker()
            if worker is not None:
                index, planned = self.views.popleft()
                self.issued += 1
                self.give(index, 0, planned, worker)
                return True
        elif not self.in_flight:
            self.image = None
            self.frame.release()
            self.frame = None
            return True
        return False

    def end(self, reason):
        self.is_ended = True
        self.frame_ends.send(
            FrameEnd(
                stamp=self.frame.header.stamp,
                plan_id=self.plan_id,
                taken_ns=self.taken_ns,
                ended_ns=time.monotonic_ns(),
                views_issued=self.issued,
                views_abandoned=len(self.views),
                reason=reason,
                generation=self.stage.generation,
            )
        )
        self.stage.published()


def main():
    with Stage("rectification") as stage:
        if stage.pipeline["camera"]["projection"] != "equirectangular":
            raise ValueError("this rectification reads equirectangular frames only")
        rectifier = Rectifier(stage)
        stage.ready("numpy")
        waiting = None
        for _ in stage.turns(rectifier.frames, rectifier.plans, rectifier.answers):
            for plan in rectifier.plans.waiting():
                rectifier.on_plan(plan)
            for answer in rectifier.answers.waiting():
                if rectifier.frame is not None:
                    rectifier.on_answer(answer.header)
            newest = rectifier.frames.newest() if not stage.is_lossless or waiting is None else None
            if newest is not None:
                if waiting is not None:
                    waiting.release()
                waiting = newest
            if rectifier.frame is None and waiting is not None:
                try:
                    rectifier.take_up(waiting)
                except ValueError as error:
                    stage.refuse(f"frame {waiting.header.stamp.sequence}: {error}")
                    waiting.release()
                waiting = None
            # Another turn at once while there is work.
            stage.due(0.0 if rectifier.step(waiting is not None) else 0.05)


if __name__ == "__main__":
    main()
