"""The gradient by a problem and its loss, while the tiles of the problem add their parts to it."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool

from jaxba.ba._problem import Problem
from jaxba.ba._system import System, own_unknowns, restore
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.tiles._cut import Tile
from jaxba.geometry import AbstractLoss, Pose


class GradientSums:
    """Sums over tiles, in the problem's order."""

    def __init__(self, problem: Problem, loss: AbstractLoss) -> None:
        self._problem, self._loss = problem, loss
        self._xy_px = np.zeros(problem.observations.xy_px.shape)
        self._std_px = np.zeros(problem.observations.std_px.shape)
        self._priors = [
            {
                n: np.zeros(np.shape(v))
                for n, v in vars(prior).items()
                if n != "loss" and v is not None and np.asarray(v).dtype.kind == "f"
            }
            for prior in problem.priors
        ]
        losses = loss, *(prior.loss for prior in problem.priors)
        self._losses = [np.zeros(len(jax.tree.leaves(of))) for of in losses]
        self._unknowns = jax.tree.map(np.zeros_like, own_unknowns(problem))

    def add(self, tile: Tile, of_system: System, of_unknowns: Unknowns) -> None:
        """Add a tile's gradient by its system and its unknowns."""
        plan = tile.plan
        layout = np.flatnonzero(plan.row_observation >= 0)
        rows = tile.rows[plan.row_observation[layout]]
        std_px = np.asarray(self._problem.observations.std_px)[rows]
        self._xy_px[rows] += of_system.reprojection.xy_px.reshape(2, -1)[:, layout].T
        self._std_px[rows] -= of_system.reprojection.weight.reshape(-1)[layout] / std_px**2
        for fields, chosen, prior in zip(self._priors, tile.prior_rows, of_system.priors, strict=True):
            for name, whole in fields.items():
                whole[chosen] += getattr(prior, name)[: len(chosen)]
        losses = of_system.loss, *(prior.loss for prior in of_system.priors)
        for whole, loss in zip(self._losses, losses, strict=True):
            whole += np.array(jax.tree.leaves(loss))
        found, total = restore(of_unknowns, plan), self._unknowns
        total.poses.quaternion[tile.images] += found.poses.quaternion
        total.poses.translation[tile.images] += found.poses.translation
        total.intrinsics[tile.cameras] += found.intrinsics
        total.antenna[:] += found.antenna
        total.points[tile.points] += found.points

    def assembled(
        self,
        direct: Unknowns,
        at_lower: Bool[np.ndarray, "cameras parameters"],
        at_upper: Bool[np.ndarray, "cameras parameters"],
    ) -> tuple[Problem, AbstractLoss]:
        """Return the gradient as trees like the problem and its loss.

        What is fixed moves with its start value, an intrinsic at a bound with the bound; to them goes `direct` as well,
        the scalar's own gradient by the unknowns.
        """
        problem, free = self._problem, self._problem.free
        through = jax.tree.map(lambda a, b: a + np.asarray(b), self._unknowns, direct)
        fixed_pose, fixed_point = (~np.asarray(of)[:, None] for of in (free.poses, free.points))
        intrinsics = through.intrinsics
        of_start = np.where(np.asarray(free.intrinsics), 0.0, intrinsics)
        changed = eqx.tree_at(
            lambda p: (p.poses, p.cameras, p.points, p.priors, p.lever_arm, p.position_offset, p.lower, p.upper,
                       p.observations.xy_px, p.observations.std_px),
            problem,
            (
                Pose(through.poses.quaternion * fixed_pose, through.poses.translation * fixed_pose),
                type(problem.cameras).from_parameters(of_start),
                through.points * fixed_point,
                tuple(map(_like_prior, problem.priors, self._priors, self._losses[1:])),
                through.lever_arm * (not np.asarray(free.lever_arm)),
                through.position_offset * (not np.asarray(free.position_offset)),
                np.where(at_lower, intrinsics, 0.0),
                np.where(at_upper, intrinsics, 0.0),
                self._xy_px,
                self._std_px,
            ),
        )  # fmt: skip
        return changed, _like_loss(self._loss, self._losses[0])


def _like_prior(prior: Any, fields: dict[str, np.ndarray], loss: np.ndarray) -> Any:
    names = list(fields)
    changed = eqx.tree_at(lambda p: [getattr(p, name) for name in names], prior, [fields[name] for name in names])
    return eqx.tree_at(lambda p: p.loss, changed, _like_loss(prior.loss, loss))


def _like_loss(loss: AbstractLoss, values: np.ndarray) -> AbstractLoss:
    leaves, structure = jax.tree.flatten(loss)
    return jax.tree.unflatten(
        structure, [np.reshape(value, np.shape(leaf)) for value, leaf in zip(values, leaves, strict=True)]
    )
