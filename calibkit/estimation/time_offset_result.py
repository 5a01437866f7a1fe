"""From a fitted time offset to a result: the rig's entry, what it costs when left uncorrected, and what the report draws."""

from dataclasses import dataclass

import numpy as np

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Estimate, Rig
from calibkit.data.transforms import find_transform, make_time_offset
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.estimation.alignment import Alignment
from calibkit.estimation.alignment_axes import open_axes
from calibkit.estimation.clock import describe
from calibkit.estimation.stamps import StampReport
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.time_offset_delay import Delays
from calibkit.estimation.time_offset_doubts import by_axis
from calibkit.estimation.time_offset_verdict import judge_time_offset, rates
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

_TURNED = np.radians(2.0)  # the rig file's rotation may be off by so much before it is told


@dataclass(frozen=True)
class Pair:
    """Two sensors: t_to = t_of + td."""

    of: str
    to: str
    of_topic: str
    to_topic: str
    method: str  # how the turns of `of` were found
    focal_px: float | None = None  # of `of`, a camera


def time_offset_result(
    pair: Pair, fit: TimeOffsetFit, base: Rig, stamps: dict[str, StampReport], delays: Delays, bootstrap: float | None
) -> Result:
    """Return the result of stage `timeoffset`; `base` is the rig that it is added to."""
    name = f"dt_{pair.to}_{pair.of}"
    judged = judge_time_offset(name, pair.of, pair.to, fit, stamps)
    known = judged.status is not Status.NOT_OBSERVABLE
    reasons = [*judged.reasons, *(_against_rig(pair, fit, base) if known else [])]
    sigma, plain = fit.sigma, float(np.sqrt(fit.covariance.plain[0, 0]))
    offset = Estimate(
        value=fit.td if known else None,
        unit="s",
        sigma=sigma if known else None,
        sigma_plain=plain if known else None,
        status=judged.status,
    )
    flipped = f"dt_{pair.of}_{pair.to}" in base.time_offsets  # the rig already has it the other way round
    a, b, key = (pair.of, pair.to, f"dt_{pair.of}_{pair.to}") if flipped else (pair.to, pair.of, name)
    if flipped and offset.value is not None:
        offset = offset.model_copy(update={"value": -offset.value})
    about = f"of {name}, which is minus this: " if flipped else ""  # signs and the other td's in a reason are those of t_to = t_of + td
    texts = [
        f"{about}{reason.text.removeprefix(prefix)}" if reason.text.startswith(prefix := f"{name}: ") else reason.text for reason in reasons
    ]
    entry = make_time_offset(a, b, offset, verdict=worst(reasons), reasons=texts)
    turned = f"  the rig file has it the other way round: {entry.equation}, {key} = -td"
    low, high = (fit.coarse_ns * 1e-9 + end for end in fit.interval)
    told = {"offset": fit.td, "sigma": sigma, "low": low, "high": high, "second": fit.second}
    frame_hz = stamps[pair.of].rate_hz if pair.of in stamps else None
    facts = {
        "v": {name: told if known else dict.fromkeys(told)},
        "time_offset": {name: _facts(pair, fit, delays, bootstrap) if known else {"method": pair.method}},
        "t_zero_ns": {name: fit.alignment.track.origin_ns - fit.coarse_ns},
        "lines": [*_lines(pair, fit, frame_hz, delays, bootstrap, known), *([turned] if flipped and known else [])],
    }
    return Result(
        stage="timeoffset",
        rig=Rig(time_offsets={key: entry}),
        reasons=tuple(reasons),
        residuals=_residual_sets(name, fit),
        facts=facts,
        not_observable=() if known else (f"{key}.offset",),
    )


def early_or_late(of: str, td: float) -> str:
    """Return the offset in words: what the stamps of `of` are, and what to do."""
    if td == 0:
        return f"{of}'s stamps are right"
    word, size = ("early" if td > 0 else "late"), f"{abs(td) * 1e3:.3f} ms" if abs(td) < 1 else f"{abs(td):.6f} s"
    return f"{of}'s stamps are {size} {word}: add {'+' if td > 0 else '-'}{size} to them"


def smear(rate: float, td: float, focal_px: float | None) -> str:
    """Return what an offset costs at a rate of turn: f omega td in px, or the angle where there is no camera."""
    angle = rate * abs(td)
    return f"{focal_px * angle:.2g} px" if focal_px else f"{angle * 1e3:.2g} mrad"


def _lines(pair: Pair, fit: TimeOffsetFit, frame_hz: float | None, delays: Delays, bootstrap: float | None, known: bool) -> list[str]:
    a, (middle, fast) = fit.alignment, rates(fit)
    duration = sum(float(part.stretch.turns.duration.sum()) for part in a.parts)
    span = a.stretches[-1].t[-1] - a.stretches[0].t[0]
    lines = [
        f"{pair.of} ({pair.of_topic}, {pair.method}) against {pair.to} ({pair.to_topic}): {a.turns} of {fit.n_turns} turns over "
        f"{duration:.4g} of {span:.4g} s, {middle:.2g} rad/s in the middle, {fast:.2g} at most",
    ]
    if not known:
        return lines
    ends = [fit.coarse_ns * 1e-9 + end for end in fit.interval]
    unit, scale = ("ms", 1e3) if abs(fit.td) < 1 else ("s", 1.0)
    digits = int(np.clip(1 - np.floor(np.log10(max(scale * fit.sigma, 1e-9))), 1, 9))
    td, low, high = (f"{scale * value:+.{digits}f}" for value in (fit.td, *ends))
    as_they_are = "; the stamps as they are lie within the interval" if ends[0] <= 0 <= ends[1] else ""
    lines += [
        f"  t_{pair.to} = t_{pair.of} + td: {early_or_late(pair.of, fit.td)}{as_they_are}",
        f"  td {td} +- {scale * fit.sigma:.{digits}f} {unit}; 95 %: {low} to {high} {unit} (profile likelihood)"
        + ("" if bootstrap is None else f"; bootstrap over stretches: +- {bootstrap * 1e3:.2g} ms"),
    ]
    if abs(fit.td) < 1:
        costs = [f"{smear(rate, fit.td, pair.focal_px)} at {rate:.2g} rad/s" for rate in (middle, fast)]
        left = smear(fast, fit.sigma, pair.focal_px)
        lines.append(f"  left uncorrected it costs {' and '.join(costs)}; once corrected its sigma still costs {left} at {fast:.2g} rad/s")
    if fit.clock is not None:
        lines += [f"  {text}" for text in describe(fit.clock, pair.to, frame_hz)]
        if fit.clock.kind != "constant":
            lines.append(f"  this td is that of {fit.clock.t_ref_s:.1f} s after the first sample of {pair.to}")
    lines += [f"  {text}" for text in delays.told(pair.of, pair.to, fit.td)]
    if len(a.R) == 3:
        v = np.degrees(so3.log(a.R))
        axes = np.round(open_axes(a), 1) + 0.0
        unknown = "".join(f"; about ({x:.1f}, {y:.1f}, {z:.1f}) of {pair.of} these turns do not tell it" for x, y, z in axes)
        lines.append(f"  rotation found on the way: R_{pair.of}_{pair.to} = exp({v[0]:.3f}, {v[1]:.3f}, {v[2]:.3f}) deg{unknown}")
    return lines


def _facts(pair: Pair, fit: TimeOffsetFit, delays: Delays, bootstrap: float | None) -> dict[str, object]:
    """Return everything in SI units, for machines."""
    a, clock, (middle, fast) = fit.alignment, fit.clock, rates(fit)
    known = np.isfinite(fit.windows.sigma)
    off, off_cov = by_axis(fit)
    return {
        "equation": f"t_{pair.to} = t_{pair.of} + td",
        "method": pair.method,
        "td": fit.td,
        "sigma": fit.sigma,
        "sigma_bootstrap": bootstrap,
        "interval_95": [fit.coarse_ns * 1e-9 + end for end in fit.interval],
        "turns": a.turns,
        "turns_given_up": fit.n_turns - a.turns,
        "rate_median": middle,
        "rate_max": fast,
        "px_at_median_rate": None if pair.focal_px is None else pair.focal_px * middle * abs(fit.td),
        "px_at_max_rate": None if pair.focal_px is None else pair.focal_px * fast * abs(fit.td),
        "rotation_matrix": a.R.tolist() if len(a.R) == 3 else None,
        "gyro_bias": fit.gyro_bias.tolist(),
        "stamp_jitter": float(np.sqrt(a.levels.jitter)),
        "axis_offsets": (fit.td + off).tolist(),
        "axis_sigmas": np.sqrt(np.diag(off_cov)).tolist(),
        "t_zero": f"the first sample of {pair.to}: what t of windows and clock counts from, in s",
        "windows": {
            "t": ((fit.windows.start + fit.windows.stop) / 2)[known].tolist(),
            "td": (fit.coarse_ns * 1e-9 + fit.windows.tau[known]).tolist(),
            "sigma": fit.windows.sigma[known].tolist(),
        },
        "clock": None
        if clock is None
        else {
            "kind": clock.kind,
            "t_of_td": clock.t_ref_s,
            "drifts": clock.drifts,
            "skew": clock.skew,
            "skew_sigma": clock.skew_sigma if np.isfinite(clock.skew_sigma) else None,
            "jumps": [{"t": jump.t_s, "t_sigma": jump.t_sigma_s, "size": jump.size_s, "sigma": jump.sigma_s} for jump in clock.jumps],
        },
        "delays": delays.facts(),
    }


def _against_rig(pair: Pair, fit: TimeOffsetFit, base: Rig) -> list[Reason]:
    """Compare the rotation that was found on the way with the rig file's."""
    found = find_transform(base, pair.of, pair.to)
    if found is None or len(fit.alignment.R) != 3 or not fit.alignment.free_rotation:
        return []
    apart = so3.log(fit.alignment.R @ found[0][:3, :3].T)
    free = open_axes(fit.alignment)
    apart = apart - free.T @ (free @ apart)
    if np.linalg.norm(apart) < _TURNED:
        return []
    turned = np.degrees(np.linalg.norm(apart))
    text = f"the rotation of the rig file ({', '.join(found[1])}) is {turned:.1f} deg off the one that these rates have"
    return [Reason(Verdict.CHECK, f"dt_{pair.to}_{pair.of}: {text}")]


def _residual_sets(name: str, fit: TimeOffsetFit) -> tuple[ResidualSet, ...]:
    """Return turns, V and windows as the report reads them: residuals in rad/s, chi-squared, s."""
    a, coarse = fit.alignment, fit.coarse_ns * 1e-9
    rows = [_turn_rows(a, i, coarse) for i in range(len(a.stretches))]
    joined = {key: np.concatenate([row[key] for row in rows]) for key in rows[0]}
    t_ns, raw = joined.pop("t_ns") - fit.coarse_ns, joined.pop("raw")
    turns = ResidualSet(name, "rad/s", t_ns, raw, np.ones(len(raw)), dict(joined))
    above = fit.cost - fit.cost.min()
    k = len(fit.tau)
    v = ResidualSet(name, "", np.zeros(k, np.int64), above[:, None], np.ones(k), {"delay": coarse + fit.tau})
    w = fit.windows
    middle = (w.start + w.stop) / 2
    clock = a.shift(middle)
    windows = ResidualSet(
        name,
        "s",
        a.track.origin_ns - fit.coarse_ns + np.round(middle * 1e9).astype(np.int64),
        (w.tau - clock)[:, None],
        w.sigma,
        {"window_offset": coarse + w.tau, "window_sigma": w.sigma, "clock": coarse + clock},
    )
    return (turns, v, windows)


def _turn_rows(a: Alignment, i: int, coarse: float) -> dict[str, Array]:
    """Return the columns of one stretch's turns, those that were given up included."""
    stretch = a.stretches[i]
    duration = stretch.turns.duration[:, None]

    def left(shift: Array) -> tuple[Array, Array]:
        turned = stretch.beta(a.track, shift[:, None])
        residual = stretch.turns.angle[:, stretch.axes] / duration - turned[:, 0] / duration @ a.R.T
        out = np.zeros((len(residual), 3))
        out[:, stretch.axes] = residual - np.median(residual, axis=0)  # the bias
        known = a.track.chain_at(stretch.middle + shift[stretch.turns.first]) >= 0
        rate = np.linalg.norm(turned[:, 0] / duration, axis=1)
        return np.where(known[:, None], out, np.nan), np.where(known, rate, np.nan)

    shift = a.shift(stretch.t)
    raw, rate = left(shift)
    before, rate_before = left(np.full_like(stretch.t, -coarse))
    return {
        "t_ns": a.track.origin_ns + np.round(stretch.middle * 1e9).astype(np.int64),
        "raw": np.nan_to_num(raw),
        "kept": a.keep[i],
        "rate": rate,
        "of_rate": np.linalg.norm(stretch.turns.angle / duration, axis=1),
        "rate_before": rate_before,
        "before": before,
    }
