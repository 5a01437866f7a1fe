"""What is known of a hand-eye problem beside its poses when its result is told."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.hand_eye_verdict import Doubts
from calibkit.geometry.so3 import Array

REFINED = "refined"


@dataclass(frozen=True)
class Asked:
    """What the stage knows beside the poses."""

    method: str = REFINED
    predict: int = 0
    t_ns: NDArray[np.int64] | None = None  # (n,)
    px: Array | None = None  # (n,) rms of the corners against what the robot's pose predicts
    lines: tuple[str, ...] = ()  # how the poses were found and paired
    doubts: Doubts = field(default_factory=Doubts)
