"""A made-up result of an intrinsics run, for the tests of the report and the residual file: boards of 144 corners seen by a pinhole."""

import numpy as np

from calibkit.data.result import ResidualSet, Result, Thumbnail
from calibkit.data.rig import Camera, Estimate, Reprojection, Rig, StageRun
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.detection.thumbnails import draw_corners
from calibkit.geometry import se3, so3
from calibkit.models.board import AprilGrid

SIZE = (752, 480)
F, CX, CY = 460.0, 370.0, 245.0


def residual_set(frames=40, noise=0.2, pattern=None, seed=0, sensor="cam0", outliers=20):
    """Boards all over the image with white noise of `noise` px a coordinate; `pattern(uv)` px is added to every residual."""
    rng = np.random.default_rng(seed)
    board = AprilGrid(6, 6, 0.088, 0.3).points
    board = board - board.mean(0)
    T = se3.make(
        so3.exp(rng.uniform(-0.6, 0.6, (frames, 3))),
        np.stack([rng.uniform(-0.5, 0.5, frames), rng.uniform(-0.3, 0.3, frames), rng.uniform(0.6, 1.2, frames)], -1),
    )
    p = se3.transform(T, board)
    predicted = np.array([F, F]) * p[..., :2] / p[..., 2:] + np.array([CX, CY])
    inside = np.all((predicted > 5) & (predicted < np.array(SIZE) - 6), axis=-1)
    frame, corner = (i.astype(np.int32) for i in np.nonzero(inside))
    uv = predicted[inside]
    raw = rng.normal(0, noise, uv.shape) + (0 if pattern is None else pattern(uv))
    kept = np.ones(len(raw), bool)
    bad = rng.choice(len(raw), outliers, replace=False)
    raw[bad] += rng.normal(0, 6, (outliers, 2))
    kept[bad] = False
    tilt = np.arccos(np.clip(np.abs(T[:, 2, 2]), 0, 1))
    context = {
        "uv": uv + raw, "corner": corner, "frame": frame, "kept": kept, "distance": np.linalg.norm(p[inside], axis=1), "tilt": tilt[frame],
    }  # fmt: skip
    t_ns = (1_500_000_000_000_000_000 + 50_000_000 * frame.astype(np.int64)).astype(np.int64)
    return ResidualSet(sensor, "px", t_ns, raw, np.full(len(raw), noise), context)


def result(name="cam0", topic="/cam0/image_raw", residuals=None, reasons=None, thumbnails=3, parameters=None):
    """An intrinsics Result with one camera."""
    residuals = residual_set(sensor=name) if residuals is None else residuals
    n_frames = int(residuals.context["frame"].max()) + 1
    labels = [f"{1.5e9 + 0.05 * i:.6f}" for i in range(n_frames)]
    if parameters is None:
        parameters = {
            key: Estimate(value=value, unit=unit, sigma=sigma, sigma_plain=sigma / 1.7, status=Status.DETERMINED)
            for key, value, sigma, unit in [
                ("fx", F, 0.045, "px"), ("fy", F, 0.047, "px"), ("cx", CX, 0.06, "px"), ("cy", CY, 0.055, "px"),
                ("k1", -0.283408, 1.2e-4, ""), ("k2", 0.0739591, 2.1e-4, ""), ("p1", 1.9359e-4, 1.1e-5, ""), ("p2", 1.76187e-5, 1.3e-5, ""),
            ]
        }  # fmt: skip
    camera = Camera(
        topic=topic,
        resolution=SIZE,
        model="pinhole-radtan",
        equation="uv = f (1 + k1 r^2 + k2 r^4) x + ...",
        parameters=parameters,
        reprojection=Reprojection(rms_px=0.283, rms_all_px=0.6, held_out_rms_px=0.289, corners=5000, frames=n_frames),
        verdict=Verdict.PASS,
    )
    command = "calibkit intrinsics rig.bag --target april.yaml"
    run = StageRun(stage="intrinsics", command=command, calibkit="0.1", inputs=[{"name": "rig.bag", "sha256": "0" * 64}])
    return Result(
        stage="intrinsics",
        rig=Rig(cameras={name: camera}, provenance=[run]),
        reasons=(Reason(Verdict.PASS, f"{name}: reprojection rms 0.28 px over 5000 corners"),) if reasons is None else reasons,
        residuals=(residuals,),
        facts={"frame_labels": {name: labels}, "n_images": n_frames + 2},
        thumbnails=tuple(thumbnail(residuals, i, labels[i]) for i in range(thumbnails)),
    )


def thumbnail(residuals, frame, label):
    """The frame's corners on a picture of uneven gray."""
    rows = residuals.context["frame"] == frame
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    image = (110 + 60 * np.sin(x / 40) * np.sin(y / 40)).astype(np.uint8)
    uv = residuals.context["uv"][rows]
    return Thumbnail(label, draw_corners(image, uv, uv - residuals.raw[rows], residuals.context["kept"][rows], f"cam0 {label} rms 0.3 px"))
