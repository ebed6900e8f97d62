"""Scale bars put into a problem: two more rows of `position_offset` each, their ends, and a `ScaleBarPrior`."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._problem import Problem
from jaxba.ba.groups import PositionOffsetPrior, PositionPrior, ScaleBarPrior

_LEAST_VIEWS = 2


def with_scale_bars(
    problem: Problem,
    first: Sequence[int] | Int[np.ndarray, " bars"],
    second: Sequence[int] | Int[np.ndarray, " bars"],
    length_m: Sequence[float] | Float[Array | np.ndarray, " bars"],
    std_m: Sequence[float] | Float[Array | np.ndarray, " bars"],
) -> Problem:
    """Return the problem with known distances between points, each one more measurement of the adjustment.

    - `first`, `second`: the points at the ends of each bar. `length_m`, `std_m`: its length and the sigma of that.

    Offsets of positions that are held fixed go into the measured positions, so that what is free of `position_offset`
    is the ends of bars alone. `statistics(...).prior_frame("scale_bar")` tells how the bars fit.

    Raises `JaxbaError` for points that are not there or that fewer than two images see, a bar of one point, the same
    bar twice, lengths and sigmas that are no positive numbers, and where the problem has bars already.

    >>> import jaxba
    >>> problem = jaxba.synthetic.uav_block(8, gnss_std_m=None).problem.fix(poses=[0])
    >>> jaxba.ba.free_gauge(problem), jaxba.ba.free_gauge(jaxba.with_scale_bars(problem, [3], [90], [52.1], [0.01]))
    (('scale',), ())
    """
    one, other = np.asarray(first), np.asarray(second)
    if not (
        one.shape == other.shape == (one.size,) and one.dtype.kind in "iu" and other.dtype.kind in "iu" and one.size
    ):
        raise JaxbaError("with_scale_bars: give one point number or more in first, and as many in second.")
    ends = np.stack([one, other], axis=-1)
    length_m, std_m = np.asarray(length_m, float), np.asarray(std_m, float)
    _require(problem, ends, length_m, std_m)
    problem = _without_held_offsets(problem)
    point = ends.reshape(-1).astype(np.int32)
    before = len(problem.position_offset)
    xyz = np.asarray(problem.points)[point]
    rows = ScaleBarPrior(
        offset_index=before + np.arange(len(point), dtype=np.int32),
        end_index=np.arange(len(point), dtype=np.int32) % 2,
        point_index=point,
        xyz=xyz,
        other_xyz=xyz.reshape(-1, 2, 3)[:, ::-1].reshape(-1, 3),
        length_m=np.repeat(length_m, 2),
        std_m=np.repeat(std_m, 2)[:, None],
    )
    priors = [_beside(prior, before, len(point)) for prior in problem.priors]
    return dataclasses.replace(
        problem,
        priors=(*priors, rows),
        position_offset=np.concatenate([problem.position_offset, np.zeros((len(point), 3))]),
        free=dataclasses.replace(problem.free, position_offset=np.array(True)),
    )


def _require(problem: Problem, ends: np.ndarray, length_m: np.ndarray, std_m: np.ndarray) -> None:
    if problem.prior(ScaleBarPrior.name) is not None:
        raise JaxbaError("with_scale_bars: the problem has scale bars already; give all of them at once.")
    for name, values in (("length_m", length_m), ("std_m", std_m)):
        if values.shape != (len(ends),):
            raise JaxbaError(f"with_scale_bars: {name} has shape {values.shape} for {len(ends)} bars; give one a bar.")
        bad = np.flatnonzero(~(np.isfinite(values) & (values > 0)))
        if len(bad):
            raise JaxbaError(f"with_scale_bars: bar {bad[0]} has {name}={values[bad[0]]:g}; give metres above 0.")
    views = np.bincount(np.asarray(problem.observations.point_index), minlength=problem.num_points)
    for bar, (one, other) in enumerate(ends):
        for point in (one, other):
            if not 0 <= point < problem.num_points:
                raise JaxbaError(f"with_scale_bars: bar {bar} has point {point} of {problem.num_points}, from 0.")
            if problem.free.points[point] and views[point] < _LEAST_VIEWS:
                raise JaxbaError(
                    f"with_scale_bars: point {point} of bar {bar} is seen in {views[point]} images; two fix a point."
                )
        if one == other:
            raise JaxbaError(f"with_scale_bars: bar {bar} has point {one} at both ends.")
    if len(np.unique(np.sort(ends, axis=1), axis=0)) < len(ends):
        raise JaxbaError("with_scale_bars: two bars have the same points; give their mean, or one of them.")


def _without_held_offsets(problem: Problem) -> Problem:
    """Return the problem without offsets that are held fixed: what they are is taken from the measured positions."""
    if problem.free.position_offset or not len(problem.position_offset):
        return problem
    offsets = np.asarray(problem.position_offset)
    priors = tuple(
        dataclasses.replace(prior, xyz=np.asarray(prior.xyz) - prior.offset(offsets), offset_weights=None)
        if isinstance(prior, PositionPrior)
        else prior
        for prior in problem.priors
        if not isinstance(prior, PositionOffsetPrior)
    )
    return dataclasses.replace(problem, priors=priors, position_offset=np.zeros((0, 3)))


def _beside(prior: object, before: int, ends: int) -> object:
    """Return a prior that is about the offsets before the ends alone."""
    if not isinstance(prior, PositionPrior):
        return prior
    own = prior.offset_weights
    weights = np.ones((len(prior.image_index), before)) if own is None else np.asarray(own)
    return dataclasses.replace(prior, offset_weights=np.concatenate([weights, np.zeros((len(weights), ends))], axis=1))
