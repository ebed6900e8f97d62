"""BAL files against BAL's own formula, the literature's costs, and broken files."""

import bz2
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.ba import LeverArmPrior, Problem
from jaxba.geometry import Cauchy, Pinhole
from jaxba.io import read_bal, read_problem, write_bal

TOY = """2 1 2

0 0     3.5 -4.25
1 0     1e1 2

0.1 0.2 0.3
0 0 -1
800 -1e-3 2e-5
0 0 0
0 0 -1
500 0 0

1 2 -30
"""


def bal_residuals(path: Path) -> np.ndarray:
    """Pixel minus measurement by the published formula, in BAL's frame, from the numbers of the file."""
    words = np.array(path.read_text().split(), dtype=float)
    num_cameras, num_points, num_observations = words[:3].astype(int)
    rows, cameras, points = np.split(words[3:], np.cumsum([4 * num_observations, 9 * num_cameras]))
    rows, cameras, points = rows.reshape(-1, 4), cameras.reshape(-1, 9), points.reshape(num_points, 3)
    of_row = cameras[rows[:, 0].astype(int)]
    in_cam = Rotation.from_rotvec(of_row[:, :3]).apply(points[rows[:, 1].astype(int)]) + of_row[:, 3:6]
    p = -in_cam[:, :2] / in_cam[:, 2:]
    r2 = np.sum(p**2, axis=1)
    f, k1, k2 = of_row[:, 6:].T
    return (f * (1 + k1 * r2 + k2 * r2**2))[:, None] * p - rows[:, 2:]


def jaxba_residuals(problem: Problem) -> np.ndarray:
    """Pixel minus measurement in jaxba's frame (z forward, y down), in numpy and scipy alone."""
    observations, image = problem.observations, np.asarray(problem.observations.image_index)
    rotation = Rotation.from_quat(np.asarray(problem.poses.quaternion)[image], scalar_first=True)
    point = np.asarray(problem.points)[np.asarray(observations.point_index)]
    in_cam = rotation.apply(point) + np.asarray(problem.poses.translation)[image]
    p = in_cam[:, :2] / in_cam[:, 2:]
    r2 = np.sum(p**2, axis=1)
    camera = np.asarray(problem.camera_index)[image]
    f, k1, k2 = (np.asarray(getattr(problem.cameras, name))[camera] for name in ("f", "k1", "k2"))
    return (f * (1 + k1 * r2 + k2 * r2**2))[:, None] * p - observations.xy_px


def toy(folder: Path, text: str = TOY) -> Path:
    path = folder / "toy.txt"
    path.write_text(text)
    return path


def test_residuals_are_those_of_the_published_formula_with_y_turned_over(tmp_path: Path):
    path = toy(tmp_path)
    problem = read_bal(path)
    expected = bal_residuals(path) * [1, -1]
    # 1e-12: residuals of some 100 px, rounding of a dozen operations
    np.testing.assert_allclose(jaxba_residuals(problem), expected, atol=1e-12)
    in_cam = problem.poses.transform(jnp.asarray(problem.points)[jnp.array([0, 0])])
    np.testing.assert_allclose(problem.cameras.project(in_cam) - problem.observations.xy_px, expected, atol=1e-12)
    assert np.all(np.asarray(in_cam)[:, 2] > 0)  # in front of the camera
    assert problem.camera_index.tolist() == [0, 1]
    assert problem.observations.std_px.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("name", "sizes", "cost"),
    [
        ("problem-21-11315-pre.txt", (21, 11315, 36455), 4.413239e6),
        ("problem-49-7776-pre.txt", (49, 7776, 31843), 8.509125e5),
    ],
)
def test_initial_cost_of_real_problem_is_the_published_one(
    data_dir: Path, name: str, sizes: tuple[int, int, int], cost: float
):
    problem = read_bal(data_dir / "bal" / name)
    assert (problem.num_images, problem.num_points, problem.num_observations) == sizes
    assert np.sum(jaxba_residuals(problem) ** 2) / 2 == pytest.approx(cost, rel=2e-7)  # published to 7 digits


@pytest.mark.parametrize("name", ["dubrovnik-1-1-pre.txt", "dubrovnik-3-7-18-pre.txt", "dubrovnik-3-7-pre.txt"])
def test_real_toy_problem_has_its_own_residuals_and_survives_writing(data_dir: Path, tmp_path: Path, name: str):
    path = data_dir / "bal" / name
    expected = bal_residuals(path)
    problem = read_bal(path)
    # 1e-9: residuals of some 1000 px, rounding of dozens of operations
    np.testing.assert_allclose(jaxba_residuals(problem), expected * [1, -1], atol=1e-9)
    write_bal(tmp_path / "again.txt", problem)
    np.testing.assert_allclose(bal_residuals(tmp_path / "again.txt"), expected, atol=1e-9)


@pytest.mark.parametrize("name", ["again.txt", "again.txt.bz2"])
def test_written_problem_reads_back_to_rounding_at_any_angle(tmp_path: Path, name: str):
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(8, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.array([0, 1e-300, 1e-9, 0.5, 2, np.pi - 1e-9, np.pi, 5])
    cameras = np.concatenate([axes * angles[:, None], rng.normal(size=(8, 6))], axis=1)
    rows = [f"{i} {i % 3} {x!r} {y!r}" for i, (x, y) in enumerate(rng.normal(size=(8, 2)).tolist())]
    numbers = [repr(v) for v in [*cameras.ravel().tolist(), *rng.normal(size=9).tolist()]]
    first = read_bal(toy(tmp_path, "\n".join(["8 3 8", *rows, *numbers])))
    write_bal(tmp_path / name, first)
    second = read_bal(tmp_path / name)
    rotations = [Rotation.from_quat(np.asarray(p.poses.quaternion), scalar_first=True) for p in (first, second)]
    assert np.max((rotations[0] * rotations[1].inv()).magnitude()) < 2e-15  # a few roundings of one
    expected = eqx.tree_at(lambda p: p.poses.quaternion, first, second.poses.quaternion)
    assert eqx.tree_equal(second, expected)  # all else exactly


def test_bz2_is_known_by_content_and_format_by_read_problem(tmp_path: Path):
    plain = read_bal(toy(tmp_path))
    (tmp_path / "toy.dat").write_bytes(bz2.compress(TOY.encode()))
    assert eqx.tree_equal(read_bal(tmp_path / "toy.dat"), plain)
    assert eqx.tree_equal(read_problem(tmp_path / "toy.dat"), plain)
    assert eqx.tree_equal(read_problem(tmp_path / "toy.txt"), plain)


def change(**fields: object):
    return lambda p: eqx.tree_at(lambda q: tuple(getattr(q, n) for n in fields), p, tuple(fields.values()))


PRIOR = LeverArmPrior(xyz=np.zeros((1, 3)), std_m=np.ones((1, 3)), loss=Cauchy())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (change(cameras=Pinhole(*np.ones((4, 2)))), "Pinhole cameras"),
        (change(camera_index=np.zeros(2, np.int32)), "cameras other than one an image"),
        (lambda p: eqx.tree_at(lambda q: q.observations.std_px, p, np.array([1, 2.0])), r"sigmas of observations"),
        (change(priors=(PRIOR,)), r"priors \(lever_arm\)"),
        (lambda p: p.fix(poses=[0]), "fixed poses, points or intrinsics"),
        (lambda p: p.bound(k1=(-1.0, 1.0)), "bounds"),
        (change(lever_arm=np.ones(3)), "a lever arm"),
        (change(position_offset=np.ones((1, 3))), "an offset of positions"),
        (
            lambda p: Problem(**{n: v for n, v in vars(p).items() if n != "image_names"}, image_names=("a", "b")),
            "names",
        ),
    ],
)
def test_writer_refuses_what_bal_cannot_hold(tmp_path: Path, changed, message: str):
    problem = changed(read_bal(toy(tmp_path)))
    with pytest.raises(JaxbaError, match=rf"new\.txt: BAL cannot hold .*{message}.*Write a tile\.npz instead"):
        write_bal(tmp_path / "new.txt", problem)
    assert not (tmp_path / "new.txt").exists()


def test_writer_refuses_numbers_that_are_not_finite(tmp_path: Path):
    problem = change(points=np.array([[0, np.nan, 0]]))(read_bal(toy(tmp_path)))
    with pytest.raises(JaxbaError, match=r"not written, point 0 holds NaN or infinity \(1 such points\)"):
        write_bal(tmp_path / "new.txt", problem)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TOY.replace("2 1 2\n", "2 1 3\n", 1), r"ends in camera 1 of 2 .*3 observations.*or correct the header"),
        (
            TOY.replace("1 2 -30", "1 2"),
            r"ends in point 0 of 1 \(its header counts 2 cameras.*copy or download it again",
        ),
        (TOY[:60], r"ends in camera 0 of 2"),
        (TOY[:24], "ends in observation 1 of 2"),
        (TOY + "7 8\n", "line 14: 2 numbers too many"),
        (TOY.replace("1 0     1e1", "2 0     1e1"), "line 4: observation 1 is of camera 2, .*from 0 to 1"),
        (TOY.replace("0 0     3.5", "0 -1     3.5"), "line 3: observation 0 is of point -1, .*from 0 to 0"),
        (TOY.replace("1 0     1e1", "0.5 0     1e1"), "line 4: observation 1 is of camera 0.5"),
        (TOY.replace("800", "8OO"), "line 8: '8OO' is not a finite number"),
        (TOY.replace("800", "nan"), "line 8: 'nan' is not a finite number"),
        (TOY.replace("2 1 2\n", "2 0 2\n", 1), "its header counts 0 points"),
        (TOY.replace("2 1 2\n", "2 1.5 2\n", 1), "its header counts 1.5 points"),
        ("# a text\n", "line 1: '#' is not a finite number; give a BAL problem or a tile.npz"),
        ("1 2", "BAL begins with the counts"),
        (" \n", "BAL begins with the counts"),
        ("", r"toy\.txt: is empty"),
    ],
)
def test_broken_text_is_named_with_its_place_and_cure(tmp_path: Path, text: str, message: str):
    with pytest.raises(JaxbaError, match=message):
        read_bal(toy(tmp_path, text))


@pytest.mark.parametrize("damage", [lambda d: d[:-20], lambda d: d[:30] + b"\0\0\0\0" + d[34:], lambda d: d[:6]])
def test_damaged_bz2_is_named(tmp_path: Path, damage):
    (tmp_path / "toy.bz2").write_bytes(damage(bz2.compress(TOY.encode())))
    with pytest.raises(JaxbaError, match=r"toy\.bz2: damaged or truncated bz2 .*copy or download it again"):
        read_bal(tmp_path / "toy.bz2")


def test_missing_file_and_folder_are_named(tmp_path: Path):
    for read in (read_bal, read_problem):
        with pytest.raises(JaxbaError, match=r"none\.txt: no such file"):
            read(tmp_path / "none.txt")
        with pytest.raises(JaxbaError, match="is a folder; give a file in it"):
            read(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_and_blank_lines_are_passed_over(tmp_path: Path, encoding: str):
    (tmp_path / "marked.txt").write_bytes(f"\n{TOY}\n\n".replace("\n", "\r\n\n").encode(encoding))
    assert eqx.tree_equal(read_bal(tmp_path / "marked.txt"), read_bal(toy(tmp_path)))


def test_a_rotation_without_meaning_is_refused_by_line(tmp_path: Path):
    with pytest.raises(JaxbaError, match=r"line 6: camera 0 is turned by 1e\+308 radians"):
        read_bal(toy(tmp_path, TOY.replace("0.1 0.2 0.3", "0.1 1e308 0.3")))
