"""A frame as a picture: found corners, and how far from them the model puts them."""

import numpy as np
from numpy.typing import NDArray

from calibkit.detection.found import Image, to_8_bit
from calibkit.opencv import cv2

Array = NDArray[np.float64]
WIDTH = 640
KEPT, DROPPED, LINE = (140, 60, 0), (0, 0, 220), (90, 0, 130)  # BGR, all dark: they must show in black and white too
SHIFT = 4  # cv2 draws at 1/16 px
STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500)


def draw_corners(image: Image, found: Array, predicted: Array, kept: NDArray[np.bool_], caption: str) -> bytes:
    """Return a JPEG about 640 px wide: kept corners as circles, dropped ones as crosses, a line from each towards its prediction.

    `found`, `predicted` (n, 2) px. The lines are magnified, the factor stands in the caption's strip.
    """
    gray = to_8_bit(image)
    scale = WIDTH / gray.shape[1]
    size = (WIDTH, max(1, round(gray.shape[0] * scale)))
    picture = cv2.cvtColor(cv2.resize(gray, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR), cv2.COLOR_GRAY2BGR)
    picture = cv2.addWeighted(picture, 0.5, np.full_like(picture, 255), 0.5, 0)  # paler, so that the marks stand out
    residual = predicted - found
    factor = _magnification(residual[kept] * scale)
    start = (found + 0.5) * scale - 0.5
    usable = np.all(np.isfinite(start), axis=1)
    end = np.where(np.isfinite(residual), start + np.clip(factor * scale * residual, -2 * WIDTH, 2 * WIDTH), start)
    for a, b, good in zip(_fixed(start[usable]), _fixed(end[usable]), kept[usable], strict=True):
        cv2.line(picture, a, b, LINE, 1, cv2.LINE_AA, SHIFT)
        if good:
            cv2.circle(picture, a, 3 << SHIFT, KEPT, 1, cv2.LINE_AA, SHIFT)
        else:
            cv2.drawMarker(picture, (a[0] >> SHIFT, a[1] >> SHIFT), DROPPED, cv2.MARKER_TILTED_CROSS, 9, 2, cv2.LINE_AA)
    strip = np.full((22, size[0], 3), 255, np.uint8)
    text = f"{caption}   o kept  x dropped   lines x{factor}".encode("ascii", "replace").decode()
    cv2.putText(strip, text[:110], (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    done, jpeg = cv2.imencode(".jpg", np.vstack([picture, strip]), [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert done
    return bytes(jpeg.tobytes())


def _magnification(residual: Array) -> int:
    """Return the largest round factor that keeps the 90th percentile of the lines below 20 px."""
    length = np.linalg.norm(residual[np.all(np.isfinite(residual), axis=1)], axis=1)
    typical = np.percentile(length, 90) if len(length) else 0.0
    return max((step for step in STEPS if step * typical <= 20), default=1)


def _fixed(points: Array) -> list[tuple[int, int]]:
    whole = np.round(np.clip(points, -1e4, 1e4) * (1 << SHIFT)).astype(int)
    return [(int(x), int(y)) for x, y in whole]
