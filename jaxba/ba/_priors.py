"""Rows of priors: made robust, masked by what is free, multiplied and summed."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._robust import reweighting
from jaxba.ba._rows import Block, Rows, Step, Unknowns, rows_of, segments, sum_components
from jaxba.ba._system import System


def robust_rows(system: System, prior: AbstractPrior, unknowns: Unknowns, bend: Float[Array, ""]) -> Rows:
    """Return a prior's rows, made robust by its loss, columns of what is fixed zero."""
    rows, free = prior.rows(unknowns), system.free
    residual, reweighted = reweighting(list(rows.residual), prior.loss, bend)

    def robust(jacobian: Array) -> Array:
        return jnp.stack(reweighted(list(jacobian)))

    def block(block: Block | None, mask: Array | np.ndarray) -> Block | None:
        if block is None:
            return None
        return Block(block.index, robust(block.jacobian) * rows_of(mask, block.index).T[None])

    lever_arm = None if rows.lever_arm is None else robust(rows.lever_arm) * free.lever_arm[:, None]
    return Rows(
        jnp.stack(residual),
        block(rows.pose, free.poses),
        block(rows.intrinsics, free.intrinsics),
        lever_arm,
        block(rows.point, free.points),
    )


def product(rows: Rows, step: Step) -> Float[Array, "components rows"]:
    """Return `J d`."""
    total = jnp.zeros_like(rows.residual)
    for block, of_kind in ((rows.pose, step.poses), (rows.intrinsics, step.intrinsics), (rows.point, step.points)):
        if block is not None:
            total += jnp.einsum("ckn,nk->cn", block.jacobian, rows_of(of_kind, block.index))
    if rows.lever_arm is not None:
        total += jnp.einsum("ckn,k->cn", rows.lever_arm, step.lever_arm)
    return total


def transpose_product(rows: Rows, values: Float[Array, "components rows"], zero: Step) -> Step:
    """Return `J^T v`; `zero` gives the shapes."""

    def of_kind(block: Block | None, zero: Array | np.ndarray) -> Array:
        return jnp.asarray(zero) if block is None else block_transpose(block, values, zero.shape[0])

    lever_arm = zero.lever_arm
    if rows.lever_arm is not None:
        lever_arm = jnp.einsum("ckn,cn->k", rows.lever_arm, values)
    return Step(
        of_kind(rows.pose, zero.poses),
        of_kind(rows.intrinsics, zero.intrinsics),
        lever_arm,
        of_kind(rows.point, zero.points),
    )


def block_transpose(block: Block, values: Float[Array, "components rows"], count: int) -> Float[Array, "m columns"]:
    """Return `J^T v` of one block, summed by what its rows touch."""
    return segments(sum_components(block.jacobian * values[:, None]).T, block.index, count)


def block_products(block: Block, count: int) -> Float[Array, "m columns columns"]:
    """Return `J^T J` of one block, summed by what its rows touch."""
    return segments(jnp.einsum("cin,cjn->nij", block.jacobian, block.jacobian), block.index, count)
