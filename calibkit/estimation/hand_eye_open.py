"""What the poses leave open of X, in words."""

from calibkit.estimation import open_directions as transform
from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.open_directions import Open
from calibkit.geometry.so3 import Array

__all__ = ["Open", "open_directions"]


def open_directions(data: HandEyeData, X: Array, cov_X: Array) -> tuple[Open, ...]:
    """Return what is not observable and what is weak of X = T_1_2, in frame 1's axes."""
    one, two, _, _ = data.words.frames
    return transform.open_directions(f"T_{one}_{two}", one, X[:3, :3], cov_X)
