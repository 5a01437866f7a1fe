"""Boards in rendered images and a video: tags found, corner errors against truth, CPU a frame, beside OpenCV's ArUco; and the cores' use.

python benchmarks/detection.py [--frames 20]
"""

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from itertools import chain, repeat
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from calibkit.data.observations import ImageFrame
from calibkit.data.progress import silent
from calibkit.detection.boards import detect
from calibkit.detection.find import find_boards
from calibkit.detection.found import Detection
from calibkit.detection.sequence import Sequence
from calibkit.geometry import so3
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import RenderStyle, SimCamera, place_board, random_board_poses
from calibkit.simulation.render import Renderer

T = TypeVar("T")
WANTED_MS = 15.0
BOARD = AprilGrid(6, 6, 0.088, 0.3)
CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 460.1, 367.3, 248.1, -0.28, 0.07, 2e-4, 2e-5]), (752, 480))
# How the frames look, their tilt in degrees
CASES = {
    "easy": (RenderStyle(), 30),
    "blur 1.5 px": (RenderStyle(blur_px=1.5), 30),
    "blur 2.5 px": (RenderStyle(blur_px=2.5), 30),
    "noise 10": (RenderStyle(noise=10), 30),
    "noise 25": (RenderStyle(noise=25), 30),
    "low contrast": (RenderStyle(black=80, white=110, noise=1), 30),
    "tilt 45": (RenderStyle(), 45),
    "tilt 60": (RenderStyle(), 60),
}
Frames = list[tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.bool_]]]


def render(style: RenderStyle, tilt_deg: float, n: int) -> Frames:
    """Return n images with the truth (144, 2) and which corners are well inside the image."""
    rng = np.random.default_rng(0)
    renderer, frames = Renderer(CAMERA, BOARD, style), []
    for T in random_board_poses(CAMERA, BOARD, n, rng, max_tilt=np.deg2rad(tilt_deg), max_roll=np.pi, fill=(0.55, 0.75)):
        truth = CAMERA.model.project(BOARD.points @ T[:3, :3].T + T[:3, 3], CAMERA.params)
        inside = truth.valid & np.all((truth.uv > 6) & (truth.uv < np.array(CAMERA.size) - 7), axis=-1)
        frames.append((renderer.render(T, rng), truth.uv, np.repeat(inside.reshape(-1, 4).all(1), 4)))
    return frames


def aruco() -> cv2.aruco.ArucoDetector:
    """OpenCV's own detector as people set it for this board."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)


def least(work: Callable[[], T], repeats: int = 5) -> tuple[float, T]:
    """Return the least CPU seconds of several runs, what other programs on the machine disturb least, and the result."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times), result


def cpu_seconds() -> float:
    """CPU time of this process and of those that it has ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def judge(name: str, frames: Frames) -> float:
    """Print one line of the table; return our CPU milliseconds a frame."""
    opencv, found_by_opencv, found, wrong, errors, normalised, cpu, cpu_opencv = aruco(), 0, 0, 0, [], [], [], []
    for image, truth, inside in frames:
        seconds, ours = least(lambda image=image: detect(image, BOARD))
        cpu.append(seconds)
        seconds, (_, ids, _) = least(lambda image=image: opencv.detectMarkers(image))
        cpu_opencv.append(seconds)
        found_by_opencv += 0 if ids is None else len(ids)
        error = ours.uv - truth[ours.corner]
        found += int(inside[ours.corner].sum())
        wrong += int((np.linalg.norm(error, axis=1) > 1.5).sum())
        errors.append(error)
        normalised.append(error / ours.sigma_px[:, None])
    total = sum(int(inside.sum()) for _, _, inside in frames)
    rms = np.sqrt((np.concatenate(errors) ** 2).sum(1).mean())
    honest = np.sqrt((np.concatenate(normalised) ** 2).mean())
    milliseconds = 1000 * float(np.median(cpu))
    print(
        f"{name:14}{found / total:8.1%}{4 * found_by_opencv / total:9.1%}{rms:10.4f}{honest:8.2f}{wrong:7}"
        f"{milliseconds:9.1f}{1000 * float(np.median(cpu_opencv)):9.1f}"
    )
    return milliseconds


def video(n: int) -> None:
    """Print what following a board through a video of n images costs, and how far its corners are from those of a search."""
    rng, renderer, phase = np.random.default_rng(0), Renderer(CAMERA, BOARD, RenderStyle()), np.linspace(0, n / 20, n)  # s, 20 Hz
    turn = np.stack([0.3 * np.sin(3 * phase), 0.3 * np.cos(2.5 * phase), 0.5 * np.sin(2 * phase)], axis=1)
    place = np.stack([0.15 * np.sin(2.2 * phase), 0.1 * np.sin(3.1 * phase), 0.75 + 0.1 * np.cos(phase)], axis=1)
    images = [renderer.render(place_board(BOARD, so3.exp(w), p), rng) for w, p in zip(turn, place, strict=True)]

    def follow() -> list[Detection]:
        sequence = Sequence(BOARD)
        return [sequence.look(image) for image in images]

    cpu_search, searched = least(lambda: [detect(image, BOARD) for image in images], 2)
    cpu_follow, followed = least(follow, 2)
    apart = []
    for ours, theirs in zip(followed, searched, strict=True):
        _, i, j = np.intersect1d(ours.corner, theirs.corner, return_indices=True)
        apart.append(np.linalg.norm(ours.uv[i] - theirs.uv[j], axis=1))
    rms = np.sqrt(np.mean(np.concatenate(apart) ** 2))
    corners_searched, corners_followed = (sum(len(found.corner) for found in every) for every in (searched, followed))
    print(
        f"video of {n} images: searched {1000 * cpu_search / n:.1f} ms CPU an image, {corners_searched} corners; "
        f"followed {1000 * cpu_follow / n:.1f} ms, {corners_followed} corners, {rms:.4f} px rms from the others"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=20)
    n = parser.parse_args().frames
    cv2.setNumThreads(1)
    print(f"{'':14}{'corners':>8}{'OpenCV':>9}{'rms px':>10}{'/sigma':>8}{'wrong':>7}{'ms CPU':>9}{'OpenCV':>9}")
    with threadpool_limits(1, user_api="blas"):
        detect(np.zeros((480, 752), np.uint8), BOARD)
        easy = render(*CASES["easy"], n)
        milliseconds = judge("easy", easy)
        for name, (style, tilt) in CASES.items():
            if name != "easy":
                judge(name, render(style, tilt, n))
        video(5 * n)
    images = chain.from_iterable(repeat([image for image, _, _ in easy], 10))
    frames = [ImageFrame(k, str(k), b"", partial(np.asarray, image)) for k, image in enumerate(images)]
    start, cpu = time.perf_counter(), cpu_seconds()
    find_boards(frames, BOARD, "cam0", None, silent, len(frames))
    wall, cpu = time.perf_counter() - start, cpu_seconds() - cpu
    print(f"find_boards: {len(frames)} frames, {1000 * wall / len(frames):.1f} ms wall and {1000 * cpu / len(frames):.1f} ms CPU a frame")
    print(f"easy frames: {milliseconds:.1f} ms CPU a frame, asked <= {WANTED_MS:g}: {'met' if milliseconds <= WANTED_MS else 'NOT met'}")


if __name__ == "__main__":
    main()
