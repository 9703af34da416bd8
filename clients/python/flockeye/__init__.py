"""Stages and tools for a running Flockeye pipeline, over its shared memory.

docs/CONTRACT.md says what each message means and what each stage owes.
"""

from .contract import CONTRACT_VERSION, NONE
from .instance import Instance, set_text, text
from .ports import Loan, Message, Publisher, Subscriber, Waker, wait_any
from .stage import CANNOT_START, Stage

__all__ = [
    "CANNOT_START",
    "CONTRACT_VERSION",
    "NONE",
    "Instance",
    "Loan",
    "Message",
    "Publisher",
    "Stage",
    "Subscriber",
    "Waker",
    "set_text",
    "text",
    "wait_any",
]
