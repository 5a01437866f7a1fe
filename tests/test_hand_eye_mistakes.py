"""The sample of a robot from the command line, and mistakes that newcomers make with it: each is told with its cause and remedy."""

import re
from pathlib import Path

import numpy as np
import pytest
from commands import Run
from numpy.typing import NDArray
from test_hand_eye import ONLY_X, SIGMA_P, SIGMA_R, noisy, poses, recorded, spread

from calibkit.data.result import Thumbnail
from calibkit.data.verdict import Verdict, worst
from calibkit.errors import NotObservableError
from calibkit.estimation.hand_eye import calibrate_hand_eye
from calibkit.estimation.hand_eye_data import of_recording
from calibkit.estimation.hand_eye_doubts import strangers
from calibkit.estimation.hand_eye_lag import stretch
from calibkit.estimation.hand_eye_setup import choose_fit, choose_setup
from calibkit.estimation.hand_eye_verdict import Doubts, judge_hand_eye
from calibkit.geometry import se3
from calibkit.io.residual_file import load_result
from calibkit.io.rig_file import load_rig

Array = NDArray[np.float64]
SAMPLE = Path(__file__).resolve().parent.parent / "sample_bags"
ASKED = (SAMPLE / "hand_eye", "--target", SAMPLE / "target.yaml", "--model", "pinhole-radtan")


def pictures(path: Path) -> tuple[Thumbnail, ...]:
    rig = load_rig(path)
    return load_result(path, rig, rig.provenance[-1]).thumbnails


def test_the_sample_gives_its_truth_and_shows_its_worst_images(run: Run, tmp_path: Path) -> None:
    rig, report = tmp_path / "rig.yaml", tmp_path / "report"
    said = run("handeye", *ASKED, "--poses", SAMPLE / "hand_eye/poses.csv", "-o", rig, "--report", report)
    assert said.code == 0, said
    assert "warning" not in said.err  # names that are no stamps, and the pose file among the images, are nothing to warn of
    assert "poses.csv: 20 poses found by file name" in said.out
    assert "if the camera is fixed beside the robot, the poses are the other way round: --setup eye-to-hand --inverse-poses" in said.out
    assert run("handeye", *ASKED, "--poses", SAMPLE / "hand_eye/poses.csv", "--setup", "eye-in-hand", "--strict").code == 0
    truth = load_rig(SAMPLE / "truth_hand_eye.yaml")
    for name in ("T_gripper_cam0", "T_base_target"):
        entry = load_rig(rig).transforms[name]
        assert entry.covariance is not None
        off, cov = se3.local(np.array(truth.transforms[name].matrix), np.array(entry.matrix)), np.array(entry.covariance.matrix)
        assert off @ np.linalg.solve(cov, off) < 22.5  # chi-squared of 6, 99.9 %
        assert np.sqrt(np.diag(cov)).max() < 2e-4
    shown = pictures(rig)
    assert len(shown) == 10
    captions = [re.fullmatch(r"im_\d\d\.jpg: ([\d.]+) deg, ([\d.]+) mm, ([\d.]+) px", picture.label) for picture in shown]
    assert all(captions)
    assert max(float(caption[3]) for caption in captions if caption) < 1
    assert all(picture.jpeg.startswith(b"\xff\xd8\xff") for picture in shown)
    assert shown[0].label in (report / "report.html").read_text()


def test_a_wrong_pose_is_the_first_image_with_a_guess(run: Run, tmp_path: Path) -> None:
    lines = (SAMPLE / "hand_eye/poses.csv").read_text().splitlines()
    name = [line.split(",", 1)[0] for line in lines]
    lines[3], lines[8] = (f"{name[i]},{lines[j].split(',', 1)[1]}" for i, j in ((3, 8), (8, 3)))
    rig = tmp_path / "rig.yaml"
    (tmp_path / "exchanged.csv").write_text("\n".join(lines) + "\n")
    said = run("handeye", *ASKED, "--poses", tmp_path / "exchanged.csv", "-o", rig)
    assert said.code == 0, said
    assert "2 of 20 poses do not fit the others and are left out" in said.out
    first = [picture.label for picture in pictures(rig)][:2]
    assert {label.split(":")[0] for label in first} == {"im_03.jpg", "im_08.jpg"}
    assert all("left out: it fits the pose of im_0" in label for label in first)


def test_poses_in_another_order_are_refused(run: Run, tmp_path: Path) -> None:
    header, *lines = (SAMPLE / "hand_eye/poses.csv").read_text().splitlines()
    numbers = [line.split(",", 1)[1] for line in np.random.default_rng(0).permutation(lines)]
    (tmp_path / "shuffled.csv").write_text("\n".join([header.split(",", 1)[1], *numbers]) + "\n")
    for setup in ((), ("--setup", "eye-in-hand")):
        said = run("handeye", *ASKED, "--poses", tmp_path / "shuffled.csv", *setup, "-o", tmp_path / "never.yaml")
        assert "no more alike than chance" in said.mistake
        assert "check which pose belongs to which image, --pose-format" in said.mistake
    assert not (tmp_path / "never.yaml").exists()


def test_strangers_are_told_from_poses_that_are_merely_bad() -> None:
    for s in range(10):
        rng = np.random.default_rng(s)
        _, data, _ = recorded("eye-in-hand", spread(rng), rng, outliers=0.4)
        assert not strangers(data.P, data.Q)
        assert not strangers(data.P[1:], data.Q[:-1])  # out of step, which is told as such
        _, data, _ = recorded("eye-in-hand", spread(rng), rng)
        assert strangers(data.P[rng.permutation(30)], data.Q)
        assert strangers(spread(rng), data.Q)
        assert not strangers(data.P[:5], data.Q[5:10])  # too few to tell
        still = np.tile(np.eye(4), (30, 1, 1))
        assert not strangers(noisy(still, rng), noisy(still, rng))


def test_a_board_of_another_size_is_told_with_its_sigma_and_no_other() -> None:
    for s in range(20):
        rng = np.random.default_rng(s)
        _, data, _ = recorded("eye-in-hand", spread(rng, 20), rng, 0.1)
        fit = calibrate_hand_eye(data, ONLY_X)
        assert stretch(fit.data, fit.refined, fit.trusted.inflation) is None  # five sigmas: no chance
        first, second = data.P, se3.inverse(data.Q)
        second[:, :3, 3] *= 1.05
        wrong = calibrate_hand_eye(of_recording("eye-in-hand", first, second), ONLY_X)
        found = stretch(wrong.data, wrong.refined, wrong.trusted.inflation)
        assert found is not None
        assert abs(found.factor - 1 / 1.05) < min(4 * found.sigma, 0.01)
        reasons = judge_hand_eye("T_gripper_cam", wrong, (), Doubts(), "refined").reasons
        said = " ".join(reason.text for reason in reasons)
        off = se3.local(wrong.X, fit.X)
        assert np.linalg.norm(found.moves[:3] - off[:3]) < 0.3 * np.linalg.norm(off[:3]) + 1e-3
        assert worst(reasons) is Verdict.FAIL  # it moves X by far more than its sigma
        assert f"the second side's lengths times {found.factor:.4f}" in said


def test_what_else_could_fit_is_told_with_the_choice() -> None:
    rng = np.random.default_rng(0)
    X, Z = poses(rng, 1, 1.0, 0.1)[0], poses(rng, 1, 1.0, 0.7)[0]
    G = spread(rng)
    G, seen = noisy(G, rng, SIGMA_R, SIGMA_P), noisy(se3.inverse(G @ X) @ Z, rng, SIGMA_R, SIGMA_P)
    both = ("eye-in-hand", "eye-to-hand")
    choice = choose_setup(G, seen, None, both)
    assert choice.setup == "eye-in-hand"
    assert "the poses are the other way round: --setup eye-to-hand --inverse-poses; else confirm it" in choice.unconfirmed
    assert choose_setup(G, seen, "eye-in-hand", both).unconfirmed == ""
    choice = choose_setup(se3.inverse(G), seen, None, both)
    assert choice.setup == "eye-to-hand"
    assert "if the camera is on the gripper, the poses are the other way round: --setup eye-in-hand --inverse-poses" in choice.unconfirmed
    fits = {setup: calibrate_hand_eye(of_recording(setup, G, seen), ONLY_X) for setup in both}
    assert "--setup eye-to-hand --inverse-poses" in choose_fit(fits).unconfirmed
    with pytest.raises(NotObservableError, match="do not tell"):
        choose_fit({"eye-in-hand": fits["eye-in-hand"], "eye-to-hand": fits["eye-in-hand"]})


def rows_of(folder: Path, **sides: Array) -> list[Path | str]:
    """Files of 16 numbers a row, and the words that name them as pairs."""
    out: list[Path | str] = []
    for name, T in sides.items():
        np.savetxt(folder / f"{name}.txt", T.reshape(len(T), 16), fmt="%.12g")
        out += ["--pairs", folder / f"{name}.txt"]
    return out


def test_the_same_poses_on_both_sides_are_refused(run: Run, tmp_path: Path) -> None:
    G = spread(np.random.default_rng(0), 12)
    for second in (G, se3.inverse(G)):
        for words in ((), ("--setup", "motion"), ("--setup", "eye-in-hand"), ("--motions",)):
            said = run("handeye", *rows_of(tmp_path, a=G, b=second), *words, "-o", tmp_path / "never.yaml")
            assert "a.txt, b.txt: both sides have the same poses" in said.mistake
            assert "was one file or topic given twice?" in said.mistake
    assert not (tmp_path / "never.yaml").exists()


def test_a_setup_that_three_poses_do_not_tell_is_not_observable(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    _, data, _ = recorded("eye-in-hand", spread(rng, 3), rng)
    asked = rows_of(tmp_path, robot=data.P, board=se3.inverse(data.Q))
    said = run("handeye", *asked, "-o", tmp_path / "never.yaml")
    assert (said.code, said.out) == (3, "")
    assert "3 poses do not tell" in said.err
    assert "10 or more are needed; or give --setup" in said.err
    assert not (tmp_path / "never.yaml").exists()
    assert run("handeye", *asked, "--setup", "eye-in-hand").code == 0


def test_images_with_brackets_in_their_names_are_found(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "shots[1]"
    folder.mkdir()
    for image in (SAMPLE / "hand_eye").glob("im_*.jpg"):
        (folder / f"im[{image.stem[-2:]}].jpg").write_bytes(image.read_bytes())
    poses_csv = re.sub(r"im_(\d\d)\.jpg", r"im[\1].jpg", (SAMPLE / "hand_eye/poses.csv").read_text())
    (tmp_path / "poses.csv").write_text(poses_csv)
    said = run("handeye", folder, *ASKED[1:], "--poses", tmp_path / "poses.csv", "-o", tmp_path / "rig.yaml")
    assert said.code == 0, said
    assert "20 poses found by file name" in said.out
    assert any(picture.label.startswith("im[") for picture in pictures(tmp_path / "rig.yaml"))
