"""Printed boards: the PDF, drawn to pixels, is found by the detectors with every corner in its place."""

import shutil
import subprocess
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from calibkit.cli.main import app
from calibkit.detection.artwork import artwork
from calibkit.detection.boards import detect
from calibkit.errors import BadInputError
from calibkit.io.target_file import load_target
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.opencv import cv2
from calibkit.report import board_pdf
from calibkit.stages.target import print_target

BOARDS = [
    AprilGrid(5, 4, 0.024, 0.3),
    AprilGrid(3, 4, 0.03, 0.25),
    Checkerboard(8, 5, 0.02, 0.02),
    Charuco(7, 6, 0.025, 0.019, "DICT_5X5_100"),
    Charuco(7, 6, 0.025, 0.019, "DICT_5X5_100", legacy=True),
    CircleGrid(7, 6, 0.02),
    CircleGrid(4, 9, 0.012, asymmetric=True),
]
DOTS_PER_MM = 10.0


def page_pixels(monkeypatch: pytest.MonkeyPatch, board: Board, out: Path) -> np.ndarray:
    """The page as gray pixels: of the PDF itself where there is a reader, else of the drawing it is made from."""
    pages: list[Figure] = []
    monkeypatch.setattr("calibkit.stages.target.pdf_bytes", lambda figure: pages.append(figure) or board_pdf.pdf_bytes(figure))
    print_target(board, out)
    reader = shutil.which("pdftoppm")
    if reader:
        command = [reader, "-png", "-gray", "-singlefile", "-r", str(DOTS_PER_MM * 25.4), str(out), str(out.with_suffix(""))]
        subprocess.run(command, check=True, timeout=60)
        data = out.with_suffix(".png").read_bytes()
    else:
        picture = BytesIO()
        pages[0].savefig(picture, format="png", dpi=DOTS_PER_MM * 25.4)
        data = picture.getvalue()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.key())
def test_printed_board_is_found_to_scale(board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = page_pixels(monkeypatch, board, tmp_path / "board.pdf")
    found = detect(image, board)
    assert len(found.corner) == len(board.points)
    up = -1 if artwork(board).y_up else 1  # pixels count down the page
    expected = board.points[found.corner, :2] * (1, up) * 1000 * DOTS_PER_MM
    best = min((expected, -expected), key=lambda e: np.ptp(found.uv - e, axis=0).max())  # a checkerboard may be found upside down
    turned_is_fine = isinstance(board, Checkerboard | CircleGrid)
    off = found.uv - (best if turned_is_fine else expected)
    off -= off.mean(0)
    assert np.abs(off).max() < 0.8, (
        "corners sit where the board's file says, but for the reader's snapping of edges to whole pixels (0.1 mm)"
    )


def test_yaml_beside_reads_back_and_bytes_repeat(tmp_path: Path) -> None:
    board = BOARDS[0]
    done = print_target(board, tmp_path / "a.pdf")
    again = print_target(board, tmp_path / "b.pdf")
    assert load_target(done.yaml) == board
    assert done.pdf.read_bytes() == again.pdf.read_bytes()


def test_pdf_is_vector_and_has_the_page_size(tmp_path: Path) -> None:
    data = print_target(BOARDS[0], tmp_path / "a.pdf", page="a3").pdf.read_bytes()
    assert b"/Subtype /Image" not in data
    box = data.split(b"/MediaBox [")[1].split(b"]")[0].split()
    assert np.allclose([float(v) for v in box[2:]], np.array([297, 420]) / 25.4 * 72, atol=0.01)


@pytest.mark.parametrize(
    ("page", "size", "says"),
    [
        ("a4", (300, 380), "use --page a2"),
        ("a4", (2000, 100), "use --page 2016x130"),
        ("a9", (10, 10), "not known"),
        ("nanx5", (1, 1), "not known"),
    ],
)
def test_page_that_does_not_fit_names_one_that_does(page: str, size: tuple[float, float], says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        board_pdf.page_size(page, size)


def test_page_is_turned_where_the_board_is_wide() -> None:
    assert board_pdf.page_size("a4", (270, 170)) == (297, 210)


def test_command_refuses_existing_files_and_absurd_boards(tmp_path: Path) -> None:
    out = tmp_path / "board.pdf"
    command = ["target", "aprilgrid", "--columns", "3", "--rows", "3", "--tag-size", "0.03", "-o", str(out)]
    runner = CliRunner()
    assert runner.invoke(app, command).exit_code == 0
    before = out.read_bytes()
    again = runner.invoke(app, command)
    assert isinstance(again.exception, BadInputError)
    assert "--force" in str(again.exception)
    assert out.read_bytes() == before
    assert runner.invoke(app, [*command, "--force"]).exit_code == 0
    for columns, size in (("600", "0.03"), ("3", "nan"), ("3", "-1"), ("3", "88")):
        bad = runner.invoke(
            app, ["target", "aprilgrid", "--columns", columns, "--rows", "3", "--tag-size", size, "-o", str(tmp_path / "c.pdf")]
        )
        assert isinstance(bad.exception, BadInputError)
    assert not (tmp_path / "c.pdf").exists()
    assert not (tmp_path / "c.yaml").exists()


def test_millimetres_given_for_metres_are_told(tmp_path):
    with pytest.raises(BadInputError, match=r"metres, such as 0\.03$"):
        print_target(Checkerboard(6, 5, 30.0, 30.0), tmp_path / "b.pdf")
    with pytest.raises(BadInputError, match=r"tag size of 0.004 makes no board"):
        print_target(AprilGrid(6, 6, 0.004, 0.3), tmp_path / "b.pdf")
