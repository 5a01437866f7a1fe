"""An alignment whose clock may drift and jump: what its windows show is put in, and all else estimated anew beside it."""

from dataclasses import replace

import numpy as np

from calibkit.estimation.alignment import Alignment, newton, settle
from calibkit.estimation.clock import Clock, fit_clock
from calibkit.estimation.clock_jumps import placed
from calibkit.estimation.clock_windows import Windows, window_offsets
from calibkit.estimation.turn_noise import NoiseLevels

_FEW_WINDOWS = 12
_ROUNDS = 4  # times that a clock is looked at


def with_clock(a: Alignment, levels: NoiseLevels | None, reach: float) -> tuple[Alignment, Windows]:
    """Return the alignment with the drift and the jumps that its windows show, and the windows.

    What a moving clock leaves is noise to a constant one, so that outliers and levels are found anew with it, and once more if it
    changes by more than a window knows.
    """
    windows = window_offsets(a, reach)
    for _ in range(_ROUNDS):
        if not len(windows.tau):
            break
        middle = (windows.start + windows.stop) / 2
        clock = placed(a, _clock_of(a, windows, reach))
        if clock.kind == "constant" and (a.clock is None or a.clock.kind == "constant"):
            return replace(a, clock=clock), windows
        change = np.abs(clock.at(middle) - a.shift(middle))
        a = replace(a, clock=clock, tau=clock.offset_s)
        if float(change.max()) < float(np.median(windows.sigma)):
            return newton(a), windows
        a = settle(a, levels)
        windows = window_offsets(a, reach)
    return a, windows


def _clock_of(a: Alignment, windows: Windows, reach: float) -> Clock:
    """Return the clock of the windows; where few of them drift, that of their halves if those jump.

    A jump inside one of a few windows, which then has an offset between the two, looks like a drift.
    """
    clock = fit_clock((windows.start + windows.stop) / 2, windows.start, windows.stop, windows.tau, windows.sigma)
    if clock.kind != "drifting" or len(windows.tau) >= _FEW_WINDOWS:
        return clock
    halves = window_offsets(a, reach, halved=True)
    if len(halves.tau) <= len(windows.tau):
        return clock
    finer = fit_clock((halves.start + halves.stop) / 2, halves.start, halves.stop, halves.tau, halves.sigma)
    return finer if finer.jumps else clock
