"""What the scripts share."""
import dataclasses

import numpy


def plain(message):
    """A message as JSON has it, without the names of its types."""
    if dataclasses.is_dataclass(message):
        fields = (field.name for field in dataclasses.fields(message))
        return {name: plain(getattr(message, name)) for name in fields if name != "__msgtype__"}
    if isinstance(message, numpy.ndarray):
        return message.tolist()
    if isinstance(message, list):
        return [plain(item) for item in message]
    return message
