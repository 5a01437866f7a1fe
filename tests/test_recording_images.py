"""Every raw encoding and image format becomes gray; sizes that cannot be are refused before anything is allocated."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from recording_helper import Make, write

from calibkit.errors import BadInputError
from calibkit.io.images import decode_compressed, decode_raw
from calibkit.io.recording import open_recording

T0 = 1_700_000_000_000_000_000
H, W = 24, 32
RNG = np.random.default_rng(0)


def _smooth() -> np.ndarray:
    """A colour image that demosaicing can restore."""
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    return np.stack([40 + 5 * x, 200 - 4 * y, 60 + 2 * x + 3 * y], axis=-1).astype(np.uint8)  # B G R


BGR = _smooth()
GRAY = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
ALPHA = np.full((H, W, 1), 255, np.uint8)


def _bayer(pattern: str) -> np.ndarray:
    """Sample BGR by a pattern named, as in ROS, by its first two rows: bayer_rggb has red in the top-left pixel."""
    mosaic = np.zeros((H, W), np.uint8)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = BGR[row::2, column::2, "bgr".index(colour)]
    return mosaic


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("mono8", GRAY),
        ("8UC1", GRAY),
        ("bgr8", BGR),
        ("8UC3", BGR),
        ("rgb8", BGR[:, :, ::-1]),
        ("bgra8", np.concatenate([BGR, ALPHA], axis=2)),
        ("rgba8", np.concatenate([BGR[:, :, ::-1], ALPHA], axis=2)),
        ("yuv422", np.stack([np.full((H, W), 128, np.uint8), GRAY], axis=-1)),
        ("uyvy", np.stack([np.full((H, W), 128, np.uint8), GRAY], axis=-1)),
        ("yuyv", np.stack([GRAY, np.full((H, W), 128, np.uint8)], axis=-1)),
        ("yuv422_yuy2", np.stack([GRAY, np.full((H, W), 128, np.uint8)], axis=-1)),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_encodings_become_gray(encoding: str, pixels: np.ndarray, padding: int) -> None:
    rows = np.ascontiguousarray(pixels).reshape(H, -1)
    data = np.pad(rows, ((0, 0), (0, padding)))
    gray = decode_raw(W, H, encoding, False, data.shape[1], data.ravel(), "x")
    np.testing.assert_array_equal(gray, GRAY)
    assert gray.flags.writeable


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_not_mixed_up(pattern: str) -> None:
    mosaic = _bayer(pattern)
    gray = decode_raw(W, H, f"bayer_{pattern}8", False, W, mosaic.ravel(), "x")
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(gray[inner].astype(int) - GRAY[inner]).max() <= 2
    wide = decode_raw(W, H, f"bayer_{pattern}16", False, 2 * W, (mosaic.astype("<u2") * 256).view(np.uint8).ravel(), "x")
    assert np.abs(wide[inner] / 256 - GRAY[inner]).max() <= 2


@pytest.mark.parametrize("bigendian", [False, True])
def test_mono16_keeps_its_bits_in_either_byte_order(bigendian: bool) -> None:
    pixels = RNG.integers(0, 65536, (H, W)).astype(">u2" if bigendian else "<u2")
    gray = decode_raw(W, H, "mono16", bigendian, 2 * W, pixels.view(np.uint8).ravel(), "x")
    assert gray.dtype == np.uint16
    np.testing.assert_array_equal(gray, pixels)


@pytest.mark.parametrize(
    ("width", "height", "encoding", "step", "told"),
    [
        (W, H, "32FC1", 4 * W, "'32FC1' is not read"),
        (W, H + 1, "mono8", W, "cannot hold"),
        (W, H, "mono8", W - 1, "cannot hold"),
        (W, H, "mono8", 0, "cannot hold"),
        (0, H, "mono8", W, "not possible"),
        (2**31, 2**31, "mono8", 2**31, "not possible"),
        (2**16, 2**14, "mono8", 2**16, "not possible"),
    ],
)
def test_raw_images_that_cannot_be_are_refused(width: int, height: int, encoding: str, step: int, told: str) -> None:
    with pytest.raises(BadInputError, match=f"rec: /cam at 1.*{told}"):
        decode_raw(width, height, encoding, False, step, np.zeros(H * W, np.uint8), "rec: /cam at 1")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".pgm", ".tiff"])
def test_image_files_become_gray(suffix: str) -> None:
    data = cv2.imencode(suffix, GRAY)[1].tobytes()
    assert np.abs(decode_compressed(data, "x").astype(int) - GRAY).max() <= (4 if suffix == ".jpg" else 0)


def test_16_bit_png_keeps_its_bits() -> None:
    pixels = RNG.integers(0, 65536, (H, W), np.uint16)
    np.testing.assert_array_equal(decode_compressed(cv2.imencode(".png", pixels)[1].tobytes(), "x"), pixels)


def test_an_orientation_tag_is_not_obeyed() -> None:
    data = cv2.imencode(".jpg", GRAY)[1].tobytes()
    exif = b"Exif\0\0" + b"II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (W, H)
    assert decode_compressed(turned, "x").shape == (H, W)


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)) + chunk(b"IEND", b"")


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("size", [(13_000, 12_000), (60_000, 60_000)])
def test_a_png_that_declares_too_many_pixels_is_refused_by_its_header(size: tuple[int, int]) -> None:
    with pytest.raises(BadInputError, match=r"a\.png"):
        decode_compressed(_png(*size), "a.png")


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", b"not an image", _png(8, 8), cv2.imencode(".png", GRAY)[1].tobytes()[:60]])
def test_damaged_images_are_refused(data: bytes) -> None:
    with pytest.raises(BadInputError, match=r"a\.png"):
        decode_compressed(data, "a.png")


def test_compressed_messages(tmp_path: Path) -> None:
    make = Make("ros1")
    jpeg, png = (cv2.imencode(suffix, GRAY)[1].tobytes() for suffix in (".jpg", ".png"))
    messages = [
        ("/cam/compressed", T0, make.compressed(T0, "bgr8; jpeg compressed bgr8", jpeg)),
        ("/cam/compressed", T0 + 1, make.compressed(T0 + 1, "png", png)),
        ("/depth/compressedDepth", T0, make.compressed(T0, "16UC1; compressedDepth", png)),
    ]
    recording = open_recording([write(tmp_path, "ros1-lz4", messages)])
    first, second = recording.images(recording.choose("image"))
    assert np.abs(first.decode().astype(int) - GRAY).max() <= 4
    np.testing.assert_array_equal(second.decode(), GRAY)
    assert first.label == "1700000000.000000000"
    with pytest.raises(BadInputError, match="/depth/compressedDepth is video- or depth-coded"):
        recording.images("/depth/compressedDepth")


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", r"a\.png: not a readable image \(it is empty\); jpeg, png"),
        (b"no image at all", r"a\.png: not a readable image \(damaged, or of another kind\); jpeg, png"),
        (b"P5 40000 40000 255\n", r"a\.png: .*too large; at most 150000000 pixels"),
    ],
)
def test_why_an_image_cannot_be_read_is_said_in_words(data: bytes, told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        decode_compressed(data, "a.png")
