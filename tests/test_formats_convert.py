"""`calibkit import` and `export` on the command line, and cameras that a format cannot hold."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Run
from rigs import LENSES, SIZES, camera, full_rig

from calibkit.data.rig import Rig
from calibkit.estimation.model_conversion import convert, nearest
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.models.cameras import CAMERAS


@pytest.mark.parametrize("name", LENSES)
def test_a_model_in_its_own_terms_is_exact(name: str) -> None:
    model, params = CAMERAS[name], np.array(LENSES[name])
    found = convert(model, params, SIZES[name], model)
    assert found.worst_px < 1e-9
    assert found.lost == 0
    np.testing.assert_allclose(found.params, params, rtol=1e-6, atol=1e-9)


def test_a_larger_model_without_its_extra_terms_is_held_exactly() -> None:
    params = np.array([*LENSES["pinhole-radtan"], 0.0])
    found = nearest(CAMERAS["pinhole-radtan5"], params, (752, 480), [CAMERAS["pinhole-equi"], CAMERAS["pinhole-radtan"]])
    assert found.model.name == "pinhole-radtan"
    assert found.worst_px < 1e-9
    np.testing.assert_allclose(found.params, LENSES["pinhole-radtan"], rtol=1e-9)


def test_the_error_that_is_said_is_the_error() -> None:
    """Away from the fitted grid, too: no pixel of the image is off by more than a little over the figure."""
    source, params, size = CAMERAS["pinhole-radtan5"], np.array(LENSES["pinhole-radtan5"]), SIZES["pinhole-radtan5"]
    found = convert(source, params, size, CAMERAS["pinhole-radtan"])
    uv = np.random.default_rng(0).uniform([0, 0], np.array(size) - 1.0, (5000, 2))
    rays, valid = source.unproject(uv, params)
    error = np.linalg.norm(found.model.project(rays, found.params).uv - uv, axis=-1)[valid]
    assert 0.5 * found.worst_px < error.max() < 1.02 * found.worst_px
    assert np.sqrt(np.mean(error**2)) == pytest.approx(found.rms_px, rel=0.2)


def test_what_a_pinhole_cannot_see_counts_as_lost() -> None:
    wide = np.array([150.0, 150.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0])  # 120 deg off the axis at the image's side
    found = convert(CAMERAS["pinhole-equi"], wide, (640, 480), CAMERAS["pinhole-radtan"])
    assert found.lost > 0.2


def test_a_lossy_export_is_refused_unless_asked_for(run: Run, tmp_path: Path) -> None:
    save_rig(Rig(cameras={"cam0": camera("pinhole-radtan5")}), tmp_path / "rig.yaml")
    export = ("export", tmp_path / "rig.yaml", "--to", "kalibr", "-o", tmp_path / "out")
    message = run(*export).mistake
    assert "cam0: kalibr would hold pinhole-" in message
    assert "instead of pinhole-radtan5, off by at most " in message
    assert message.endswith("or pass --lossy")
    assert not (tmp_path / "out").exists()
    said = run(*export, "--lossy")
    assert "note: cam0: written as pinhole-" in said.err
    assert (said.code, said.out) == (0, f"written: {tmp_path / 'out' / 'camchain.yaml'}\n")


def test_a_conversion_below_a_tenth_of_a_pixel_is_said_and_done(run: Run, tmp_path: Path) -> None:
    entry = camera("pinhole-radtan5")
    near = entry.model_copy(update={"covariance": None, "parameters": {**entry.parameters, "k3": entry.parameters["p1"]}})  # k3 = 1e-4
    save_rig(Rig(cameras={"cam0": near}), tmp_path / "rig.yaml")
    said = run("export", tmp_path / "rig.yaml", "--to", "kalibr", "-o", tmp_path / "out")
    assert said.code == 0
    assert "note: cam0: written as pinhole-radtan instead of pinhole-radtan5, off by at most 0.0" in said.err
    assert yaml.safe_load((tmp_path / "out" / "camchain.yaml").read_text())["cam0"]["distortion_model"] == "radtan"


def test_the_commands_manners(run: Run, tmp_path: Path) -> None:
    save_rig(full_rig(), tmp_path / "rig.yaml")
    out = tmp_path / "out"
    export = ("export", tmp_path / "rig.yaml", "--to", "kalibr", "-o", out)
    assert run(*export).code == 0
    assert "--force" in run(*export).mistake
    assert run(*export, "--force").code == 0
    bring = ("import", *sorted(out.iterdir()), "-o", tmp_path / "new.yaml")
    said = run(*bring)
    assert said.code == 0
    assert said.out.endswith(f"cameras 2, IMUs 2, transforms 4, time offsets 2 written to {tmp_path / 'new.yaml'}\n")
    assert run(*bring).code == 2
    made = load_rig(tmp_path / "new.yaml").provenance[0]
    assert made.stage == "import"
    assert made.command.startswith("calibkit import ")
    assert [entry.name for entry in made.inputs] == ["camchain.yaml", "imu.yaml", "imu1.yaml"]
    assert all(entry.sha256 for entry in made.inputs)
    for arguments, words in [
        (("export", tmp_path / "rig.yaml", "--to", "vinyl", "-o", out), "--to vinyl: no such format; choose one of kalibr, ros, opencv"),
        (("export", tmp_path / "absent.yaml", "--to", "ros", "-o", out), "absent.yaml: cannot be read"),
        (("export", tmp_path / "rig.yaml", "--to", "ros", "-o", tmp_path / "rig.yaml"), "rig.yaml: is a file; give the name of a folder"),
        (("export", tmp_path / "rig.yaml", "--to", "ros", "-o", tmp_path / "rig.yaml" / "b"), "b: cannot be made"),
        (("import", tmp_path / "rig.yaml", "-o", tmp_path / "x.yaml"), "is a rig file already"),
        (("import", out, "-o", tmp_path / "x.yaml"), "out: is not a file"),
        (("import", out / "imu.yaml", out / "imu.yaml", "-o", out / "no" / "x.yaml"), "there is no folder"),
    ]:
        assert words in run(*arguments).mistake
    assert not (tmp_path / "x.yaml").exists()


def test_an_export_never_replaces_the_rig_that_it_comes_from(run: Run, tmp_path: Path) -> None:
    rig = tmp_path / "camchain.yaml"
    save_rig(full_rig(), rig)
    before = rig.read_bytes()
    assert "camchain.yaml: is the rig file that is exported" in run("export", rig, "--to", "kalibr", "-o", tmp_path, "--force").mistake
    assert rig.read_bytes() == before
    assert run("export", rig, "--to", "kalibr", "-o", tmp_path / "new" / "folder").code == 0
