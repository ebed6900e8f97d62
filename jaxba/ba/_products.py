"""Products of runs of rows, many at a time: `A^T B` of each run.

On a CPU they are small matrix products. Elsewhere XLA would make a batched matrix product of them, which is written for
large matrices: there they are multiplied and added up entry by entry, which XLA makes one kernel of.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.ba._compiler import platform


def run_products(first: Float[Array, "runs k a"], second: Float[Array, "runs k b"]) -> Float[Array, "runs a b"]:
    """Return `A^T B` of each run.

    >>> import numpy as np
    >>> run_products(jnp.ones((1, 4, 2)), jnp.ones((1, 4, 3))).tolist()
    [[[4.0, 4.0, 4.0], [4.0, 4.0, 4.0]]]
    """
    if platform() == "cpu":
        return jnp.einsum("rka,rkb->rab", first, second)
    return jnp.sum(first[:, :, :, None] * second[:, :, None, :], axis=1)
