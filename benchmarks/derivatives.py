"""Derivatives of the adjustment: what they cost and how exact they are: `python -m benchmarks.derivatives`.

Cost: a full gradient by the loss's scale and by all pixels, of a block that stands at its optimum; medians of five,
beside a step of the solver on the same system in the same process. Exactness: `jaxba.check_gradients` on a block with
every prior, for four losses, without bounds and with an active one.
"""

import json
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxba
from jaxba.ba._descend import compiled
from jaxba.ba._system import initial_unknowns, make_system, without_losses

RESULTS = Path(__file__).parent / "results"
_REPEATS = 5
_BLOCKS: dict[str, Callable[[], Any]] = {
    "100 images, long tracks": lambda: jaxba.synthetic.uav_block(
        100, points_per_image=35, mean_track_length=12.3, forward_overlap=0.9, side_overlap=0.8
    ),
    "500 images": lambda: jaxba.synthetic.uav_block(500),
}
_LOSSES = {
    "linear": jaxba.Linear(),
    "huber": jaxba.Huber(1.5),
    "cauchy": jaxba.Cauchy(2.0),
    "barron": jaxba.Barron(0.5, 2.0),
}


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    costs = [_cost(name, make().problem) for name, make in _BLOCKS.items()]
    print("| block | points, observations | step (s) | gradient by the scale (s) | by all pixels (s) | first (s) |")
    print("| --- | --- | --- | --- | --- | --- |")
    for c in costs:
        seconds = f"{c['step_s']:.3f} | {c['by_scale_s']:.3f} | {c['by_pixels_s']:.3f} | {c['first_s']:.1f}"
        print(f"| {c['block']} | {c['points']}, {c['observations']} | {seconds} |", flush=True)
    errors = [_errors(name, bounded) for bounded in (False, True) for name in _LOSSES]
    print("\n| loss | bounds | inputs | largest error | of reverse mode | largest of Gauss-Newton |")
    print("| --- | --- | --- | --- | --- | --- |")
    for e in errors:
        figures = f"{e['error']:.1e} | {e['reverse_error']:.1e} | {e['gauss_newton_error']:.1e}"
        print(f"| {e['loss']} | {e['bounds']} | {len(e['rows'])} | {figures} |")
    versions = {name: version(name) for name in ("jax", "equinox", "optimistix")}
    found = {"versions": versions, "cost": costs, "errors": errors}
    (RESULTS / "derivatives.json").write_text(json.dumps(found, indent=1) + "\n")


def _cost(name: str, problem: jaxba.Problem) -> dict[str, Any]:
    loss = jaxba.Huber(1.0)
    problem = jaxba.solve(problem, loss=loss).apply(problem)
    plan = jaxba.make_plan(problem)
    weights = np.random.default_rng(0).normal(size=problem.points.shape)

    def by_scale(log_scale: Any) -> jax.Array:
        return jnp.sum(weights * jaxba.solve(problem, loss=jaxba.Huber(jnp.exp(log_scale)), plan=plan).points)

    def by_pixels(xy_px: Any) -> jax.Array:
        changed = eqx.tree_at(lambda p: p.observations.xy_px, problem, xy_px)
        return jnp.sum(weights * jaxba.solve(changed, loss=loss, plan=plan).points)

    system, unknowns = jax.device_put((make_system(problem, plan, loss), initial_unknowns(problem, plan)))
    run = compiled(jaxba.SchurLevenbergMarquardt(), unknowns, system, jax.device_put(without_losses(system)))
    state = run.init(unknowns, system)
    first = _seconds(lambda: jax.grad(by_scale)(0.0), 1)
    return {
        "block": name,
        "points": problem.num_points,
        "observations": problem.num_observations,
        "step_s": _seconds(lambda: run.step(unknowns, state, system)),
        "by_scale_s": _seconds(lambda: jax.grad(by_scale)(0.0)),
        "by_pixels_s": _seconds(lambda: jax.grad(by_pixels)(np.asarray(problem.observations.xy_px))),
        "first_s": first,
    }


def _seconds(call: Callable[[], Any], repeats: int = _REPEATS) -> float:
    """Return the median; with several repeats, after a call that compiles."""
    if repeats > 1:
        jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def _errors(name: str, bounded: bool) -> dict[str, Any]:
    loss = _LOSSES[name]
    problem = jaxba.synthetic.uav_block(
        4, seed=1, outlier_fraction=0.05, num_control=3, attitude_prior=True, lever_arm_m=(0.1, 0.2, 0.3),
        lever_arm_std_m=0.02, camera=jaxba.SimpleRadial(3600.0, 2736.0, 1824.0, 0.01),
    ).problem  # fmt: skip
    problem = problem.bound(k1=(-0.005, 0.005)) if bounded else problem.fix(points=[12], poses=[0], intrinsics=["cy"])
    checked = jaxba.check_gradients(problem, loss=loss)
    rows = [vars(row) for row in checked.rows]
    largest = {key: max(row[key] for row in rows) for key in ("error", "reverse_error", "gauss_newton_error")}
    return {"loss": name, "bounds": "active" if bounded else "none", **largest, "rows": rows}


if __name__ == "__main__":
    main()
