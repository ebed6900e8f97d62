"""tile.npz: nothing is lost, the bytes are always the same, and every wrong array is named."""

import dataclasses
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.ba import PRIORS, Free, Observations, PositionPrior, Problem
from jaxba.geometry import BAL, CAMERAS, LOSSES, Barron, Cauchy, Linear, Pose, SimpleRadial
from jaxba.io import SCHEMA, read_loss, read_problem, read_tile, write_bal, write_tile
from jaxba.io._schema import all_specs, prior_specs

IMAGES, CAMERA_COUNT, POINTS, OBSERVATIONS, OFFSETS = 4, 2, 5, 9, 2


def unit(rng: np.random.Generator, rows: int) -> np.ndarray:
    q = rng.normal(size=(rows, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def random_prior(name: str, parameters: int, rng: np.random.Generator):
    """A prior of any kind, by the annotations of its class alone, so that a new kind is tested by itself."""
    sizes = {"images": IMAGES, "cameras": CAMERA_COUNT, "points": POINTS, "parameters": parameters}
    sizes |= {"offsets": OFFSETS, "ends": 2}
    values = {}
    for spec in prior_specs(name):
        shape = tuple(n if isinstance(n, int) else sizes.get(n, 2) for n in spec.shape)
        values[spec.name.removeprefix(f"prior_{name}_")] = (
            rng.integers(0, sizes[spec.indexes], shape).astype(np.int32) if spec.indexes
            else unit(rng, shape[0]) if spec.unit_norm
            else rng.normal(size=shape)
        )  # fmt: skip
    loss = list(LOSSES.values())[(list(PRIORS).index(name) + 3) % len(LOSSES)]
    return PRIORS[name](**values, loss=loss(f_scale=2.5) if loss is not Barron else Barron(alpha=-0.5, f_scale=2.5))


def random_problem(model: str = "OPENCV", priors: tuple[str, ...] = tuple(PRIORS), seed: int = 0) -> Problem:
    rng = np.random.default_rng(seed)
    parameters = len(CAMERAS[model].parameter_names())
    return Problem(
        poses=Pose(unit(rng, IMAGES), rng.normal(size=(IMAGES, 3))),
        cameras=CAMERAS[model](*rng.normal(size=(parameters, CAMERA_COUNT))),
        camera_index=rng.integers(0, CAMERA_COUNT, IMAGES).astype(np.int32),
        points=rng.normal(size=(POINTS, 3)),
        observations=Observations(
            rng.normal(size=(OBSERVATIONS, 2)),
            rng.uniform(0.5, 2, OBSERVATIONS),
            rng.integers(0, IMAGES, OBSERVATIONS).astype(np.int32),
            rng.integers(0, POINTS, OBSERVATIONS).astype(np.int32),
        ),
        priors=tuple(random_prior(name, parameters, rng) for name in priors),
        lever_arm=rng.normal(size=3),
        free=Free(
            rng.random(IMAGES) < 0.5,
            rng.random(POINTS) < 0.5,
            rng.random((CAMERA_COUNT, parameters)) < 0.5,
            np.array(True),
            np.array(True),
        ),
        position_offset=rng.normal(size=(OFFSETS, 3)),
        lower=np.where(rng.random((CAMERA_COUNT, parameters)) < 0.5, -np.inf, -9.0),
        upper=np.where(rng.random((CAMERA_COUNT, parameters)) < 0.5, np.inf, 9.0),
        image_names=tuple(f"DJI_{i}_ä.JPG" for i in range(IMAGES)),
    )


def minimal() -> dict[str, Any]:
    """What another program must write at least: Python numbers and strings through numpy.savez."""
    return {
        "schema": "jaxba.tile",
        "version": 1,
        "camera_model": "SIMPLE_RADIAL",
        "pose_quaternion_wxyz": [[1.0, 0, 0, 0], [0, 0, 0, 1]],
        "pose_translation_m": np.zeros((2, 3)),
        "camera_parameters": [[800.0, 320, 240, 0.01]],
        "camera_index": [0, 0],
        "point_xyz_m": np.array([[1, 2, 30], [3, 4, 50], [0, 0, 40]]),
        "observation_xy_px": np.ones((4, 2), np.float32),
        "observation_image_index": np.array([0, 0, 1, 1], np.uint8),
        "observation_point_index": [0, 1, 1, 2],
    }


def savez(folder: Path, arrays: dict[str, Any]) -> Path:
    path = folder / "tile.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("priors", [(), *((name,) for name in PRIORS), tuple(PRIORS)], ids="+".join)
@pytest.mark.parametrize("model", CAMERAS)
def test_written_problem_reads_back_exactly(tmp_path: Path, model: str, priors: tuple[str, ...]):
    problem = random_problem(model, priors)
    write_tile(tmp_path / "tile.npz", problem)
    assert eqx.tree_equal(read_tile(tmp_path / "tile.npz"), problem)
    assert eqx.tree_equal(read_problem(tmp_path / "tile.npz"), problem)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_loss_reads_back_exactly(tmp_path: Path, loss: type):
    prior = PositionPrior(
        image_index=np.array([1], np.int32),
        xyz=np.ones((1, 3)),
        std_m=np.full((1, 3), np.inf),
        loss=loss(f_scale=0.1),
    )
    problem = eqx.tree_at(lambda p: p.priors, random_problem(priors=()), (prior,))
    write_tile(tmp_path / "tile.npz", problem)
    assert eqx.tree_equal(read_tile(tmp_path / "tile.npz"), problem)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_loss_of_observations_reads_back_exactly(tmp_path: Path, loss: type):
    problem, path = random_problem(priors=()), tmp_path / "tile.npz"
    write_tile(path, problem)
    assert read_loss(path) is None
    write_tile(path, problem, loss=loss(f_scale=0.1))
    assert eqx.tree_equal(read_loss(path), loss(f_scale=0.1))
    assert eqx.tree_equal(read_tile(path), problem)


def test_equal_problems_give_equal_bytes_whatever_types_and_layouts_they_have(tmp_path: Path):
    problem = random_problem()
    write_tile(tmp_path / "a.npz", problem)
    other = dataclasses.replace(
        problem,
        points=np.asfortranarray(problem.points),
        camera_index=np.asarray(problem.camera_index, np.int64),
        poses=Pose(jnp.asarray(problem.poses.quaternion), jnp.asarray(problem.poses.translation)),
        priors=problem.priors[::-1],
    )
    write_tile(tmp_path / "b.npz", other)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_numpy_reads_what_is_written_in_the_types_of_the_schema(tmp_path: Path):
    write_tile(tmp_path / "tile.npz", random_problem(), extras={"inlier": np.ones(OBSERVATIONS, bool)})
    kinds = {spec.name: spec.kind for spec in all_specs()} | {"extra_inlier": "bool"}
    with np.load(tmp_path / "tile.npz", allow_pickle=False) as tile:
        assert {n: "str" if tile[n].dtype.kind == "U" else tile[n].dtype.name for n in tile} == {
            n: kinds[n] for n in tile
        }
    assert read_tile(tmp_path / "tile.npz").num_images == IMAGES  # extras are carried, not read


def test_numpy_savez_alone_writes_a_tile_and_defaults_are_those_of_build(tmp_path: Path):
    arrays = minimal()
    arrays |= {"prior_position_image_index": [1], "prior_position_xyz": np.ones((1, 3)), "extra_note": "any"}
    arrays |= {"prior_position_std_m": [[1, 1, 2]]}
    problem = read_tile(savez(tmp_path, arrays))
    position = PositionPrior(
        image_index=np.array([1], np.int32), xyz=np.ones((1, 3)), std_m=np.array([[1.0, 1, 2]]), loss=Linear()
    )
    indices = np.array([[0, 0, 1, 1], [0, 1, 1, 2]], np.int32)
    expected = Problem.build(
        Pose(np.array([[1.0, 0, 0, 0], [0, 0, 0, 1]]), np.zeros((2, 3))),
        SimpleRadial(800.0, 320.0, 240.0, 0.01),
        np.array([[1.0, 2, 30], [3, 4, 50], [0, 0, 40]]),
        Observations(np.ones((4, 2)), np.ones(4), *indices),
        priors=(position,),
    )
    assert eqx.tree_equal(problem, expected)


ATTITUDE = {"prior_attitude_image_index": [0], "prior_attitude_std_rad": np.ones((1, 3))}
POSITION = {
    "prior_position_image_index": [0],
    "prior_position_xyz": np.ones((1, 3)),
    "prior_position_std_m": np.ones((1, 3)),
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": None}, "is not a tile, it lacks the arrays schema = 'jaxba.tile' and version = 1"),
        ({"schema": "colmap"}, "schema is 'colmap', expected 'jaxba.tile'"),
        ({"version": 2}, "version is 2, this jaxba reads version 1 .*update jaxba"),
        ({"version": 1.0}, r"version is 1\.0, this jaxba reads version 1 \(an integer\)"),
        ({"camera_model": None}, "arrays are missing, add them: camera_model .*SIMPLE_PINHOLE"),
        ({"camera_model": "FULL_OPENCV"}, "camera_model is 'FULL_OPENCV'; use one of SIMPLE_PINHOLE"),
        ({"camera_model": ["OPENCV"]}, r"camera_model is \['OPENCV'\]; use one of"),
        (
            {"point_xyz_m": None, "camera_index": None},
            r"missing, add them: camera_index \(images,\) int32; point_xyz_m \(points, 3\) float64\.",
        ),
        ({"observations_xy_px": np.ones((4, 2))}, r"'observations_xy_px' is not .* \(is it 'observation_xy_px'\?\)"),
        ({"inlier": np.ones(4, bool)}, "'inlier' is not in the schema.*begin its name with 'extra_'"),
        (
            {"camera_index": [0, 0, 0]},
            r"camera_index has the shape \(3,\), expected \(images,\) = \(2,\) with 2 images by pose_quaternion_wxyz",
        ),
        (
            {"camera_parameters": [[800.0, 320, 240]]},
            r"camera_parameters has the shape \(1, 3\), expected \(cameras, param.* 4 parameters by camera_model",
        ),
        ({"point_xyz_m": np.ones(9)}, r"point_xyz_m has the shape \(9,\), expected \(points, 3\)"),
        ({"point_xyz_m": np.ones((3, 2))}, r"point_xyz_m has the shape \(3, 2\), expected \(points, 3\) = \(3, 3\)"),
        ({"camera_index": [0.0, 0.0]}, "camera_index has the type float64, expected int32: use numpy.int32"),
        ({"free_poses": [1, 1]}, "free_poses has the type int64, expected bool"),
        ({"image_names": [b"a", b"b"]}, r"image_names has the type \|S1, expected str"),
        ({"point_xyz_m": np.ones((3, 3), complex)}, "point_xyz_m has the type complex128, expected float64"),
        ({"point_xyz_m": np.array([[object()] * 3])}, "array 'point_xyz_m' cannot be read .*not Python objects"),
        ({"observation_image_index": [0, 0, 1, 2**40]}, "observation_image_index has the type int64, expected int32"),
        ({"observation_point_index": [0, 1, 3, -1]}, r"observation_point_index\[2\] is 3, but points .* to 2.*2 of 4"),
        ({"camera_index": [0, 1]}, r"camera_index\[1\] is 1, but cameras go from 0 to 0"),
        (
            {"camera_parameter_names": ["f", "cx", "cy", "k"]},
            r"camera_parameter_names are \['f', 'cx', 'cy', 'k'\], but SIMPLE_RADIAL has \['f', 'cx', 'cy', 'k1'\]",
        ),
        ({"pose_quaternion_wxyz": np.ones((2, 4))}, r"pose_quaternion_wxyz\[0\] has the norm 2, expected 1"),
        ({"pose_quaternion_wxyz": np.full((2, 4), np.nan)}, r"pose_quaternion_wxyz\[0\] has the norm nan"),
        (ATTITUDE | {"prior_attitude_quaternion": [[0, 0, 0, 0]]}, r"prior_attitude_quaternion\[0\] has the norm 0"),
        (ATTITUDE, r"missing, add them: prior_attitude_quaternion \(attitude_rows, 4\) float64"),
        ({"prior_position_loss": "huber"}, "missing, add them: prior_position_image_index"),
        (POSITION | {"prior_position_loss": "l1"}, "prior_position_loss is 'l1'; use one of linear, soft_l1"),
        (POSITION | {"prior_position_loss_alpha": 1.0}, "loss_alpha is given, but linear has f_scale only"),
        *(
            (POSITION | {"prior_position_loss": "cauchy", "prior_position_loss_f_scale": scale},
             f"prior_position_loss_f_scale: loss Cauchy: f_scale is {text}; give a positive number of sigmas")
            for scale, text in ((0.0, "0"), (-1.0, "-1"), (np.nan, "nan"), (np.inf, "inf"))
        ),
        *(
            (POSITION | {"prior_position_loss": "barron", "prior_position_loss_alpha": alpha},
             f"prior_position_loss_alpha: loss Barron: alpha is {text}; give 2")
            for alpha, text in ((2.5, "2.5"), (np.nan, "nan"), (np.inf, "inf"))
        ),
        ({"observation_loss_f_scale": 2.0}, "observation_loss_f_scale is given, but no observation_loss; name"),
        ({"observation_loss": "l1"}, "observation_loss is 'l1'; use one of linear, soft_l1"),
        ({"observation_loss": "huber", "observation_loss_alpha": 1.0},
         "observation_loss_alpha is given, but huber has f_scale only"),
        ({"observation_loss": "huber", "observation_loss_f_scale": 0.0},
         "observation_loss_f_scale: loss Huber: f_scale is 0; give a positive number of sigmas"),
        (POSITION | {"prior_position_offset_weights": np.ones((1, 2)), "position_offset_m": np.zeros((1, 3))},
         r"prior_position_offset_weights has the shape \(1, 2\), expected \(position_rows, offsets\) = \(1, 1\)"),
        (POSITION | {"prior_position_image_index": [2]}, r"image_index\[0\] is 2, but images go from 0 to 1"),
        (POSITION | {"prior_position_xyz": np.ones((2, 3))}, "with 1 position_rows by prior_position_image_index"),
    ],
)  # fmt: skip
def test_wrong_array_is_named_with_what_was_expected(tmp_path: Path, changes: dict[str, Any], message: str):
    arrays = {name: value for name, value in (minimal() | changes).items() if value is not None}
    with pytest.raises(JaxbaError, match=rf"tile\.npz: .*{message}"):
        read_tile(savez(tmp_path, arrays))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty; write or copy it again"),
        (b"21 11315 36455\n", "is not an npz file, it begins with b'21 11315'"),
        (b"PK\x03\x04" + bytes(100), "is truncated or damaged .*write or copy it again"),
    ],
)
def test_file_that_is_no_npz_is_named(tmp_path: Path, content: bytes, message: str):
    (tmp_path / "tile.npz").write_bytes(content)
    with pytest.raises(JaxbaError, match=message):
        read_tile(tmp_path / "tile.npz")


def test_zip_of_other_files_is_named(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "tile.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(JaxbaError, match=r"'readme\.txt' is not a numpy array"):
        read_problem(tmp_path / "tile.npz")


def test_truncated_or_flipped_file_is_an_error_or_the_same_problem(tmp_path: Path):
    path, problem = tmp_path / "tile.npz", random_problem()
    write_tile(path, problem)
    data, rng, refused = path.read_bytes(), np.random.default_rng(0), 0
    for length in rng.integers(0, len(data), 60):
        path.write_bytes(data[:length])
        with pytest.raises(JaxbaError):
            read_tile(path)
    for place in rng.integers(0, len(data), 400):
        path.write_bytes(data[:place] + bytes([data[place] ^ int(rng.integers(1, 256))]) + data[place + 1 :])
        try:
            assert eqx.tree_equal(read_tile(path), problem)  # a byte that says nothing, as a date
        except JaxbaError:
            refused += 1
    assert refused > 200


@pytest.mark.parametrize("read", [read_tile, read_problem])
def test_missing_file_and_folder_are_named(tmp_path: Path, read):
    with pytest.raises(JaxbaError, match=r"none\.npz: no such file"):
        read(tmp_path / "none.npz")
    with pytest.raises(JaxbaError, match="is a folder; give a file in it"):
        read(tmp_path)


class OtherBAL(BAL):
    pass


class OtherLoss(Cauchy):
    pass


def test_writer_refuses_what_a_reader_could_not_take_and_leaves_no_file(tmp_path: Path):
    problem = random_problem()
    first = problem.priors[0]
    other_loss = dataclasses.replace(first, loss=OtherLoss())
    wrong = [
        (dataclasses.replace(problem, camera_index=np.zeros(3, np.int32)), "not written: camera_index has the shape"),
        (dataclasses.replace(problem, priors=(first, first)), "two priors named 'position'"),
        (dataclasses.replace(problem, priors=(other_loss,)), "OtherLoss has no name in files; use one of Linear"),
        (
            dataclasses.replace(random_problem("BAL"), cameras=OtherBAL(*np.ones((3, 2)))),
            "OtherBAL has no name in files",
        ),
    ]
    for bad, message in wrong:
        with pytest.raises(JaxbaError, match=message):
            write_tile(tmp_path / "new.npz", bad)
    with pytest.raises(JaxbaError, match="extra 'mixed' holds Python objects"):
        write_tile(tmp_path / "new.npz", problem, extras={"mixed": np.array([None])})
    with pytest.raises(JaxbaError, match=r"Write a tile\.npz instead"):
        write_bal(tmp_path / "new.npz", problem)
    assert list(tmp_path.iterdir()) == []


def test_schema_has_every_array_once_with_a_meaning_and_units_where_there_are_numbers():
    names = [spec.name for spec in all_specs()]
    assert len(names) == len(set(names))
    for spec in all_specs():
        assert spec.meaning
        assert spec.unit or spec.kind != "float64", f"{spec.name}: give its unit in _PRIOR_FIELDS"
    assert {spec.name for spec in SCHEMA} <= set(names)
