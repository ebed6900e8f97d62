"""Joint covariance of functions of the unknowns: `g^T N^-1 g`, by one way up the tree.

The gradients g of the functions go up as right-hand sides do, and what the elimination of all images leaves of their
products is `-g^T N^-1 g`, but for the border: that is eliminated here.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from jaxba.ba._compiler import call_compiled
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._inverse import inverse_of_border
from jaxba.ba.tiles._programs import Handed, hand_columns
from jaxba.ba.tiles._tile_work import Up


def joint_covariance(engine: Engine, unknowns: Unknowns, gradients: Sequence[Step]) -> Float[np.ndarray, "m m"]:
    """Return the covariance of functions, to first order.

    - `engine`: opened with a column for each of them. `gradients`: by a tangent step of the unknowns, in the problem's
      order, zero for what is fixed, one for each function.

    Raises `NotPositive` where the equations have no inverse.
    """
    nothing, border, count = np.zeros(()), engine.shape.border, len(gradients)

    def up(number: int) -> Up:
        tile, _ = engine.tiles[number]
        system = engine.system(number)
        model = engine.equations(number, tile.take(unknowns), nothing)
        parts = [engine.part_of(gradient, number) for gradient in gradients]
        handed = call_compiled(hand_columns, system, model, jax.tree.map(lambda *leaves: np.stack(leaves), *parts))
        arrays: Handed = jax.tree.map(np.asarray, handed)
        return engine.up_tile(number, arrays, nothing)

    top = engine.up(engine.each_tile(up), nothing).update[: border + count, : border + count]
    corner, across, left = top[:border, :border], top[border:, :border], top[border:, border:]
    negative = np.tril(left)
    return across @ inverse_of_border(corner) @ across.T - negative - np.tril(negative, -1).T
