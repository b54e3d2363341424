"""The devices that populations are trained on: the processor, or an NVIDIA GPU."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from qrlsuite.errors import OptionError

if TYPE_CHECKING:
    import torch


def check(name: str) -> str:
    """Return a device's name if there can be such a device; torch is not imported."""
    if re.fullmatch(r"cpu|cuda(:\d{1,3})?", name) is None:
        raise OptionError(f"device = {name!r}: give cpu, cuda, or one GPU of several as cuda:1")
    return name


def find(name: str) -> torch.device:
    """Return the device of that name."""
    import torch

    device = torch.device(check(name))
    if device.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if count == 0:
            raise OptionError(
                f"device = {name!r}: torch sees no GPU here (qrlsuite doctor says why); train on --device cpu"
            )
        if (device.index or 0) >= count:
            raise OptionError(f"device = {name!r}: this machine has GPUs 0 to {count - 1}")
    return device
