"""Rows of priors: made robust, masked by what is free, multiplied and summed.

What the normal equations need of all priors together is one block an image, a camera and a point, that of the
antenna (lever arm and offsets), and the antenna's with each image and each point: `PriorBlocks`. No prior couples
anything else.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._reweighting import reweighting
from jaxba.ba._rows import JacobianBlock, Rows, rows_of, segments, sum_components
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns


def robust_rows(system: System, prior: AbstractPrior, unknowns: Unknowns, bend: Float[Array, ""]) -> Rows:
    """Return a prior's rows, made robust by its loss, columns of what is fixed zero."""
    rows, free = prior.rows(unknowns), system.free
    residual, reweighted = reweighting(list(rows.residual), prior.loss, bend)

    def robust(jacobian: Array) -> Array:
        return jnp.stack(reweighted(list(jacobian)))

    def block(block: JacobianBlock | None, mask: Array | np.ndarray) -> JacobianBlock | None:
        if block is None:
            return None
        return JacobianBlock(block.index, robust(block.jacobian) * rows_of(mask, block.index).T[None])

    antenna = None if rows.antenna is None else robust(rows.antenna) * free.antenna[:, None]
    return Rows(
        jnp.stack(residual),
        block(rows.pose, free.poses),
        block(rows.intrinsics, free.intrinsics),
        antenna,
        block(rows.point, free.points),
    )


class PriorBlocks(eqx.Module):
    """Blocks of J^T J, or of second derivatives, summed over all priors; intrinsics with all their columns.

    `points_antenna` has no columns where no prior couples points to the antenna.
    """

    poses: Float[Array, "images 6 6"]
    intrinsics: Float[Array, "cameras parameters parameters"]
    antenna: Float[Array, "antenna antenna"]
    poses_antenna: Float[Array, "images 6 antenna"]
    points: Float[Array, "points 3 3"]
    points_antenna: Float[Array, "points 3 coupled"]

    @staticmethod
    def zeros(like: Step) -> "PriorBlocks":
        """Return blocks of zeros for the unknowns of a step."""

        def zeros(kind: Array | np.ndarray, columns: int) -> Array:
            return jnp.zeros((*kind.shape, columns), kind.dtype)

        return PriorBlocks(
            poses=zeros(like.poses, 6),
            intrinsics=zeros(like.intrinsics, like.intrinsics.shape[1]),
            antenna=zeros(like.antenna, like.antenna.shape[0]),
            poses_antenna=zeros(like.poses, like.antenna.shape[0]),
            points=zeros(like.points, 3),
            points_antenna=zeros(like.points, 0),
        )


def add_products(blocks: PriorBlocks, rows: Rows) -> PriorBlocks:
    """Add a prior's J^T J."""
    jacobian = jnp.concatenate(list(_by_kind(rows).values()), axis=1)
    return _add(blocks, rows, jnp.einsum("cin,cjn->nij", jacobian, jacobian))


def add_second_derivatives(
    blocks: PriorBlocks, system: System, prior: AbstractPrior, unknowns: Unknowns
) -> PriorBlocks:
    """Add the second derivatives of a prior's cost, from those of its residual by one image, camera and point a row.

    A row touches at most one of each kind, so a step that all of a kind take together tells every row's derivatives.
    """
    rows, free = prior.rows(unknowns), system.free
    places, zero = _places(rows), jax.tree.map(jnp.zeros_like, free)

    def residual(together: Array) -> Array:
        def moved(of_kind: Array | np.ndarray, kind: str) -> Array:
            return jnp.asarray(of_kind) + together[places[kind]] if kind in places else jnp.asarray(of_kind)

        step = Step(
            moved(zero.poses, "pose"),
            moved(zero.intrinsics, "intrinsics"),
            moved(zero.antenna, "antenna"),
            moved(zero.points, "point"),
        )
        return prior.residual(unknowns.retract(step))

    def first(together: Array) -> tuple[Array, tuple[Array, Array]]:
        by, value = jax.jacfwd(lambda at: (residual(at),) * 2, has_aux=True)(together)
        return by, (value, by)

    start = jnp.zeros(max(place.stop for place in places.values()), unknowns.points.dtype)
    second, (value, by) = jax.jacfwd(first, has_aux=True)(start)
    _, slope, bent = prior.loss.derivatives(sum_components(value**2))
    through = jnp.einsum("cn,cni->ni", value, by)
    hessian = jnp.einsum("n,cni,cnj->nij", slope, by, by) + jnp.einsum("n,cn,cnij->nij", slope, value, second)
    hessian += 2 * bent[:, None, None] * through[:, :, None] * through[:, None]
    masks = {"pose": free.poses, "intrinsics": free.intrinsics, "point": free.points}
    for kind, place in places.items():
        mask = free.antenna[None] if kind == "antenna" else rows_of(masks[kind], getattr(rows, kind).index)
        hessian = hessian.at[:, place].multiply(mask[:, :, None]).at[:, :, place].multiply(mask[:, None])
    return _add(blocks, rows, hessian)


def _by_kind(rows: Rows) -> dict[str, Float[Array, "components columns rows"]]:
    """Return the derivatives by each kind of unknown that the rows touch."""
    blocks = {"pose": rows.pose, "intrinsics": rows.intrinsics, "point": rows.point}
    found = {kind: block.jacobian for kind, block in blocks.items() if block is not None}
    return found if rows.antenna is None else {**found, "antenna": rows.antenna}


def _places(rows: Rows) -> dict[str, slice]:
    """Return where each kind's columns stand when all stand side by side."""
    sizes = {kind: jacobian.shape[1] for kind, jacobian in _by_kind(rows).items()}
    ends = np.cumsum(list(sizes.values()))
    return {kind: slice(int(end) - size, int(end)) for (kind, size), end in zip(sizes.items(), ends, strict=True)}


def _add(blocks: PriorBlocks, rows: Rows, matrix: Float[Array, "rows columns columns"]) -> PriorBlocks:
    """Add a matrix of each row, over the columns of `_places`, to what the row touches."""
    places = _places(rows)

    def square(total: Array, kind: str) -> Array:
        if kind not in places:
            return total
        of_kind = matrix[:, places[kind], places[kind]]
        return total + segments(of_kind, getattr(rows, kind).index, total.shape[0])

    antenna, cross, of_points = blocks.antenna, blocks.poses_antenna, blocks.points_antenna
    if "antenna" in places:
        antenna += jnp.sum(matrix[:, places["antenna"], places["antenna"]], axis=0)
        if rows.pose is not None:
            across = matrix[:, places["pose"], places["antenna"]]
            cross += segments(across, rows.pose.index, cross.shape[0])
        if rows.point is not None:
            across = matrix[:, places["point"], places["antenna"]]
            summed = segments(across, rows.point.index, of_points.shape[0])
            of_points = of_points + summed if of_points.shape[-1] else summed
    return PriorBlocks(
        square(blocks.poses, "pose"),
        square(blocks.intrinsics, "intrinsics"),
        antenna,
        cross,
        square(blocks.points, "point"),
        of_points,
    )


def transpose_product(rows: Rows, values: Float[Array, "components rows"], zero: Step) -> Step:
    """Return `J^T v`; `zero` gives the shapes."""

    def of_kind(block: JacobianBlock | None, zero: Array | np.ndarray) -> Array:
        return jnp.asarray(zero) if block is None else block_transpose(block, values, zero.shape[0])

    antenna = zero.antenna
    if rows.antenna is not None:
        antenna = jnp.einsum("ckn,cn->k", rows.antenna, values)
    return Step(
        of_kind(rows.pose, zero.poses),
        of_kind(rows.intrinsics, zero.intrinsics),
        antenna,
        of_kind(rows.point, zero.points),
    )


def block_transpose(
    block: JacobianBlock, values: Float[Array, "components rows"], count: int
) -> Float[Array, "m columns"]:
    """Return `J^T v` of one block, summed by what its rows touch."""
    return segments(sum_components(block.jacobian * values[:, None]).T, block.index, count)


def block_products(block: JacobianBlock, count: int) -> Float[Array, "m columns columns"]:
    """Return `J^T J` of one block, summed by what its rows touch."""
    return segments(jnp.einsum("cin,cjn->nij", block.jacobian, block.jacobian), block.index, count)
