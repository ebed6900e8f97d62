"""How far the errors of a block's observations really scatter, and the problem whose sigmas say so.

The sigma that weighs an observation is that of the median. Errors of feature points have longer tails than a normal
distribution, and all of them bear on the result. An estimate that solves `sum psi(e) = 0` has the variance
`E psi^2 / (E psi')^2` an observation (Huber 1964): for SIFT points in simulated photos 1.8 times what the median says.
Errors cut off by a limit look narrower than they are, so it is taken as 1 at least. What cutting itself costs is not in
it: with normal errors, poses known and 5% or 10% cut, points scatter by 1.10 or 1.17 times their variance, all of it in
tracks that lost an observation.

How far such an estimate gives way to a further measurement is another matter: by `1 / E psi'` an observation.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from jaxba.ba import AbstractPrior, PositionPrior, Problem, camera_centers, loss_derivatives
from jaxba.geometry import AbstractLoss, GemanMcClure
from jaxba.scene import Block
from jaxba.sfm._points import redundancy_root

_LEAST_REDUNDANCY = 30  # to tell how errors are spread
_LET_GO = 0.1  # weight of a position that its loss has let go
_FARTHEST, _STEPS = 8.0, 2000  # sigmas, of sums over normal errors


@dataclasses.dataclass(frozen=True)
class Spread:
    """Multiples of the sigma that weighed an observation or position.

    - `scatter`: what accounts for the scatter of what was estimated.
    - `yielding`: what accounts for how far the estimate gives way to a further measurement.
    """

    scatter: float = 1.0
    yielding: float = 1.0


def spread(block: Block, error_px: Float[np.ndarray, " observations"], std_px: float, loss: AbstractLoss) -> Spread:
    """Return how the errors of observations bear on the result under their loss.

    With psi(e) = w(|e|) e over all observations, in sigmas, E over both coordinates:

        scatter^2 = E psi^2 E w / (E psi')^2,   yielding^2 = E w / E psi',   E psi' = E (w + |e|^2 dw/d|e|^2)

    `E psi^2` is over the redundancy; psi' is taken at errors as in long tracks. Both are 1 at least.
    """
    error = error_px / std_px
    redundancy = 2 * block.num_observations - 3 * block.num_points - 6 * block.num_images
    if redundancy < _LEAST_REDUNDANCY:
        return Spread()
    views = np.bincount(block.observation_point, minlength=block.num_points)
    comparable = error * redundancy_root(views)[block.observation_point]
    weight, change = loss_derivatives(loss, comparable**2)
    slope = np.mean(weight + comparable**2 * change)
    if slope <= 0:  # a loss that turns back, with most errors beyond its turn
        return Spread()
    squared = np.sum((weight * error) ** 2) / redundancy
    mean = np.mean(weight)
    return Spread(float(max(np.sqrt(squared * mean) / slope, 1.0)), float(max(np.sqrt(mean / slope), 1.0)))


def position_spread(problem: Problem, prior: PositionPrior) -> Spread:
    """Return how the errors of positions bear on the result under their loss.

    A few positions do not tell how their errors are spread: they are taken as normal, as their sigmas say. Weights of
    positions that are as good as any make the covariance larger than it is: for normal errors and `POSITION_LOSS` by a
    third, where the estimate loses 7%. With w the mean weight of the positions that the loss has not let go, and w'
    the mean of their own psi',

        scatter^2 = w E psi^2 / (E psi')^2,   yielding^2 = w / w'

    expectations of normal errors as in `spread`, over three coordinates.
    """
    center = camera_centers(problem.poses)[prior.image_index]
    with jax.enable_x64(True):
        offset = np.asarray(prior.offset(np.asarray(problem.position_offset)))
    squared = np.sum(((center + offset - prior.xyz) / prior.std_m) ** 2, axis=1)
    weight, bent = loss_derivatives(prior.loss, squared)
    z = (np.arange(_STEPS) + 0.5) * _FARTHEST / _STEPS  # over sigma; chi's density of three degrees follows
    of_normal, change = loss_derivatives(prior.loss, z**2)
    share = z**2 * np.exp(-(z**2) / 2)
    share /= share.sum()
    slope = float(share @ (of_normal + 2 / 3 * z**2 * change))
    kept = weight > _LET_GO
    if slope <= 0 or not kept.any():
        return Spread()
    mean, squares = float(weight[kept].mean()), float(share @ (of_normal * z) ** 2) / 3
    own = float(np.mean((weight + 2 / 3 * squared * bent)[kept]))
    return Spread(np.sqrt(mean * squares) / slope, np.sqrt(mean / own) if own > 0 else 1.0)


def weighed(problem: Problem, times: float, num_own: int, *, yielding: bool = False) -> Problem:
    """Return a problem with the sigmas of observations and positions as their errors show them.

    Those of its first `num_own` observations are multiplied by `times`, by which the scale of their loss is to be
    divided; marks' stand. `yielding`: the covariance is to tell how far the block gives way.
    """
    observations = problem.observations
    std_px = np.concatenate([observations.std_px[:num_own] * times, observations.std_px[num_own:]])

    def of(prior: AbstractPrior) -> AbstractPrior:
        if not isinstance(prior, PositionPrior) or not isinstance(prior.loss, GemanMcClure):
            return prior
        shown = position_spread(problem, prior)
        by = shown.yielding if yielding else shown.scatter
        std_m = np.asarray(prior.std_m) * by
        return dataclasses.replace(prior, std_m=std_m, loss=GemanMcClure(prior.loss.f_scale / by))

    observations = dataclasses.replace(observations, std_px=std_px)
    return dataclasses.replace(problem, observations=observations, priors=tuple(map(of, problem.priors)))
