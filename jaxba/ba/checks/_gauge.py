"""Gauge: which directions of the whole block nothing in a problem fixes.

Images see the same pixels when poses and points move, turn and grow together: seven directions (Triggs et al. 2000,
section 9). A fixed pose or point, or a prior, holds some of them. With D the 7 tangent directions of the similarity,
about the block's middle and in units of its size, and J the rows of all priors and of everything fixed,

    free directions = null space of (J D)^T (J D)

A free lever arm adds three columns, as does a free offset of positions: in a block without turns they move as a
translation of the block does. Parts of a block that share no free pose or point are looked at one by one. Robust losses
do not count: they weaken rows, and a row that has levelled off at the start values may come back.

Cost: numpy, and the priors' own derivatives in jitted pieces of `_CHUNK` rows, which compile once whatever the problem
(0.3 s a prior). 2000 images with 500k observations take 0.1 s after that.
"""

import dataclasses

import jax
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy import sparse

from jaxba._errors import JaxbaError
from jaxba.ba._compiler import fast_jit
from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._rows import Rows
from jaxba.ba._unknowns import Unknowns, antenna_names
from jaxba.ba.checks._connected_parts import Parts, hat, mean_by
from jaxba.ba.checks._validate import validate
from jaxba.geometry import Pose

_CHUNK = 256
_NULL = 1e-12  # eigenvalue over the largest: a direction held a million times more weakly than another counts as free
_REMOTE = 10.0  # sizes of the part: fixed points beyond count as if they were there
_NEGLIGIBLE = 0.1  # of a direction's largest component: smaller ones are not named

_NAMES = *(f"translation {a}" for a in "xyz"), *(f"rotation about {a}" for a in "xyz"), "scale"
_TURNING = 3, 4, 5, 6
_ABOUT = "image_index", "point_index", "camera_index"  # what a row of a prior is about


def free_gauge(problem: Problem) -> tuple[str, ...]:
    """Return the names of the directions that nothing fixes; empty if the problem is fully determined.

    `translation x`, `rotation about z`, `scale`, ...: one name a free direction, in the world's axes. A rotation about
    a line that is no axis is named by the axes it is made of, `rotation about x + rotation about y`; the centre of a
    rotation or of the scaling is not told. `lever arm z` appears where a free lever arm is not determined, and
    `position offset z` likewise.

    Raises `JaxbaError` where the problem contradicts itself or holds impossible values.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8, gnss_std_m=None)
    >>> len(jaxba.ba.free_gauge(survey.problem)), jaxba.ba.free_gauge(survey.problem.fix(poses=[0]))
    (7, ('scale',))
    """
    validate(problem)
    parts = Parts.of(problem)
    normal, of_antenna = _normal_matrices(problem, parts)
    columns = np.arange(7)
    antenna = 7 + np.flatnonzero(_free_antenna(problem))
    if len(antenna) and not _antenna_determined(normal, of_antenna, antenna):
        normal[:, 7:, 7:] += of_antenna
        columns = np.concatenate([columns, antenna])
    vectors, free = _null(normal[:, columns[:, None], columns])
    all_names = [*_NAMES, *antenna_names(len(problem.position_offset))]
    parts_free = np.flatnonzero(free.any(axis=1))
    names = {name for part in parts_free for name in _names(vectors[part][:, free[part]].T, columns, all_names)}
    return tuple(sorted(names, key=lambda name: [all_names.index(n) for n in name.split(" + ")]))


def require_gauge(problem: Problem, purpose: str) -> None:
    """Raise `JaxbaError`, with the cure, if `purpose` (e.g. "Covariance") needs a gauge that the problem lacks."""
    free = free_gauge(problem)
    if not free:
        return
    count = "1 direction is" if len(free) == 1 else f"{len(free)} directions are"
    cures = ["Add a position prior with finite std_m or three control points, or fix two poses."]
    if all(name.startswith("rotation") for name in free):
        cures = ["Positions along one line leave the turn about it: add a control point off it or an attitude prior."]
    for unknown in ("lever arm", "position offset"):
        if any(unknown in name for name in free):
            cures = [f"Hold the {unknown} fixed or add a {unknown} prior with finite std_m.", *cures]
            cures = cures[: 1 if all(unknown in name for name in free) else 2]
    if purpose in ("Covariance", "Statistics"):
        cures.append('Or take those of the photos alone: datum="inner".')
    raise JaxbaError(f"{purpose}: problem has no gauge, {count} free ({', '.join(free)}). {' '.join(cures)}")


def free_directions(
    label: str, problem: Problem
) -> tuple[Float[np.ndarray, "images 6 7"], Float[np.ndarray, "points 3 7"], float]:
    """Return how the seven directions move poses (tangent steps) and points of a block, and its rms extent, metres.

    What is fixed does not move. `label`: of what needs them, for messages.

    Raises `JaxbaError` where parts of the block share no points.
    """
    parts = Parts.of(problem)
    if len(parts.size) != 1:
        raise JaxbaError(f"{label}: the block is in {len(parts.size)} parts that share no points; take each by itself.")
    poses = parts.move_poses(np.maximum(parts.of_image, 0), problem.poses)
    points = parts.move_points(np.maximum(parts.of_point, 0), np.asarray(problem.points, float))
    of_images, of_points = (
        np.asarray(mask, float)[:, None, None] for mask in (problem.free.poses, problem.free.points)
    )
    return poses * of_images, points * of_points, float(parts.size[0])


def _normal_matrices(
    problem: Problem, parts: Parts
) -> tuple[Float[np.ndarray, "parts n n"], Float[np.ndarray, "antenna antenna"]]:
    """Return (J D)^T (J D) of each part, the antenna in the last columns, and that of the antenna's own priors.

    Every group of rows is divided by its trace, so that its sigmas' unit does not matter.
    """
    free_antenna = _free_antenna(problem)
    size = 7 + len(free_antenna)
    normal = np.zeros((len(parts.size), size, size))
    of_antenna = np.zeros((len(free_antenna),) * 2)
    normal[:, :7, :7] += _fixed_point_grams(problem, parts)
    part, index = parts.fixed_poses
    moved = parts.move_poses(part, _poses(problem, index))
    moved[:, 3:] /= parts.size[part][:, None, None]
    normal += _grams(moved, part, len(parts.size), size)
    for prior in problem.priors:
        if not free_antenna.any() and not _null(normal[:, :7, :7])[1].any():
            break  # all is held already: the other priors need not be compiled
        rows = prior_rows(prior, problem)
        if rows is None:
            continue
        if rows.pose is None and rows.point is None:
            if rows.antenna is not None:
                along = np.moveaxis(np.asarray(rows.antenna), 2, 0).reshape(-1, len(free_antenna))
                of_antenna += along.T @ along / max(np.sum(along**2), np.finfo(float).tiny)
            continue
        image, point = getattr(prior, "image_index", None), getattr(prior, "point_index", None)
        part = parts.of_image[np.asarray(image)] if rows.pose is not None else parts.of_point[np.asarray(point)]
        inside = part >= 0
        if prior.name == "scale_bar":  # between parts that share no points it holds neither
            inside &= part == part.reshape(-1, 2)[:, ::-1].reshape(-1)
        part = part[inside]
        along = np.zeros((len(part), rows.residual.shape[0], size))
        if rows.pose is not None:
            jacobian = np.moveaxis(np.asarray(rows.pose.jacobian), 2, 0)[inside]
            along[:, :, :7] += jacobian @ parts.move_poses(part, _poses(problem, np.asarray(image)[inside]))
        if rows.point is not None:
            jacobian = np.moveaxis(np.asarray(rows.point.jacobian), 2, 0)[inside]
            along[:, :, :7] += jacobian @ parts.move_points(part, np.asarray(problem.points)[np.asarray(point)[inside]])
        if rows.antenna is not None:
            by_antenna = np.moveaxis(np.asarray(rows.antenna), 2, 0)[inside]
            along[:, :, 7:] = by_antenna * parts.size[part][:, None, None] * free_antenna
            along[:, :, :7] += _along_ends(problem, parts, part, by_antenna)
        normal += _grams(along, part, len(parts.size), size)
    return normal, of_antenna


def _free_antenna(problem: Problem) -> Bool[np.ndarray, " antenna"]:
    """Return what is free of the antenna but for the ends of scale bars, which move with their points."""
    free = np.array(problem.free_antenna)
    free[len(free) - 3 * problem.num_bar_ends :] = False
    return free


def _along_ends(
    problem: Problem,
    parts: Parts,
    part: Int[np.ndarray, " rows"],
    by_antenna: Float[np.ndarray, "rows components antenna"],
) -> Float[np.ndarray, "rows components 7"]:
    """Return the derivatives by the seven directions that rows have through the ends of scale bars."""
    ends = problem.num_bar_ends
    if not ends:
        return np.zeros((*by_antenna.shape[:2], 7))
    rows, columns = len(part), by_antenna.shape[2] - 3 * ends
    bars = vars(problem.prior("scale_bar"))
    xyz = np.asarray(bars["xyz"], float) + np.asarray(problem.position_offset, float)[-ends:]
    moved = parts.move_points(np.repeat(part, ends), np.tile(xyz, (rows, 1))).reshape(rows, 3 * ends, 7)
    return by_antenna[:, :, columns:] @ moved


def _fixed_point_grams(problem: Problem, parts: Parts) -> Float[np.ndarray, "parts 7 7"]:
    """Return A^T A over the fixed points that each part sees, `A = [I, -hat(x), x]`, from the means of x and x x^T.

    Points held fixed may be half a million, where A itself would take a second.
    """
    part, index = parts.fixed_points
    x = (np.asarray(problem.points, float)[index] - parts.center[part]) / parts.size[part][:, None]
    x /= np.maximum(1.0, np.linalg.norm(x, axis=1, keepdims=True) / _REMOTE)
    count = len(parts.size)
    number = np.bincount(part, minlength=count)
    mean = mean_by(x, part, count)
    second = mean_by((x[:, :, None] * x[:, None]).reshape(-1, 9), part, count).reshape(-1, 3, 3)
    squared, eye = np.trace(second, axis1=1, axis2=2)[:, None, None], np.eye(3)
    gram = np.zeros((count, 7, 7))
    gram[:, :3, :3], gram[:, 3:6, 3:6], gram[:, 6:, 6:] = eye, squared * eye - second, squared
    gram[:, :3, 3:6], gram[:, 3:6, :3] = -hat(mean), hat(mean)
    gram[:, :3, 6], gram[:, 6, :3] = mean, mean
    return gram / (3 + 3 * squared) * (number > 0)[:, None, None]


def _null(normal: Float[np.ndarray, "parts n n"]) -> tuple[Float[np.ndarray, "parts n n"], Bool[np.ndarray, "parts n"]]:
    """Return eigenvectors, and which of them are null directions."""
    values, vectors = np.linalg.eigh(normal)
    return vectors, values <= _NULL * values[:, -1:]


def _antenna_determined(
    normal: Float[np.ndarray, "parts n n"],
    of_antenna: Float[np.ndarray, "antenna antenna"],
    free: Int[np.ndarray, " m"],
) -> bool:
    """Whether what is free of the antenna, which all parts share, is fixed when every part moves: its Schur complement.

    - `free`: its columns.
    """
    block, cross, own = normal[:, :7, :7], normal[:, :7, free], normal[:, free[:, None], free]
    inverse = np.linalg.pinv(block, rcond=_NULL, hermitian=True)
    schur = of_antenna[free[:, None] - 7, free - 7]
    schur = schur + np.sum(own - np.swapaxes(cross, 1, 2) @ inverse @ cross, axis=0)
    return bool(np.linalg.eigvalsh(schur)[0] > _NULL)


def _names(
    null: Float[np.ndarray, "free columns"], of_columns: Int[np.ndarray, " columns"], all_names: list[str]
) -> list[str]:
    """Name a null space: a basis by elimination, rotations and scale first, which hide the translations they bring.

    - `of_columns`: which of all directions each column is.
    """
    rows, done, names = null.copy(), 0, []
    for are_turning in (True, False):
        columns = [c for c, direction in enumerate(of_columns) if (direction in _TURNING) == are_turning]
        pivots = []
        while done < len(rows):
            block = np.abs(rows[done:, columns])
            row, column = np.unravel_index(np.argmax(block), block.shape)
            if block[row, column] < 1e-5:
                break
            rows[[done, done + row]] = rows[[done + row, done]]
            rows[done] /= rows[done, columns[column]]
            others = np.arange(len(rows)) != done
            rows[others] -= rows[others][:, columns[column], None] * rows[done]
            pivots.append(done)
            done += 1
        for pivot in pivots:
            size = np.abs(rows[pivot, columns])
            kept = [c for c, s in zip(columns, size, strict=True) if s > _NEGLIGIBLE * size.max()]
            names.append(" + ".join(all_names[of_columns[c]] for c in sorted(kept)))
    return names


def prior_rows(prior: AbstractPrior, problem: Problem) -> Rows | None:
    """Return a prior's rows by poses, points and the lever arm, numpy; evaluated on pieces of one size.

    None for a prior of cameras, or without rows.
    """
    fields = {f.name: getattr(prior, f.name) for f in dataclasses.fields(prior)}
    index_name = next((name for name in _ABOUT if name in fields), "")
    if index_name == "camera_index" or (index_name and len(fields[index_name]) == 0):
        return None
    with jax.enable_x64(True):
        if not index_name:
            rows = _of_geometry(prior, _unknowns(problem, np.zeros(1, int), np.zeros(1, int)))
            return jax.tree.map(np.asarray, rows)
        index = np.asarray(fields[index_name])
        pieces = []
        for start in range(0, max(len(index), 1), _CHUNK):
            # the piece's own unknowns, numbered 0, 1, ...; the last row fills it up
            of_piece = np.minimum(np.arange(start, start + _CHUNK), max(len(index) - 1, 0))
            local = {
                name: np.asarray(values, np.int32 if name.endswith("_index") else float)[of_piece]
                for name, values in fields.items()
                if name not in ("loss", index_name) and values is not None
            }
            piece = dataclasses.replace(prior, **local, **{index_name: np.arange(_CHUNK, dtype=np.int32)})
            use = {"image_index": np.zeros(1, int), "point_index": np.zeros(1, int), index_name: index[of_piece]}
            rows = _of_geometry(piece, _unknowns(problem, use["image_index"], use["point_index"]))
            pieces.append(rows)
        return jax.tree.map(lambda *a: np.concatenate(a, axis=-1)[..., : len(index)], *pieces)


@fast_jit
def _of_geometry(prior: AbstractPrior, unknowns: Unknowns) -> Rows:
    rows = prior.rows(unknowns)
    return Rows(residual=rows.residual, pose=rows.pose, antenna=rows.antenna, point=rows.point)


def _unknowns(problem: Problem, images: Int[np.ndarray, " n"], points: Int[np.ndarray, " m"]) -> Unknowns:
    def array(values: Array | np.ndarray) -> Array:
        return jax.numpy.asarray(np.asarray(values, float))

    return Unknowns(
        poses=jax.tree.map(array, _poses(problem, images)),
        intrinsics=jax.numpy.zeros((1, len(type(problem.cameras).parameter_names()))),
        antenna=array(problem.antenna),
        points=array(np.asarray(problem.points)[points]),
    )


def _poses(problem: Problem, images: Int[np.ndarray, " n"]) -> Pose:
    poses = problem.poses
    return Pose(np.asarray(poses.quaternion, float)[images], np.asarray(poses.translation, float)[images])


def _grams(
    along: Float[np.ndarray, "n rows columns"], part: Int[np.ndarray, " n"], count: int, size: int
) -> Float[np.ndarray, "parts size size"]:
    """Return the sum of `A^T A` over each part's entries, with a trace of one (or zero), in the first columns."""
    columns = along.shape[2]
    products = (np.swapaxes(along, 1, 2) @ along).reshape(len(part), columns**2)
    adder = sparse.csr_array((np.ones(len(part)), (part, np.arange(len(part)))), shape=(count, len(part)))
    summed = (adder @ products).reshape(count, columns, columns)
    trace = np.trace(summed, axis1=1, axis2=2)
    out = np.zeros((count, size, size))
    out[:, :columns, :columns] = summed / np.where(trace > 0, trace, 1.0)[:, None, None]
    return out
