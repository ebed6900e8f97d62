"""Problems of Bundle Adjustment in the Large (Agarwal et al., ECCV 2010), as text, plain or bz2.

    cameras points observations                     three counts
    camera point x y                                for each observation
    angle-axis (3) translation (3) f k1 k2          for each camera
    x y z                                           for each point

BAL's camera looks along -z with y up, its pixels have their origin at the image's centre:

    P = R X + t        p = -P / P.z        xy = f (1 + k1 |p|^2 + k2 |p|^4) p

With `D = diag(1, -1, -1)`, half a turn about x, the camera `D R`, `D t` looks along +z with y down and sees the same
image with y turned over: rotation and translation are multiplied by D on the left and y of the observations is negated.
All numbers are float64, whatever jax is set to.
"""

import bz2
import itertools
import os

import numpy as np

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError
from jaxba.ba import Observations, Problem
from jaxba.geometry import BAL, Pose
from jaxba.io._read import read_bytes, text_of

_BZ2_MAGIC = b"BZh"
_D = np.array([1.0, -1.0, -1.0])
_LONGEST_ROTATION = 1e15  # radians: beyond it neighbours in float64 are a radian apart
_AGAIN = "copy or download it again"


def read_bal(path: str | os.PathLike[str]) -> Problem:
    """Return the problem in a BAL file, text or bz2 by its content: every image its own camera, sigmas of 1 px.

    Raises:
        JaxbaError: the file is missing, empty or damaged, holds something that is no number, fewer or more numbers than
            its counts say, or an index that is out of range.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "problem.txt")
    >>> _ = path.write_text("1 1 1  0 0 3 -4  0 0 0  0 0 0  100 0 0  0 0 -10")
    >>> read_bal(path).observations.xy_px.tolist()  # y points down
    [[3.0, 4.0]]
    """
    return bal_of_bytes(read_bytes(path), os.fspath(path))


def bal_of_bytes(data: bytes, label: str) -> Problem:
    """Return the problem in the bytes of a BAL file; `label` names the file in messages. Raises as `read_bal` does."""
    if data.startswith(_BZ2_MAGIC):
        try:
            data = bz2.decompress(data)
        except (OSError, ValueError, EOFError) as error:
            raise JaxbaError(f"{label}: damaged or truncated bz2 ({error}); {_AGAIN}.") from error
    data = text_of(data, "replace").encode()  # without a byte order mark
    values = _numbers(data, label)
    num_images, num_points, num_observations = _counts(values, data, label)
    end_observations = 3 + 4 * num_observations
    end_cameras = end_observations + 9 * num_images
    rows = values[3:end_observations].reshape(-1, 4)
    cameras = values[end_observations:end_cameras].reshape(-1, 9)
    far = np.flatnonzero(np.abs(cameras[:, :3]).max(axis=1) > _LONGEST_ROTATION)
    if far.size:
        line = _line(data, end_observations + 9 * int(far[0]))
        raise JaxbaError(
            f"{label}, line {line}: camera {far[0]} is turned by {np.abs(cameras[far[0], :3]).max():g} radians, which "
            "have no digits left to say where it looks; correct the line."
        )
    image_index = _indices(rows, 0, num_images, "camera", data, label)
    point_index = _indices(rows, 1, num_points, "point", data, label)
    return Problem.build(
        Pose(_jaxba_quaternion(cameras[:, :3]), cameras[:, 3:6] * _D),
        BAL(*cameras[:, 6:].T),
        values[end_cameras:].reshape(-1, 3).copy(),
        Observations(rows[:, 2:] * [1.0, -1.0], np.ones(num_observations), image_index, point_index),
        camera_index=np.arange(num_images, dtype=np.int32),
    )


def write_bal(path: str | os.PathLike[str], problem: Problem) -> None:
    """Write a problem as BAL text, compressed where the name ends in `.bz2`; `read_bal` returns it to rounding.

    Numbers are the shortest decimals that read back as the same float64 (at most 17 digits). Nothing is dropped: what
    BAL cannot hold is refused.

    Raises:
        JaxbaError: another camera model than BAL's, cameras shared by images, sigmas, priors, fixed blocks, bounds, a
            lever arm, image names, numbers that are not finite; or the file cannot be written.

    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> _ = (folder / "a.txt").write_text("1 1 1  0 0 3 -4  0 0 0  0 0 0  100 0 0  0 0 -10")
    >>> write_bal(folder / "b.txt.bz2", read_bal(folder / "a.txt"))
    """
    label = os.fspath(path)
    lost = what_bal_cannot_hold(problem)
    if lost:
        raise JaxbaError(f"{label}: BAL cannot hold {'; '.join(lost)}. Write a tile.npz instead (jaxba.write_tile).")
    observations, cameras = problem.observations, problem.cameras
    translation = np.asarray(problem.poses.translation, float) * _D
    rotation = _bal_angle_axis(np.asarray(problem.poses.quaternion, float))
    intrinsics = np.stack([np.asarray(getattr(cameras, name), float) for name in BAL.parameter_names()], axis=1)
    images = np.concatenate([rotation, translation, intrinsics], axis=1) + 0.0  # no "-0.0" in the file
    points = np.asarray(problem.points, float) + 0.0
    xy = np.asarray(observations.xy_px, float) * [1.0, -1.0] + 0.0
    for what, array in (("image", images), ("point", points), ("observation", xy)):
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        if bad.size:
            raise JaxbaError(f"{label}: not written, {what} {bad[0]} holds NaN or infinity ({bad.size} such {what}s).")
    indices = (np.asarray(index).tolist() for index in (observations.image_index, observations.point_index))
    lines = itertools.chain(
        (f"{problem.num_images} {problem.num_points} {problem.num_observations}\n",),
        (f"{i} {j}     {x!r} {y!r}\n" for i, j, (x, y) in zip(*indices, xy.tolist(), strict=True)),
        (f"{value!r}\n" for value in images.ravel().tolist()),
        (f"{value!r}\n" for value in points.ravel().tolist()),
    )
    text = "".join(lines).encode()
    with write_atomically(path) as file:
        file.write(bz2.compress(text) if label.endswith(".bz2") else text)


def _numbers(data: bytes, label: str) -> np.ndarray:
    """Return all numbers of the text; 150k take 16 ms, as much as `numpy.fromstring`, and a bad one can be named."""
    tokens = data.split()
    try:
        values = np.array(tokens, dtype=float)
    except ValueError:
        values = np.array([_float_or_nan(token) for token in tokens])
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        token = repr(tokens[bad[0]][:40])[1:]
        raise JaxbaError(
            f"{label}, line {_line(data, int(bad[0]))}: {token} is not a finite number; "
            "give a BAL problem or a tile.npz, or correct the line."
        )
    return values


def _float_or_nan(token: bytes) -> float:
    try:
        return float(token)
    except ValueError:
        return np.nan


def _counts(values: np.ndarray, data: bytes, label: str) -> tuple[int, int, int]:
    """Return the counts of images, points and observations, with as many numbers behind them as they say."""
    names = ("cameras", "points", "observations")
    if values.size < 3:
        raise JaxbaError(f"{label}: BAL begins with the counts of cameras, points and observations; {_AGAIN}.")
    for name, count in zip(names, values[:3], strict=True):
        if count < 1 or count % 1:
            raise JaxbaError(f"{label}: its header counts {count:g} {name}; correct it to a whole number above 0.")
    num_images, num_points, num_observations = (int(count) for count in values[:3])
    promise = f"its header counts {num_images} cameras, {num_points} points, {num_observations} observations"
    sections = (("observation", num_observations, 4), ("camera", num_images, 9), ("point", num_points, 3))
    left = values.size - 3
    for name, count, width in sections:
        if left < count * width:
            raise JaxbaError(
                f"{label}: ends in {name} {left // width} of {count} ({promise}). "
                f"It is truncated, or a count is wrong: {_AGAIN}, or correct the header."
            )
        left -= count * width
    if left:
        line = _line(data, values.size - left)
        raise JaxbaError(f"{label}, line {line}: {left} numbers too many ({promise}); correct the header or the file.")
    return num_images, num_points, num_observations


def _indices(rows: np.ndarray, column: int, count: int, what: str, data: bytes, label: str) -> np.ndarray:
    """Return one column of indices, checked."""
    indices = rows[:, column]
    bad = np.flatnonzero((indices < 0) | (indices >= count) | (indices % 1 != 0))
    if bad.size:
        row = int(bad[0])
        raise JaxbaError(
            f"{label}, line {_line(data, 3 + 4 * row + column)}: observation {row} is of {what} {indices[row]:g}, "
            f"but the {what}s go from 0 to {count - 1}; correct the index or the header ({bad.size} such observations)."
        )
    return indices.astype(np.int32)


def _line(data: bytes, token: int) -> int:
    """Return the line, counted from 1, of a number of the text, counted from 0."""
    for number, line in enumerate(data.split(b"\n"), start=1):
        token -= len(line.split())
        if token < 0:
            return number
    raise AssertionError("the text has fewer numbers")


def _jaxba_quaternion(angle_axis: np.ndarray) -> np.ndarray:
    """Return the quaternion of `D R(angle_axis)`."""
    half = np.linalg.norm(angle_axis, axis=1, keepdims=True) / 2
    x, y, z = (0.5 * np.sinc(half / np.pi) * angle_axis).T
    w = np.cos(half[:, 0])
    return np.stack([-x, w, -z, y], axis=1)  # (0, 1, 0, 0) times (w, x, y, z)


def _bal_angle_axis(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation vector of `D R(quaternion)`, its angle in [0, pi]."""
    a, b, c, d = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    w, vector = b, np.stack([-a, d, -c], axis=1)  # (0, -1, 0, 0) times (a, b, c, d), up to the sign
    vector = np.where(w[:, None] < 0, -vector, vector)
    norm = np.linalg.norm(vector, axis=1)
    nonzero = np.where(norm > 0, norm, 1.0)
    return np.where(norm > 0, 2 * np.arctan2(norm, np.abs(w)) / nonzero, 2.0)[:, None] * vector


def what_bal_cannot_hold(problem: Problem) -> list[str]:
    """Name every part of the problem that would be lost."""
    lost = []
    if not isinstance(problem.cameras, BAL):
        lost.append(f"{type(problem.cameras).__name__} cameras, only BAL's f, k1, k2")
    if not np.array_equal(np.asarray(problem.camera_index), np.arange(problem.num_cameras)):
        lost.append("cameras other than one an image, in the images' order")
    if np.any(np.asarray(problem.observations.std_px) != 1):
        lost.append("sigmas of observations (std_px) other than 1")
    if problem.priors:
        lost.append(f"priors ({', '.join(prior.name for prior in problem.priors)})")
    free = problem.free
    if not all(np.all(block) for block in (free.poses, free.points, free.intrinsics)):
        lost.append("fixed poses, points or intrinsics")
    if np.any(np.isfinite(problem.lower)) or np.any(np.isfinite(problem.upper)):
        lost.append("bounds")
    if np.any(problem.lever_arm) or np.any(free.lever_arm):
        lost.append("a lever arm")
    offsets = len(problem.position_offset) - problem.num_bar_ends
    if offsets and (np.any(problem.position_offset[:offsets]) or np.any(free.position_offset)):
        lost.append("an offset of positions")
    if problem.image_names:
        lost.append("image names")
    return lost
