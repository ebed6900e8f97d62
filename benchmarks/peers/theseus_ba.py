"""Gradient through a bundle adjustment with Theseus: `python theseus_ba.py problem.npz`, JSON on stdout.

Runs in an environment of its own that has theseus-ai and torch; nothing of jaxba is imported. The problem comes as
arrays, written by `benchmarks.gradients`: poses and points are free, intrinsics are not. The residuals are Theseus'
own reprojection, whose camera looks along -z with y upwards, made robust by Cauchy's loss, and positions of cameras.
"""

import json
import os
import sys
import time
import warnings
from importlib.metadata import version

import numpy as np
import theseus as th
import torch
from theseus.core.robust_loss import RobustLoss

_SOLVERS = {"Cholmod": th.CholmodSparseSolver, "dense": th.CholeskyDenseSolver}
_LONG_S = 10.0
_LAST = {"backward_num_iterations": 5}  # of TRUNCATED


class Cauchy(RobustLoss):
    """`radius ln(1 + x / radius)` of the squared norm x; the radius is the loss's scale squared."""

    @staticmethod
    def _evaluate_impl(x: torch.Tensor, radius: torch.Tensor) -> torch.Tensor:
        return radius * torch.log1p(x / radius)

    @staticmethod
    def _linearize_impl(x: torch.Tensor, radius: torch.Tensor) -> torch.Tensor:
        return 1 / (1 + x / radius)


class Position(th.CostFunction):
    """The camera's centre beside what was measured, metres."""

    def __init__(self, pose: th.SE3, measured: th.Vector, weight: th.CostWeight, name: str | None = None):
        super().__init__(weight, name=name)
        self.pose, self.measured = pose, measured
        self.register_optim_vars(["pose"])
        self.register_aux_vars(["measured"])

    def error(self) -> torch.Tensor:
        return self._center() - self.measured.tensor

    def jacobians(self) -> tuple[list[torch.Tensor], torch.Tensor]:
        # a step (v, w) on the right, R' = R exp(w) and t' = t + R v, moves the centre by -v - w x c
        center = self._center()
        moved = -torch.eye(3, dtype=center.dtype).expand(len(center), 3, 3)
        return [torch.cat([moved, th.SO3.hat(center)], dim=2)], self.error()

    def dim(self) -> int:
        return 3

    def _center(self) -> torch.Tensor:
        pose = self.pose.tensor
        return -(pose[:, :, :3].transpose(1, 2) @ pose[:, :, 3:]).squeeze(2)

    def _copy_impl(self, new_name: str | None = None) -> "Position":
        return Position(self.pose.copy(), self.measured.copy(), self.weight.copy(), name=new_name)


def main(path: str) -> None:
    torch.set_num_threads(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
    torch.set_default_dtype(torch.float64)
    warnings.filterwarnings("ignore")
    problem = dict(np.load(path))
    found = []
    for solver in str(problem["solvers"]).split(","):
        for mode in str(problem["modes"]).split(","):
            for tolerance in problem["tolerances"]:
                found.append(run(problem, solver, mode, float(tolerance)))
                print(solver, mode, tolerance, found[-1]["seconds_forward"], file=sys.stderr, flush=True)
    versions = {name: version(name) for name in ("theseus-ai", "torch", "numpy", "scikit-sparse")}
    print(json.dumps({"versions": versions, "runs": found}))


def run(problem: dict[str, np.ndarray], solver: str, mode: str, tolerance: float) -> dict[str, object]:
    """Solve and go backwards, `repeats` times over, or until 10 s are over."""
    begun = time.perf_counter()
    objective = make_objective(problem)
    optimizer = th.LevenbergMarquardt(
        objective,
        linear_solver_cls=_SOLVERS[solver],
        max_iterations=int(problem["max_iterations"]),
        abs_err_tolerance=0.0,
        rel_err_tolerance=tolerance,
    )
    layer = th.TheseusLayer(optimizer)
    setup = time.perf_counter() - begun
    w, flip = torch.tensor(problem["w"]), torch.tensor([1.0, -1.0])
    forward, backward = [], []
    for _ in range(int(problem["repeats"])):
        pixels = torch.tensor(problem["xy_px"], requires_grad=True)
        log_scale = torch.tensor(float(problem["log_scale"]), requires_grad=True)
        steps: list[int] = []
        begun = time.perf_counter()
        inputs = start(problem)
        inputs |= {f"pixel{k}": xy for k, xy in enumerate(((pixels - torch.tensor(problem["center"])) * flip).split(1))}
        inputs["log_radius"] = (2 * log_scale).reshape(1, 1)
        objective.update(inputs)
        initial_cost = objective.error_metric().item()
        values, _ = layer.forward(
            inputs,
            {"backward_mode": mode, "end_iter_callback": lambda *_, done=steps: done.append(1)}
            | (_LAST if mode == "TRUNCATED" else {}),
        )
        points = torch.cat([values[f"point{k}"] for k in range(len(w))])
        value = (w * points).sum()
        forward.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        value.backward()
        backward.append(time.perf_counter() - begun)
        if sum(forward + backward) > _LONG_S:
            break
    with torch.no_grad():
        final_cost = objective.error_metric().item()
    assert pixels.grad is not None and log_scale.grad is not None
    return {
        "side": f"Theseus, {solver}",
        "mode": mode,
        "tolerance": tolerance,
        "value": value.item(),
        "initial_cost": initial_cost,
        "final_cost": final_cost,
        "num_iterations": len(steps) + 1,
        "seconds_setup": setup,
        "seconds_forward": sorted(forward)[len(forward) // 2],
        "seconds_backward": sorted(backward)[len(backward) // 2],
        "by_log_scale": log_scale.grad.item(),
        "by_pixels": pixels.grad.tolist(),
    }


def start(problem: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Return the start values by the names of their variables."""
    turn = np.array([1.0, -1.0, -1.0])[:, None]  # to a camera that looks along -z, y upwards
    poses = turn * np.concatenate([problem["rotation"], problem["translation"][:, :, None]], axis=2)
    found = {f"pose{k}": torch.tensor(pose[None]) for k, pose in enumerate(poses)}
    return found | {f"point{k}": torch.tensor(point[None]) for k, point in enumerate(problem["points"])}


def make_objective(problem: dict[str, np.ndarray]) -> th.Objective:
    """Return the sum of all residuals, a cost function for each."""
    at = start(problem)
    poses = [th.SE3(tensor=at[f"pose{k}"], name=f"pose{k}") for k in range(len(problem["rotation"]))]
    points = [th.Point3(tensor=at[f"point{k}"], name=f"point{k}") for k in range(len(problem["points"]))]
    focal = th.Vector(tensor=torch.tensor(problem["focal"]).reshape(1, 1), name="focal")
    radius = th.Variable(torch.zeros(1, 1), name="log_radius")
    none = [th.Vector(tensor=torch.zeros(1, 1), name=name) for name in ("k1", "k2")]
    weights = {std: th.ScaleCostWeight(1 / float(std)) for std in np.unique(problem["std_px"])}
    objective = th.Objective(dtype=torch.float64)
    for k, (image, point) in enumerate(zip(problem["image_index"], problem["point_index"], strict=True)):
        seen, weight = th.Point2(tensor=torch.zeros(1, 2), name=f"pixel{k}"), weights[problem["std_px"][k]]
        cost = th.eb.Reprojection(poses[image], points[point], seen, focal, *none, weight=weight, name=f"seen{k}")
        objective.add(th.RobustCostFunction(cost, Cauchy, radius, name=f"robust{k}"))
    priors = zip(problem["prior_image"], problem["prior_xyz"], problem["prior_std_m"], strict=True)
    for k, (image, xyz, std) in enumerate(priors):
        measured = th.Vector(tensor=torch.tensor(xyz[None]), name=f"measured{k}")
        weight = th.DiagonalCostWeight(th.Variable(torch.tensor(1 / std[None]), name=f"weight{k}"))
        objective.add(Position(poses[image], measured, weight, name=f"position{k}"))
    return objective


if __name__ == "__main__":
    main(sys.argv[1])
