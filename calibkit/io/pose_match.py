"""Which pose of a robot belongs to which image: by name, by the number in the name, else by order where there are as many."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.plural import counted
from calibkit.errors import BadInputError, one_line
from calibkit.io.pose_files import PoseTable


@dataclass(frozen=True)
class Matches:
    """Pairs of rows: pose[k] of the table belongs to image[k]."""

    pose: NDArray[np.intp]
    image: NDArray[np.intp]
    how: str  # one sentence for people


def _base(name: str) -> str:
    return re.split(r"[\\/]", name)[-1].strip()


def _stem(name: str) -> str:
    return re.sub(r"\.[A-Za-z]{1,4}$", "", _base(name))  # .png and not .5 of a stamp


def _last_number(name: str) -> str:
    numbers = re.findall(r"[0-9]+", _stem(name))
    return numbers[-1].lstrip("0") or "0" if numbers else ""


def match_images(table: PoseTable, images: Sequence[str]) -> Matches:
    """Return which pose belongs to which image, the images in natural order; BadInputError where neither names nor counts tell."""
    path = one_line(table.path)
    if table.labels is not None:
        for what, key in (("file name", _base), ("name without its ending", _stem)):
            if found := _by_key(table, images, key):
                return _told(table, images, found, f"by {what}")
        plain = all(_last_number(label) and _stem(label) == _base(label) for label in table.labels)  # 1, pose_01, and no im_01.png
        if plain and images and _same_count(table, images):
            return _told(table, images, _by_key(table, images, _last_number), "by the number in the name")
        if not all(label.isdecimal() for label in table.labels):
            first, other = one_line(table.labels[0], 60), one_line(images[0], 60) if images else "none"
            raise BadInputError(
                f"{path}: names no image that is there ({first}; images: {other}): give the right folder, or remove the names"
            )
    if len(table.poses) != len(images):
        raise BadInputError(
            f"{path} has {counted(len(table.poses), 'pose')} and there are {counted(len(images), 'image')}: "
            "name the image of each pose in its first column, or remove what has no partner"
        )
    every = np.arange(len(images))
    return Matches(every, every, f"{path}: {counted(len(images), 'pose')} and as many images are paired in their order")


def _by_key(table: PoseTable, images: Sequence[str], key: Callable[[str], str]) -> list[tuple[int, int]]:
    """Return pairs (pose, image) of one key; BadInputError where a key that pairs stands twice on either side."""
    place: dict[str, list[int]] = {}
    for i, name in enumerate(images):
        place.setdefault(key(name), []).append(i)
    pairs: list[tuple[int, int]] = []
    seen: dict[str, int] = {}
    for row, label in enumerate(table.labels or ()):
        word = key(label)
        if not word or word not in place:
            continue
        if word in seen or len(place[word]) > 1:
            where = f"{table.places[row]}: {one_line(label, 60)}"
            what = f"stands for {table.places[seen[word]]} too" if word in seen else f"fits {len(place[word])} images"
            raise BadInputError(f"{one_line(table.path)}, {where} {what}: give each image one pose and one name")
        seen[word] = row
        pairs.append((row, place[word][0]))
    return pairs


def _same_count(table: PoseTable, images: Sequence[str]) -> bool:
    """Tell whether counters and the numbers of images begin alike and one holds the other: counted from 0 or from 1 on both sides."""
    poses, names = ({_last_number(name) for name in side} for side in (table.labels or (), images))
    first = [min(side, key=lambda word: (len(word), word)) for side in (poses, names)]  # as numbers, of any length
    return first[0] == first[1] and (poses <= names or names <= poses)


def _told(table: PoseTable, images: Sequence[str], pairs: list[tuple[int, int]], how: str) -> Matches:
    pose, image = np.array(pairs, np.intp).T
    lost = [(len(table.poses) - len(pairs), "pose", "without an image"), (len(images) - len(pairs), "image", "without a pose")]
    left = ", ".join(f"{counted(n, what)} {why}" for n, what, why in lost if n)
    return Matches(
        pose, image, f"{one_line(table.path)}: {counted(len(pairs), 'pose')} found {how}" + (f"; left out: {left}" if left else "")
    )
