"""Whose messages count while the launcher swaps a stage: docs/CONTRACT.md, "While a stage is swapped"."""

from .contract import (
    DetectionHeader, FrameEnd, HandOver, HandOverState, PlanHeader, Rotation, TrackHeader, ViewHeader,
)  # fmt: skip
from .instance import text


def order(stamp):
    """A frame's place among all frames."""
    return (stamp.source_generation, stamp.epoch, stamp.sequence)


def speakers(header):
    """Who sent a message, and for an answer also who asked: (stage, replica, generation, frame)."""
    match header:
        case Rotation():
            return [("egomotion", 0, header.generation, order(header.stamp))]
        case PlanHeader():
            return [("fusion", 0, header.generation, order(header.after))]
        case TrackHeader():
            return [("fusion", 0, header.generation, order(header.stamp))]
        case ViewHeader() | FrameEnd():
            return [("rectification", 0, header.generation, order(header.stamp))]
        case DetectionHeader():
            frame = order(header.stamp)
            return [
                ("detection", header.worker, header.generation, frame),
                ("rectification", 0, header.view_generation, frame),
            ]
    return []


class Listening:
    """Follows the launcher's word for one process."""

    def __init__(self, hand_overs, own=None):
        # (stage, replica, generation) of this process; None for a tool.
        self._own = own
        self._hand_overs = hand_overs
        self._current = HandOver()

    def admits(self, header):
        """Whether a message counts for this process."""
        who = speakers(header)
        if not who:
            return True
        for message in self._hand_overs.waiting():
            self._current = HandOver.from_buffer_copy(message.header)
        return all(self._admits(*speaker) for speaker in who)

    def _admits(self, stage, replica, generation, frame):
        current = self._current
        is_about = (text(current.stage), current.replica) == (stage, replica)
        if self._own is not None:
            own_stage, own_replica, own_generation = self._own
            # Workers answer everybody.
            if own_stage == "detection":
                return True
            # Whoever works beside another hears the answers to its own.
            if (own_stage, own_replica) == (stage, replica) and is_about:
                return generation == own_generation
        if not is_about:
            return True
        has_newer = current.new_generation > current.old_generation
        is_new = generation == current.new_generation or (
            has_newer and generation > current.new_generation
        )
        if current.state == HandOverState.SHADOW:
            return not is_new
        if current.state == HandOverState.TAKEN_OVER:
            return is_new == (frame >= order(current.first))
        return True
