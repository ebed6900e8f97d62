"""What `jaxba solve` tells: the facts of a run (its `--json`), and a summary of them in words; also of several runs."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.ba import Problem, Rejected, Report, Reweighted, Statistics
from jaxba.cli._options import SolveOptions
from jaxba.cli._statistics import statistics_facts, statistics_rows, weights_facts, weights_rows
from jaxba.cli._text import first_of, gauge_text, many, table
from jaxba.geometry import LOSSES, AbstractLoss, Linear

_HEAVY_TAIL = 3.0  # rms over median of the errors; 1.2 without outliers, 8 with 2% of them under least squares
_LARGE_MEDIAN_PX = 3.0
_MOST_BOUNDS, _MOST_FILES = 6, 6


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished `solve`.

    - `given`: the problem as read; `problem`: with the options' fixed blocks and bounds.
    - `seconds`: all rounds together, with setup and compile. `statistics`: where they were asked for,
      or why there are none.
    """

    file: Path
    out: Path
    given: Problem
    problem: Problem
    found: Rejected
    loss: AbstractLoss
    options: SolveOptions
    seconds: float
    statistics: Statistics | str | None = None
    weights: Reweighted | None = None

    @property
    def report(self) -> Report:
        """How the last round went."""
        report = self.found.solution.report
        assert report is not None  # only a solve inside jit has none
        return report


def name_of_loss(loss: AbstractLoss) -> str:
    """Return the name of a loss in options and files."""
    return next(name for name, kind in LOSSES.items() if type(loss) is kind)


def loss_parameters(loss: AbstractLoss) -> dict[str, float]:
    """Return the numbers of a loss by name."""
    return {field.name: float(getattr(loss, field.name)) for field in dataclasses.fields(loss)}


def facts(run: Run) -> dict[str, object]:
    """Return everything about a run by name, for `--json`.

    With rejection, costs, steps and `history` are of the last round, `rounds` tells of each; times are of all together.
    """
    solution, report, found = run.found.solution, run.report, run.found.quality
    reports = [round_.report for round_ in run.found.solutions if round_.report is not None]
    before, after = intrinsics(run.problem), intrinsics(solution.apply(run.problem))
    names = type(run.problem.cameras).parameter_names()
    return {
        "result": solution.result,
        "converged": solution.converged,
        "advice": solution.advice,
        "hints": hints(run),
        "initial_cost": float(solution.initial_cost),
        "final_cost": float(solution.final_cost),
        "initial_plain_cost": float(solution.initial_plain_cost),
        "final_plain_cost": float(solution.plain_cost),
        "loss": name_of_loss(run.loss),
        "f_scale": float(run.loss.f_scale),
        "method": run.options.method,
        "linear_solver": report.linear_solver,
        "num_steps": int(solution.num_steps),
        "seconds_setup": sum(r.seconds_setup for r in reports),
        "seconds_compile": sum(r.seconds_compile for r in reports),
        "seconds_solve": sum(r.seconds_solve for r in reports),
        "seconds_total": run.seconds,
        "median_error_px": found.median_px,
        "rms_error_px": found.rms_px,
        "mad_px": found.mad_px,
        "threshold_px": found.threshold_px,
        "inlier_rate": found.inlier_rate,
        "num_images": run.problem.num_images,
        "num_cameras": run.problem.num_cameras,
        "num_points": run.problem.num_points,
        "num_observations": run.problem.num_observations,
        "num_used": int(np.count_nonzero(run.found.used)),
        "num_rejected": list(run.found.num_rejected),
        "rounds": [
            {
                "result": round_.result,
                "initial_cost": float(round_.initial_cost),
                "final_cost": float(round_.final_cost),
                "num_steps": int(round_.num_steps),
            }
            for round_ in run.found.solutions
        ],
        "dropped": report.dropped.summary(),
        "free_gauge": list(report.free_gauge),
        "intrinsics": {
            name: {"before": before[:, i], "after": after[:, i], "free": np.asarray(run.problem.free.intrinsics)[:, i]}
            for i, name in enumerate(names)
        },
        "at_bounds": at_bounds(run),
        "input": str(run.file),
        "output": str(run.out),
        "history": [
            {"step": step.step, "seconds": step.seconds, "cost": step.cost, "accepted": step.accepted}
            for step in report.history
        ],
        **({} if run.weights is None else {"weights": weights_facts(run.weights)}),
        **({} if run.statistics is None else {"statistics": statistics_facts(run.statistics)}),
    }


def summary(run: Run) -> str:
    """Return the run in words."""
    solution, report, found = run.found.solution, run.report, run.found.quality
    problem = run.problem
    costs = f"{solution.initial_cost:.6g} -> {solution.final_cost:.6g}"
    if not isinstance(run.loss, Linear):
        plain = f"{solution.initial_plain_cost:.6g} -> {solution.plain_cost:.6g}"
        costs = f"{costs} ({name_of_loss(run.loss)}; without the loss {plain})"
    sizes = (
        many(problem.num_images, "image"),
        many(problem.num_cameras, "camera"),
        many(problem.num_points, "point"),
        many(problem.num_observations, "observation"),
    )
    seconds = f"{report.seconds_setup:.2f} s setup, {report.seconds_compile:.2f} s compile"
    rejected = [f"round {i + 1}: {many(n, 'observation')}" for i, n in enumerate(run.found.num_rejected)]
    bounds, factor = at_bounds(run), run.options.mad_factor
    return table(
        (
            ("problem", f"{run.file}: {', '.join(sizes)}"),
            ("result", [solution.advice, *hints(run)]),
            ("cost", costs),
            ("steps", f"{solution.num_steps} in {report.seconds_solve:.2f} s ({seconds}; {report.linear_solver})"),
            ("left out", report.dropped.summary()),
            ("rejected", rejected),
            ("gauge", gauge_text(report.free_gauge)),
            ("errors", f"median {found.median_px:.3f} px, MAD {found.mad_px:.3f} px, rms {found.rms_px:.3f} px"),
            (
                "inliers",
                f"{found.inlier_rate:.1%} of all, within {found.threshold_px:.3f} px (median + {factor:g} MAD)",
            ),
            ("intrinsics", _refined(run)),
            ("at bounds", first_of(bounds, _MOST_BOUNDS) if bounds else []),
            *(weights_rows(run.weights) if run.weights is not None else ()),
            *(statistics_rows(run.statistics) if run.statistics is not None else ()),
            ("written", str(run.out)),
        )
    )


def hints(run: Run) -> list[str]:
    """Return what to do about what the numbers show; empty if they look well."""
    found, texts = run.found.quality, []
    if isinstance(run.loss, Linear) and not run.options.reject and found.rms_px > _HEAVY_TAIL * found.median_px:
        texts.append(
            f"A few large errors rule the result (rms {found.rms_px:.2f} px, median {found.median_px:.2f} px): use "
            "--loss huber, or --reject mad."
        )
    if found.median_px > _LARGE_MEDIAN_PX:
        texts.append(
            f"The median error of {found.median_px:.2f} px is large: check the focal length against the "
            "sensor's, and for images of another camera."
        )
    if at_bounds(run):
        texts.append(
            "Intrinsics lie at their bounds, where self-calibration absorbs model error: fix them, add oblique "
            "images or control points, or use another loss."
        )
    return texts


def at_bounds(run: Run) -> list[str]:
    """Name the free intrinsics that lie at a bound."""
    problem = run.problem
    values, names = intrinsics(run.found.solution.apply(problem)), type(problem.cameras).parameter_names()
    texts = []
    for word, bound in (("lower", np.asarray(problem.lower)), ("upper", np.asarray(problem.upper))):
        close = np.isclose(values, bound, rtol=1e-9, atol=0.0) & np.asarray(problem.free.intrinsics)
        for camera, column in np.argwhere(close):
            of_camera = f" of camera {camera}" if problem.num_cameras > 1 else ""
            texts.append(f"{names[column]}{of_camera} at its {word} bound {bound[camera, column]:.6g}")
    return texts


def intrinsics(problem: Problem) -> Float[np.ndarray, "cameras parameters"]:
    """Return the intrinsics, a column for each of the model's parameters."""
    cameras = problem.cameras
    return np.stack([np.asarray(getattr(cameras, name), float) for name in type(cameras).parameter_names()], axis=1)


def _refined(run: Run) -> str:
    """Return the free intrinsics before and after; of several cameras their medians."""
    names = type(run.problem.cameras).parameter_names()
    free = np.asarray(run.problem.free.intrinsics)
    before, after = intrinsics(run.problem), intrinsics(run.found.solution.apply(run.problem))
    texts = []
    for i, name in enumerate(names):
        chosen = free[:, i]
        if chosen.any():
            texts.append(f"{name} {np.median(before[chosen, i]):.6g} -> {np.median(after[chosen, i]):.6g}")
    if not texts:
        return "all fixed"
    return ("" if run.problem.num_cameras == 1 else "medians: ") + ", ".join(texts)


def batch_summary(told: dict[str, Any]) -> str:
    """Return in words what became of all files."""
    entries, num_files = told["files"], told["num_files"]
    by_state = {state: [e for e in entries if e["state"] == state] for state in ("solved", "done already", "failed")}
    states = [f"{len(of_state)} {state}" for state, of_state in by_state.items() if of_state]
    left, passed_over = num_files - len(entries), len(told["passed_over"])
    there = [entry for entry in entries if "error" not in entry]
    not_converged = [f"{entry['input']} ({entry['result']})" for entry in there if not entry["converged"]]
    solved = by_state["solved"]
    medians = [entry["median_error_px"] for entry in solved]
    notes = {
        name: [f"{entry['input']}: {text}" for entry in solved for text in entry[name]] for name in ("hints", "dropped")
    }
    outputs = [entry["output"] for entry in there]
    return table(
        (
            ("files", f"{num_files}: {', '.join([*states, *([f'{left} left'] if left else [])])}"),
            ("passed over", f"{many(passed_over, 'result')} of other files" if passed_over else []),
            ("converged", f"{len(there) - len(not_converged)} of {len(there)}" if there else []),
            ("not", first_of(not_converged, _MOST_FILES) if not_converged else []),
            ("failed", first_of([entry["input"] for entry in by_state["failed"]], _MOST_FILES) or []),
            ("look at", _first(notes["hints"])),
            ("left out", _first(notes["dropped"])),
            ("errors", f"medians of {min(medians):.3f} to {max(medians):.3f} px" if medians else []),
            ("seconds", f"{told['seconds_total']:.1f}"),
            ("written", first_of(outputs, 2) if outputs else []),
        )
    )


def _first(texts: Sequence[str]) -> list[str]:
    more = [f"... {len(texts) - _MOST_FILES} more (--json has all)"] if len(texts) > _MOST_FILES else []
    return [*texts[:_MOST_FILES], *more]
