"""Gradients through a solve beside Theseus, on one problem: `python -m benchmarks.gradients --theseus PYTHON`.

PYTHON is the interpreter of an environment that has theseus-ai; it runs `benchmarks/peers/theseus_ba.py`. The problem
is a block with outliers, fixed intrinsics and a Cauchy loss. Both sides begin at the same values, near the optimum, in
double precision, and stop where a step changes the cost by less than the same fraction. What is differentiated is a
random linear functional of the adjusted points, by the logarithm of the loss's scale and by all pixels at once.

Errors are relative, against central differences of solves brought to the last digits, of the derivative by the scale
and of that by the pixels along a random direction. jaxba's backward time is that of value and gradient less that of a
solve alone; compiling, and building Theseus' objective, are left out. Before anything is compared both costs at the
start must agree. Times are medians; what takes longer than 10 s with Theseus runs once.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
SCALE, TOLERANCES, MAX_STEPS = 2.385, (1e-8, 1e-13), 500  # 95% efficient for normal errors
_STEPS = (2e-4, 1e-4)  # of the differences: two, extrapolated
_SAME_COST, _SAME_OPTIMUM = 1e-9, 1e-5
_ADJOINTS = ("implicit", "gauss_newton", "unrolled")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients", description=__doc__)
    parser.add_argument("--images", type=int, default=6)
    parser.add_argument("--theseus", help="a Python that has theseus-ai; without it jaxba runs alone")
    parser.add_argument("--solvers", default="Cholmod", help="Theseus' linear solvers, of Cholmod and dense")
    parser.add_argument("--modes", default="IMPLICIT,TRUNCATED,UNROLL", help="Theseus' backward modes")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cores", type=int, default=2)
    options = parser.parse_args(arguments)
    if hasattr(os, "sched_setaffinity"):  # before jax counts the cores
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])
    result = compare(options)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "gradients.json").write_text(json.dumps(result, indent=1) + "\n")
    print(_HEADER)
    for row in result["runs"]:
        print(_line(row))


def compare(options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of both sides, ready for JSON."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from benchmarks.cost import cost_of
    from benchmarks.record import Values
    from jaxba.geometry import Cauchy

    problem, w, direction = make_problem(options.images)
    runs = [run(problem, w, a, tolerance, options.repeats) for a in _ADJOINTS for tolerance in TOLERANCES]
    versions = {"python": platform.python_version(), **{name: version(name) for name in ("jax", "jaxlib", "numpy")}}
    if options.theseus:
        peer = theseus(problem, w, options)
        runs += peer["runs"]
        versions |= {f"theseus: {name}": number for name, number in peer["versions"].items()}
    expected_cost = cost_of(problem, Cauchy(SCALE), Values.of(problem))
    value, by_scale, by_pixels = reference(problem, w, direction)
    exact, best = np.array(runs[0]["by_pixels"]), runs[0]["final_cost"]
    for row in runs:
        gradient = np.array(row.pop("by_pixels"))
        if abs(row["initial_cost"] / expected_cost - 1) > _SAME_COST:
            raise ValueError(f"{row['side']}: cost {row['initial_cost']} at the start, not {expected_cost}.")
        if abs(row["final_cost"] / best - 1) > _SAME_OPTIMUM:
            raise ValueError(f"{row['side']}, {row['mode']}: stopped at cost {row['final_cost']}, not {best}.")
        row["value_error"] = abs(row["value"] / value - 1)
        row["error_by_log_scale"] = abs(row["by_log_scale"] / by_scale - 1)
        row["error_by_pixels"] = abs(float(np.vdot(gradient, direction)) / by_pixels - 1)
        row["gradient_from_jaxba"] = float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))
    return {
        "num_images": problem.num_images,
        "num_points": problem.num_points,
        "num_observations": problem.num_observations,
        "loss": f"Cauchy({SCALE})",
        "dtype": "float64",
        "cores": options.cores,
        "repeats": options.repeats,
        "versions": versions,
        "reference": {"value": value, "by_log_scale": by_scale, "by_pixels_along_direction": by_pixels},
        "runs": runs,
    }


def make_problem(images: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Return the problem at its start values, the functional of the points and a direction of the pixels."""
    import equinox as eqx
    import jax

    import jaxba

    camera, rng = jaxba.SimplePinhole(3650.0, 2736.0, 1824.0), np.random.default_rng(0)
    problem = jaxba.synthetic.uav_block(images, camera=camera, outlier_fraction=0.02).problem.fix(intrinsics=True)
    problem = jaxba.solve(problem, loss=jaxba.Cauchy(SCALE)).apply(problem)
    step = np.concatenate([rng.normal(0, 1e-4, (images, 3)), rng.normal(0, 0.02, (images, 3))], axis=1)
    points = np.asarray(problem.points) + rng.normal(0, 0.1, problem.points.shape)
    poses = jax.tree.map(np.array, problem.poses.retract(step))
    problem = eqx.tree_at(lambda p: (p.poses, p.points), problem, (poses, points))
    return problem, rng.normal(size=points.shape), rng.normal(size=problem.observations.xy_px.shape)


def run(problem: Any, w: np.ndarray, adjoint: Any, tolerance: float, repeats: int) -> dict[str, Any]:
    """Time a solve with and without its gradient."""
    import jax
    import jax.numpy as jnp

    import jaxba

    plan = jaxba.make_plan(problem)

    def functional(log_scale: Any, xy_px: Any) -> tuple[Any, Any]:
        at, loss = _changed(problem, log_scale, xy_px)
        stop = {"ftol": tolerance, "xtol": tolerance, "gtol": 0.01 * tolerance, "max_nfev": MAX_STEPS}
        found = jaxba.solve(at, loss=loss, plan=plan, adjoint=adjoint, **stop)
        return jnp.vdot(w, found.points), found

    inputs = (jnp.log(SCALE), jnp.asarray(problem.observations.xy_px))
    both = jax.value_and_grad(functional, argnums=(0, 1), has_aux=True)
    forward, _ = _seconds(lambda: functional(*inputs), repeats)
    begun = time.perf_counter()
    jax.block_until_ready(both(*inputs))
    first = time.perf_counter() - begun
    total, ((value, found), gradient) = _seconds(lambda: both(*inputs), repeats)
    return {
        "side": f"jaxba {jaxba.__version__}",
        "mode": adjoint,
        "tolerance": tolerance,
        "value": float(value),
        "initial_cost": float(found.initial_cost),
        "final_cost": float(found.final_cost),
        "num_iterations": int(found.num_steps),
        "seconds_first_call": first,
        "seconds_forward": forward,
        "seconds_backward": total - forward,
        "by_log_scale": float(gradient[0]),
        "by_pixels": np.asarray(gradient[1]).tolist(),
    }


def theseus(problem: Any, w: np.ndarray, options: argparse.Namespace) -> dict[str, Any]:
    """Run Theseus in its own process and return its figures."""
    seen, prior, cameras = problem.observations, problem.prior("position"), problem.cameras
    arrays = {
        "rotation": problem.poses.rotation,
        "translation": problem.poses.translation,
        "points": problem.points,
        "focal": cameras.f,
        "center": np.concatenate([cameras.cx, cameras.cy]),
        "xy_px": seen.xy_px,
        "std_px": seen.std_px,
        "image_index": seen.image_index,
        "point_index": seen.point_index,
        "prior_image": prior.image_index,
        "prior_xyz": prior.xyz,
        "prior_std_m": prior.std_m,
        "w": w,
        "log_scale": np.log(SCALE),
        "tolerances": TOLERANCES,
        "max_iterations": MAX_STEPS,
        "repeats": options.repeats,
        "solvers": options.solvers,
        "modes": options.modes,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/problem.npz"
        np.savez(path, **{name: np.asarray(array) for name, array in arrays.items()})
        command = [options.theseus, str(Path(__file__).parent / "peers" / "theseus_ba.py"), path]
        done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def reference(problem: Any, w: np.ndarray, direction: np.ndarray) -> tuple[float, float, float]:
    """Return the functional and its derivatives by differences: by the scale, by the pixels along a direction."""
    import jaxba
    from jaxba.ba._traced import solve_to_the_last_digits

    plan, xy_px = jaxba.make_plan(problem), np.asarray(problem.observations.xy_px)

    def value(log_scale: float, along: float) -> float:
        at = _changed(problem, np.log(SCALE) + log_scale, xy_px + along * direction)
        found = solve_to_the_last_digits(*at, plan, ftol=0.0, xtol=1e-13, gtol=0.0, max_nfev=MAX_STEPS)
        return float(np.vdot(w, found.points))

    def difference(of: Callable[[float], float]) -> float:
        wide, narrow = ((of(step) - of(-step)) / (2 * step) for step in _STEPS)
        return narrow + (narrow - wide) / 3

    return value(0.0, 0.0), difference(lambda s: value(s, 0.0)), difference(lambda s: value(0.0, s))


def _changed(problem: Any, log_scale: Any, xy_px: Any) -> tuple[Any, Any]:
    import equinox as eqx
    import jax.numpy as jnp

    import jaxba

    return eqx.tree_at(lambda p: p.observations.xy_px, problem, xy_px), jaxba.Cauchy(f_scale=jnp.exp(log_scale))


def _seconds(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    import jax

    jax.block_until_ready(call())  # compiles
    seconds = []
    for _ in range(repeats):
        begun = time.perf_counter()
        result = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begun)
    return statistics.median(seconds), result


_HEADER = """\
| side | gradient | stops at | steps | forward (s) | backward (s) | error by scale | by pixels | all pixels, to jaxba |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def _line(row: dict[str, Any]) -> str:
    cells = [
        row["side"],
        row["mode"].lower(),
        f"{row['tolerance']:.0e}",
        str(row["num_iterations"]),
        f"{row['seconds_forward']:.3f}",
        f"{row['seconds_backward']:.3f}",
        f"{row['error_by_log_scale']:.1e}",
        f"{row['error_by_pixels']:.1e}",
        f"{row['gradient_from_jaxba']:.1e}",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
