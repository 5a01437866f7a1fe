"""The corner cache's key: any change to the code that finds corners is another key."""

import shutil
import time
import zipfile
from pathlib import Path

import pytest

import calibkit
from calibkit.detection import cache
from calibkit.detection.cache import CornerCache, code_hash
from calibkit.models.board import AprilGrid

BOARD = AprilGrid(4, 3, 0.088, 0.3)
PACKAGE = Path(calibkit.__file__).parent


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for name in ("detection", "models", "io"):
        shutil.copytree(PACKAGE / name, tmp_path / "calibkit" / name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "calibkit"


def test_every_module_that_finds_corners_counts(copy: Path) -> None:
    known = {code_hash(copy)}
    detectors = sorted((copy / "detection").rglob("*.py"))
    assert len(detectors) > 10
    for module in [*detectors, copy / "models" / "board.py", copy / "io" / "images.py"]:
        module.write_bytes(module.read_bytes() + b"#")
        assert code_hash(copy) not in known, module
        known.add(code_hash(copy))
    (copy / "detection" / "new").mkdir()
    (copy / "detection" / "new" / "board.py").write_text("")
    assert code_hash(copy) not in known


def test_a_zip_hashes_alike_and_code_without_source_goes_by_the_version(copy: Path, tmp_path: Path) -> None:
    archive = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path, "calibkit"))
    assert code_hash(copy) == code_hash(PACKAGE)
    with zipfile.ZipFile(archive) as packed:
        assert code_hash(zipfile.Path(packed, "calibkit/")) == code_hash(PACKAGE)
    for module in copy.rglob("*.py"):
        module.rename(module.with_suffix(".pyc"))
    assert code_hash(copy) == calibkit.__version__
    assert code_hash(tmp_path / "nowhere") == calibkit.__version__


def test_the_key_holds_the_code_and_opencv(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    keys = set()
    for code, opencv in (("one", "4.14"), ("two", "4.14"), ("two", "5.0")):
        monkeypatch.setattr(cache, "code_hash", lambda package, code=code: code)
        monkeypatch.setattr(cache.cv2, "__version__", opencv)
        cache._detector.cache_clear()
        with CornerCache(tmp_path / "c.sqlite3") as corners:
            keys.add(corners.key(b"image", BOARD))
    cache._detector.cache_clear()
    assert len(keys) == 3


def test_the_hash_costs_next_to_nothing() -> None:
    spent = []
    for _ in range(5):
        began = time.perf_counter()
        code_hash(PACKAGE)
        spent.append(time.perf_counter() - began)
    assert min(spent) < 0.01, f"{min(spent) * 1e3:.2f} ms"
