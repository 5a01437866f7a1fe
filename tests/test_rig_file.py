"""The rig file: exact round trips, contradictions refused by name and line, merging, and what no mutation may do."""

import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import Run
from hypothesis import HealthCheck, given, settings
from mutate import mutated, read_or_refused
from rigs import LENSES, T_CAM0_IMU0, T_CAM1_CAM0, camera, full_rig

from calibkit.data.rig import Camera, Estimate, Imu, Rig
from calibkit.data.transforms import find_time_offset, find_transform, make_covariance, make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.geometry import se3
from calibkit.io.rig_file import dump_rig, load_rig, merge_rigs, save_rig, updated
from calibkit.models.cameras import CAMERAS

TEXT = dump_rig(full_rig())


def load(folder: Path, content: str | bytes) -> Rig:
    path = folder / "rig.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_rig(path)


def test_a_rig_comes_back_equal_to_the_last_bit(tmp_path: Path) -> None:
    rig, path = full_rig(), tmp_path / "rig.yaml"
    save_rig(rig, path)
    assert load_rig(path) == rig
    assert list(load_rig(path).cameras["cam0"].parameters) == list(CAMERAS["pinhole-radtan"].parameter_names)
    assert dump_rig(load_rig(path)) == path.read_text()
    with pytest.raises(BadInputError, match="--force"):
        save_rig(rig, path)
    save_rig(Rig(), path, force=True)
    assert load_rig(path) == Rig()


@pytest.mark.parametrize("model", LENSES)
def test_a_point_projects_to_the_same_pixel_after_the_round_trip(tmp_path: Path, model: str) -> None:
    def uv(rig: Rig) -> Any:
        entry = rig.cameras["cam0"]
        params = np.array([entry.parameters[name].value for name in CAMERAS[model].parameter_names], float)
        return CAMERAS[model].project(np.array([[0.3, -0.2, 1.1], [-0.1, 0.25, 0.7]]), params).uv

    rig = Rig(cameras={"cam0": camera(model)})
    np.testing.assert_array_equal(uv(load(tmp_path, dump_rig(rig))), uv(rig))


def test_a_changed_copy_is_checked_before_it_is_written(tmp_path: Path) -> None:
    rig = full_rig()
    fx = rig.cameras["cam0"].parameters["fx"].model_copy(update={"value": math.nan})
    bad = rig.cameras["cam0"].model_copy(update={"parameters": {**rig.cameras["cam0"].parameters, "fx": fx}})
    with pytest.raises(ValueError, match="fx"):
        save_rig(rig.model_copy(update={"cameras": {"cam0": bad}}), tmp_path / "rig.yaml")
    assert not list(tmp_path.iterdir())


def test_the_file_is_for_people() -> None:
    assert "      fx: {value: 458.654, unit: px, sigma: " in TEXT
    assert "    equation: p_cam0 = T_cam0_imu0 p_imu0\n" in TEXT
    assert "    equation: t_imu0 = t_cam0 + dt_imu0_cam0\n    offset: {value: -0.008, unit: s, sigma: 1.0e-05, " in TEXT
    assert "quaternion: Hamilton, stored x y z w\n" in TEXT
    assert "null" not in TEXT.replace("cut: null", "")
    matrix = TEXT[TEXT.index("T_cam0_imu0:\n") :].split("matrix:\n")[1].splitlines()[0]
    assert matrix == f"      - [{', '.join(repr(float(x)) for x in full_rig().transforms['T_cam0_imu0'].matrix[0])}]"
    assert yaml.safe_load(TEXT)["imus"]["imu0"]["gyro_random_walk"]["value"] == 1.9393e-05


def test_a_point_maps_as_the_equation_says() -> None:
    entry = full_rig().transforms["T_cam0_imu0"]
    p_imu = np.array([0.1, 0.2, 0.3, 1])
    p_cam = np.array(entry.matrix) @ p_imu
    np.testing.assert_allclose(p_cam, T_CAM0_IMU0 @ p_imu, atol=1e-15)
    np.testing.assert_allclose(np.array(entry.inverse_matrix) @ p_cam, p_imu, atol=1e-15)


Change = Callable[[dict[str, Any]], object]


def _set(*keys: Any) -> Change:
    """Return the change that puts the last argument under the keys before it."""
    *path, last, value = keys

    def change(data: dict[str, Any]) -> None:
        node: Any = data
        for key in path:
            node = node[key]
        node[last] = value

    return change


CAM, FX, T = ("cameras", "cam0"), ("cameras", "cam0", "parameters", "fx"), ("transforms", "T_cam0_imu0")


def _twin(section: str, name: str, of: str) -> Change:
    """Return the change that gives an entry under another name, too."""
    return lambda data: data[section].update({name: data[section][of]})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("cameraz", {}), r"cameraz: is no key of a rig file; remove it"),
        (_set(*FX, "sigmma", 1.0), r"cameras.cam0.parameters.fx.sigmma: is no key of a rig file"),
        (_set("version", 2), "version: is 2, newer than this calibkit's 1; upgrade calibkit"),
        (_set("version", 0), "version: "),
        (_set("version", "1"), "version: "),
        (_set("format", "x"), "not a calibkit rig file"),
        (_set("conventions", "quaternion", "JPL"), "conventions.quaternion is not the convention"),
        (_set(*FX, "value", math.nan), "fx.value: input should be"),
        (_set(*FX, "value", math.inf), "fx.value: input should be"),
        (_set("provenance", 0, "options", "value", math.nan), "provenance.0.options.value"),
        (_set(*FX, "value", "458.6"), "fx.value: input should be a valid number"),
        (_set(*FX, "value", True), "fx.value: input should be a valid number"),
        (_set(*FX, "value", None), "fx: a value is missing; only a parameter marked 'not observable'"),
        (_set(*FX, "status", "not observable"), "must have value null"),
        (_set(*FX, "sigma", -1.0), "fx.sigma: input should be greater than or equal to 0"),
        (_set(*FX, "sigma", 5.0), "the sigma of fx is 5, but its covariance says"),
        (_set(*CAM, "model", "pinhole"), "the camera model 'pinhole' is not known; it may be one of pinhole-none"),
        (_set(*CAM, "model", "pinhole-radtan5"), "the parameters of pinhole-radtan5 are fx, fy, cx, cy, k1, k2, p1, p2, k3"),
        (_set(*CAM, "resolution", [752, -480]), "cameras.cam0.resolution.1: input should be greater than 0"),
        (_set(*CAM, "resolution", [752]), "cameras.cam0.resolution.1: field required"),
        (_set(*CAM, "covariance", "order", 0, "f"), "covariance.order names 'f'"),
        (_set(*CAM, "covariance", "order", 0, "fy"), "order names a parameter twice"),
        (_set(*CAM, "covariance", "matrix", 0, 1, 1e-9), "matrix is not symmetric"),
        (_set(*T, "covariance", "matrix", 2, 2, -1e-9), "a variance on the diagonal is negative"),
        (_set(*T, "covariance", "matrix", 0, [0.0]), "matrix must be 6 x 6"),
        (_set(*T, "matrix", 0, 0, 0.5), "the upper left 3 x 3 of matrix is not a rotation"),
        (_set(*T, "matrix", 3, 3, 2.0), "the last row of matrix is not 0 0 0 1"),
        (_set(*T, "rotation_xyzw", [1.0, 0.0, 0.0, 0.0]), "rotation_xyzw is not the rotation of matrix"),
        (_set(*T, "rotation_xyzw", [0.0, 0.0, 0.0, 0.0]), "rotation_xyzw is not the rotation of matrix"),
        (_set(*T, "translation", [0.0, 0.0, 0.0]), "translation is not the last column"),
        (_set(*T, "inverse_matrix", np.eye(4).tolist()), "inverse_matrix is not the inverse"),
        (_set(*T, "inverse_name", "T_imu0_cam1"), "T_cam0_imu0 has the inverse T_imu0_cam0, which inverse_name must say"),
        (_twin("transforms", "T_imu0", "T_cam0_imu0"), "transforms.T_imu0: "),
        (_twin("time_offsets", "dt_cam0_imu0", "dt_imu0_cam0"), "dt_imu0_cam0 and dt_cam0_imu0 are both given"),
        (_twin("time_offsets", "dt_imu0_imu0", "dt_imu0_cam0"), "dt_imu0_imu0 is of one sensor"),
        (_twin("cameras", "../x", "cam0"), r"cameras.../x: "),
        (_set("provenance", 0, "residual_file", "../x.npz"), "residual_file must be the bare name"),
        (_set("provenance", 0, "residual_file", "a\\b.npz"), "residual_file must be the bare name"),
        (_set("provenance", 0, "residual_file", "/etc/passwd"), "residual_file must be the bare name"),
        (_set("provenance", 0, "residual_file", ".."), "residual_file must be the bare name"),
        (_set("imus", "imu0", "rate_hz", 0), "imus.imu0.rate_hz: input should be greater than 0"),
        (_set("imus", "imu0", "rate_hz", True), "imus.imu0.rate_hz: input should be a valid number"),
    ],
)
def test_contradictions_are_refused_by_name_and_line(tmp_path: Path, change: Change, message: str) -> None:
    data = copy.deepcopy(yaml.safe_load(TEXT))
    change(data)
    with pytest.raises(BadInputError, match=message) as caught:
        load(tmp_path, yaml.safe_dump(data, sort_keys=False))
    assert str(caught.value).isprintable()
    assert "rig.yaml, line " in str(caught.value)


def test_the_line_is_that_of_the_fault(tmp_path: Path) -> None:
    line = next(i for i, row in enumerate(TEXT.splitlines(), 1) if row.startswith("      k2: "))
    with pytest.raises(BadInputError, match=rf"rig.yaml, line {line}: cameras.cam0.parameters.k2.value: "):
        load(tmp_path, TEXT.replace("k2: {value: 0.07395907", "k2: {value: x"))


def test_a_parameter_that_is_not_observable_is_null_and_stays_so(tmp_path: Path) -> None:
    offset = Estimate(value=None, unit="s", status=Status.NOT_OBSERVABLE)
    rig = Rig(time_offsets={"dt_imu0_cam0": make_time_offset("imu0", "cam0", offset)})
    assert "offset: {value: null, unit: s, status: not observable}" in dump_rig(rig)
    assert load(tmp_path, dump_rig(rig)) == rig


def test_covariances_up_to_rounding_are_accepted_and_beyond_are_not() -> None:
    rng = np.random.default_rng(0)
    scale = np.diag(10.0 ** rng.uniform(-6, 3, 8))
    for rank in (8, 3):
        A = scale @ rng.normal(size=(8, rank))
        make_covariance([f"x{i}" for i in range(8)], A @ A.T)
    with pytest.raises(ValueError, match="correlation beyond 1"):
        make_covariance(["a", "b"], [[1, 1.001], [1.001, 1]])
    with pytest.raises(ValueError, match="negative eigenvalue"):
        make_covariance(["a", "b", "c"], [[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1]])


def test_merging_takes_all_and_refuses_conflicts_by_name() -> None:
    a, b = Path("a.yaml"), Path("b.yaml")
    whole = full_rig()
    left = whole.model_copy(update={"transforms": {}, "time_offsets": {}})
    right = whole.model_copy(update={"cameras": {"cam0": whole.cameras["cam0"]}, "imus": {}, "provenance": []})
    merged = merge_rigs([(a, left), (b, right)])
    assert merged == whole
    other = Rig(cameras={"cam1": camera("pinhole-radtan5")})
    with pytest.raises(BadInputError, match=r"cameras.cam1 differs between a.yaml and b.yaml; remove it from one of them"):
        merge_rigs([(a, whole), (Path("c.yaml"), Rig()), (b, other)])
    turned = Rig(transforms={"T_imu0_cam0": make_transform("imu0", "cam0", se3.inverse(T_CAM0_IMU0))})
    with pytest.raises(BadInputError, match=r"transforms: T_cam0_imu0 and T_imu0_cam0 come from a.yaml and b.yaml"):
        merge_rigs([(a, whole), (b, turned)])


def test_an_imu_may_come_in_parts() -> None:
    a, b = Path("a.yaml"), Path("b.yaml")
    noise = Rig(imus={"imu0": Imu(gyro_noise_density=Estimate(value=1e-4))})
    topic = Rig(imus={"imu0": Imu(topic="/imu0")})
    assert merge_rigs([(a, noise), (b, topic)]).imus["imu0"] == Imu(topic="/imu0", gyro_noise_density=Estimate(value=1e-4))
    with pytest.raises(BadInputError, match=r"imus\.imu0 differs"):
        merge_rigs([(a, noise), (b, Rig(imus={"imu0": Imu(gyro_noise_density=Estimate(value=2e-4))}))])


def test_a_new_result_replaces_the_old_in_either_direction() -> None:
    base, new = full_rig(), Rig(transforms={"T_imu0_cam0": make_transform("imu0", "cam0", np.eye(4))}, imus={"imu1": Imu(topic="/new")})
    rig = updated(base, new)
    assert set(rig.transforms) == {"T_imu0_cam0", "T_cam1_cam0", "T_imu1_imu0"}
    assert rig.imus == {"imu0": base.imus["imu0"], "imu1": Imu(topic="/new")}
    assert rig.cameras == base.cameras
    assert rig.provenance == base.provenance


def test_transforms_are_found_along_chains() -> None:
    rig = full_rig()
    found = find_transform(rig, "cam1", "imu0")
    assert found is not None
    np.testing.assert_allclose(found[0], T_CAM1_CAM0 @ T_CAM0_IMU0, atol=1e-15)
    assert found[1] == ("T_cam1_cam0", "T_cam0_imu0")
    back = find_transform(rig, "imu0", "cam1")
    assert back is not None
    np.testing.assert_allclose(back[0] @ found[0], np.eye(4), atol=1e-15)
    assert find_transform(rig, "cam0", "lidar0") is None
    forward, backward = find_time_offset(rig, "imu0", "cam0"), find_time_offset(rig, "cam0", "imu0")
    assert forward is not None
    assert backward is not None
    assert (forward.value, backward.value) == (-0.008, 0.008)


def _small(entry: Camera) -> Camera:
    return entry.model_copy(update={"covariance": None})


SMALL = dump_rig(full_rig().model_copy(update={"cameras": {"cam0": _small(camera("pinhole-radtan"))}}))


@pytest.mark.slow
def test_a_recording_in_place_of_a_rig_is_told(run: Run, tmp_path: Path) -> None:
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n")
        said = run("validate", tmp_path / name, tmp_path / "rig.yaml", "--target", tmp_path / "board.yaml").mistake
        assert said == f"{tmp_path / name}: is a recording and no rig file; where a command takes both, RIG.yaml comes first"


@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(content=mutated(SMALL))
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    rig = read_or_refused(lambda: load(tmp_path, content))
    if rig is not None:
        text = dump_rig(rig)
        assert load(tmp_path, text) == rig
        assert not any(isinstance(x, float) and not math.isfinite(x) for x in _leaves(yaml.load(text, yaml.CSafeLoader)))


def _leaves(node: Any) -> list[Any]:
    if not isinstance(node, (dict, list)):
        return [node]
    return [leaf for item in (node.values() if isinstance(node, dict) else node) for leaf in _leaves(item)]
