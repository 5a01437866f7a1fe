"""All image decoding, to gray: raw ROS encodings, compressed messages, image files. Sizes are checked before allocation."""

import io
import warnings
from collections.abc import Callable
from functools import cache, partial
from types import ModuleType
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import BadInputError, one_line
from calibkit.opencv import cv2

Gray = NDArray[np.uint8] | NDArray[np.uint16]
MAX_PIXELS = 150_000_000  # of one image; the largest sensors have as many, and Pillow refuses more than 178 million
SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff"})
_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TIFF")


def _first(plane: NDArray[np.generic], channel: int) -> NDArray[np.generic]:
    return plane[:, :, channel]


def _convert(plane: NDArray[np.generic], code: int) -> NDArray[np.generic]:
    gray: NDArray[np.generic] = cv2.cvtColor(np.ascontiguousarray(plane), code)
    return gray


class _Encoding(NamedTuple):
    """How a raw encoding of sensor_msgs/image_encodings.h lies in memory, and how it becomes gray."""

    kind: str  # numpy type of one channel
    channels: int
    to_gray: Callable[[NDArray[np.generic]], NDArray[np.generic]]


def _encodings() -> dict[str, _Encoding]:
    gray = partial(_first, channel=0)
    table = {"mono8": _Encoding("u1", 1, gray), "mono16": _Encoding("u2", 1, gray)}
    table |= {"8UC1": table["mono8"], "16UC1": table["mono16"]}
    colours = {
        "bgr": (3, cv2.COLOR_BGR2GRAY),
        "rgb": (3, cv2.COLOR_RGB2GRAY),
        "bgra": (4, cv2.COLOR_BGRA2GRAY),
        "rgba": (4, cv2.COLOR_RGBA2GRAY),
    }
    # OpenCV names a Bayer pattern by the second pixel of its second row, ROS by the first row.
    bayer = {"rggb": cv2.COLOR_BayerBG2GRAY, "bggr": cv2.COLOR_BayerRG2GRAY, "gbrg": cv2.COLOR_BayerGR2GRAY, "grbg": cv2.COLOR_BayerGB2GRAY}
    for bits, kind in (("8", "u1"), ("16", "u2")):
        for name, (channels, code) in colours.items():
            table[name + bits] = _Encoding(kind, channels, partial(_convert, code=code))
        for name, code in bayer.items():
            table[f"bayer_{name}{bits}"] = _Encoding(kind, 1, partial(_convert, code=code))
    table |= {"8UC3": table["bgr8"], "8UC4": table["bgra8"], "16UC3": table["bgr16"]}
    # The luma of packed 4:2:2 is every second byte: U Y V Y (yuv422, uyvy) or Y U Y V.
    table |= dict.fromkeys(("yuv422", "uyvy"), _Encoding("u1", 2, partial(_first, channel=1)))
    table |= dict.fromkeys(("yuv422_yuy2", "yuyv"), _Encoding("u1", 2, gray))
    return table


_ENCODINGS = _encodings()


def decode_raw(width: int, height: int, encoding: str, bigendian: bool, step: int, data: NDArray[np.uint8], where: str) -> Gray:
    """Return a raw sensor_msgs/Image as gray (h, w), uint8 or uint16; `where` names it in errors."""
    layout = _ENCODINGS.get(encoding)
    if layout is None:
        raise BadInputError(
            f"{where}: image encoding {one_line(encoding, 40)!r} is not read: publish one of {', '.join(sorted(_ENCODINGS))}"
        )
    if not (0 < width * height <= MAX_PIXELS):
        raise BadInputError(f"{where}: an image of {width} x {height} is not possible; at most {MAX_PIXELS} pixels are read")
    kind = np.dtype(layout.kind).newbyteorder(">" if bigendian else "<")
    row = width * layout.channels * kind.itemsize
    if step < row or height * step > data.size:
        raise BadInputError(f"{where}: {data.size} bytes and step {step} cannot hold {width} x {height} {encoding}: the message is damaged")
    rows = data[: height * step].reshape(height, step)[:, :row]
    planes = np.ascontiguousarray(rows).view(kind).reshape(height, width, layout.channels)
    native = planes.astype(kind.newbyteorder("="), copy=False)
    gray = layout.to_gray(native if layout.channels > 1 or layout.to_gray.func is _first else native[:, :, 0])  # type: ignore[attr-defined]
    return np.array(gray)  # writable, and free of the message


@cache
def _pillow() -> ModuleType:
    """Return Pillow's images: slow to import, and raw ones do without."""
    from PIL import Image

    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # MAX_PIXELS is checked instead
    return Image


def decode_compressed(data: bytes | NDArray[np.uint8], where: str) -> Gray:
    """Return an image file's bytes as gray (h, w), pixels as stored (an orientation tag is not obeyed)."""
    pillow = _pillow()
    try:
        with pillow.open(io.BytesIO(bytes(data)), formats=_FORMATS) as header:
            width, height = header.size
    except (OSError, ValueError, SyntaxError) as error:
        what = "damaged, or of another kind" if isinstance(error, pillow.UnidentifiedImageError) else one_line(error, 120)
        reason = what if len(data) else "it is empty"
        raise BadInputError(f"{where}: not a readable image ({reason}); jpeg, png, bmp, pgm and tiff are read") from error
    except pillow.DecompressionBombError as error:
        raise BadInputError(f"{where}: the image is too large; at most {MAX_PIXELS} pixels are read") from error
    if not 0 < width * height <= MAX_PIXELS:
        raise BadInputError(f"{where}: an image of {width} x {height} is too large; at most {MAX_PIXELS} pixels are read")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        gray = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise BadInputError(f"{where}: the image is damaged ({one_line(error, 120)})") from error
    if gray is None or gray.dtype.name not in ("uint8", "uint16"):
        raise BadInputError(f"{where}: the image is damaged, or its pixels are not 8 or 16 bit")
    return cast(Gray, gray)
