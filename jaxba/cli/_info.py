"""`jaxba info`: what a problem holds, before anything is adjusted."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from jaxba.ba import AbstractPrior, Prepared, Problem, Unknowns, free_gauge, prepare, quality
from jaxba.cli._result import intrinsics, loss_parameters, name_of_loss
from jaxba.cli._text import first_of, gauge_text, many, table, to_json
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.geometry import CAMERAS
from jaxba.io import problem_of_bytes, read_bytes

_BAR = 40  # characters of the longest bar of the histogram
_LONGEST = 12  # tracks of this length and more share the histogram's last line


def run(file: Path, *, as_json: bool) -> int:
    """Print what a file holds; return the exit code."""
    held = problem_of_bytes(read_bytes(file), str(file))
    use_compilation_cache()
    loss = None if held.loss is None else {"name": name_of_loss(held.loss), **loss_parameters(held.loss)}
    found = {"input": str(file), **facts(held.problem), "loss": loss}
    print(to_json(found) if as_json else text(found))
    return 0


def facts(problem: Problem) -> dict[str, Any]:
    """Return everything about a problem at its start values, for `--json`.

    Raises:
        JaxbaError: the problem contradicts itself.
    """
    prepared = prepare(problem)
    free, names = problem.free, type(problem.cameras).parameter_names()
    values, free_intrinsics = intrinsics(problem), np.asarray(free.intrinsics)
    lower, upper = np.asarray(problem.lower), np.asarray(problem.upper)
    seen = problem.observations
    tracks = np.bincount(np.asarray(seen.point_index), minlength=problem.num_points)
    per_image = np.bincount(np.asarray(seen.image_index), minlength=problem.num_images)
    found = quality(problem, ~prepared.dropped.observations)
    return {
        "num_images": problem.num_images,
        "num_cameras": problem.num_cameras,
        "num_points": problem.num_points,
        "num_observations": problem.num_observations,
        "camera_model": next(name for name, model in CAMERAS.items() if isinstance(problem.cameras, model)),
        "intrinsics": {name: values[:, i] for i, name in enumerate(names)},
        "track_lengths": {int(n): int(c) for n, c in enumerate(np.bincount(tracks)) if c},
        "mean_track_length": float(np.mean(tracks[tracks > 0])),
        "observations_per_image": {
            "min": int(per_image.min()), "median": float(np.median(per_image)), "max": int(per_image.max()),
        },
        "components": components(problem),
        "images_without_observations": [image_name(problem, i) for i in np.flatnonzero(per_image == 0)],
        "free_gauge": list(free_gauge(prepared.problem)),
        "free": {
            "poses": int(np.count_nonzero(free.poses)),
            "points": int(np.count_nonzero(free.points)),
            "intrinsics": {name: int(np.count_nonzero(free_intrinsics[:, i])) for i, name in enumerate(names)},
            "lever_arm": bool(free.lever_arm),
            "position_offset": bool(free.position_offset) and len(problem.position_offset) > problem.num_bar_ends,
        },
        "bounds": {
            name: {"lower": float(lower[:, i].min()), "upper": float(upper[:, i].max())}
            for i, name in enumerate(names) if np.isfinite(lower[:, i]).any() or np.isfinite(upper[:, i]).any()
        },
        "priors": [_prior_facts(prior) for prior in problem.priors],
        "initial_costs": initial_costs(prepared),
        "median_error_px": found.median_px,
        "mad_px": found.mad_px,
        "dropped": prepared.dropped.summary(),
    }  # fmt: skip


def components(problem: Problem) -> list[list[str]]:
    """Return the names of the images that hang together through common points, the largest group first."""
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    nodes = problem.num_images + problem.num_points
    edges = sparse.csr_array((np.ones(len(image), np.int8), (image, problem.num_images + point)), shape=(nodes, nodes))
    _, label = connected_components(edges, directed=False)
    seeing = np.unique(image)
    groups = [seeing[label[seeing] == group] for group in np.unique(label[seeing])]
    return [[image_name(problem, i) for i in group] for group in sorted(groups, key=len, reverse=True)]


def image_name(problem: Problem, index: int | np.integer) -> str:
    """Return an image's name, or its number where it has none."""
    return problem.image_names[int(index)] if problem.image_names else str(index)


def initial_costs(prepared: Prepared) -> dict[str, float]:
    """Return the cost of each group at the start values: reprojections without a loss, priors with their own."""
    problem = prepared.problem
    found = quality(problem)
    error = found.error_px / np.asarray(problem.observations.std_px)
    costs = {"reprojection": float(0.5 * np.sum(error**2))}
    with jax.enable_x64(True):
        unknowns = Unknowns(
            poses=jax.tree.map(jnp.asarray, problem.poses),
            intrinsics=jnp.asarray(intrinsics(problem)),
            antenna=jnp.asarray(problem.antenna),
            points=jnp.asarray(problem.points),
        )
        for prior in problem.priors:
            squared = jnp.sum(prior.residual(unknowns) ** 2, axis=0)
            costs[prior.name] = float(0.5 * jnp.sum(prior.loss(squared)))
    return costs


def text(found: dict[str, Any]) -> str:
    """Return the facts in words."""
    sizes = (
        many(found["num_images"], "image"),
        many(found["num_points"], "point"),
        many(found["num_observations"], "observation"),
    )
    per_image, num_cameras = found["observations_per_image"], found["num_cameras"]
    parameters = ", ".join(f"{name} {np.median(value):.6g}" for name, value in found["intrinsics"].items())
    without = found["images_without_observations"]
    return table(
        (
            ("problem", f"{found['input']}: {', '.join(sizes)}"),
            ("cameras", f"{num_cameras} {found['camera_model']}: {'' if num_cameras == 1 else 'medians '}{parameters}"),
            ("an image", f"{per_image['min']} to {per_image['max']} observations, median {per_image['median']:g}"),
            ("unseen", f"{many(len(without), 'image')}: {first_of(without)}" if without else []),
            ("a point", [f"seen in {found['mean_track_length']:.2f} images", *_histogram(found["track_lengths"])]),
            ("connected", _components_text(found["components"])),
            ("gauge", gauge_text(found["free_gauge"])),
            ("free", _free_text(found)),
            ("bounds", [f"{n} {b['lower']:.6g} to {b['upper']:.6g}" for n, b in found["bounds"].items()]),
            ("priors", [_prior_text(prior) for prior in found["priors"]] or "none"),
            ("loss", _loss_text(found["loss"]) if found["loss"] else []),
            ("left out", found["dropped"]),
            ("cost", ", ".join(f"{name} {cost:.6g}" for name, cost in found["initial_costs"].items())),
            ("errors", f"median {found['median_error_px']:.3f} px, MAD {found['mad_px']:.3f} px at the start values"),
        )
    )


def _prior_facts(prior: AbstractPrior) -> dict[str, Any]:
    """Return a prior's rows and the median of the finite sigmas in each column, NaN without any."""
    sigmas = {name: np.asarray(value, float) for name, value in vars(prior).items() if name.startswith("std")}
    rows = len(next(iter(sigmas.values())))
    medians = {
        name: [float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in value.T]
        for name, value in sigmas.items()
    }
    return {"name": prior.name, "rows": rows, "loss": name_of_loss(prior.loss), "median_std": medians}


def _prior_text(prior: dict[str, Any]) -> str:
    sigmas = "; ".join(
        f"median {name} {', '.join('free' if np.isnan(v) else f'{v:.4g}' for v in values)}"
        for name, values in prior["median_std"].items()
    )
    loss = "" if prior["loss"] == "linear" else f" ({prior['loss']} loss)"
    return f"{prior['name']}: {many(prior['rows'], 'row')}, {sigmas}{loss}"


def _loss_text(loss: dict[str, Any]) -> str:
    shape = f", of shape {loss['alpha']:.4g}" if "alpha" in loss else ""
    return f"{loss['name']} of scale {loss['f_scale']:.4g}{shape}, that of the file"


def _free_text(found: dict[str, Any]) -> list[str]:
    free, num_cameras = found["free"], found["num_cameras"]
    intrinsics_free = [
        name if count == num_cameras else f"{name} (of {count} cameras)"
        for name, count in free["intrinsics"].items() if count
    ]  # fmt: skip
    fixed = [name for name, count in free["intrinsics"].items() if not count]
    return [
        f"{free['poses']} of {found['num_images']} poses, {free['points']} of {found['num_points']} points",
        f"intrinsics {', '.join(intrinsics_free) or 'none'}{'; fixed ' + ', '.join(fixed) if fixed else ''}",
        f"lever arm {'free' if free['lever_arm'] else 'fixed'}",
        *(["position offset free"] if free["position_offset"] else []),
    ]


def _components_text(groups: list[list[str]]) -> list[str]:
    if len(groups) == 1:
        return ["all images hang together"]
    parts = [f"{many(len(group), 'image')}: {first_of(group)}" for group in groups[:10]]
    more = [f"... {len(groups) - 10} more"] if len(groups) > 10 else []
    return [f"{len(groups)} parts without common points", *parts, *more]


def _histogram(lengths: dict[int, int]) -> list[str]:
    """Return a line for each track length, those from `_LONGEST` together."""
    counts = {n: c for n, c in lengths.items() if n < _LONGEST}
    longer = sum(c for n, c in lengths.items() if n >= _LONGEST)
    if longer:
        counts[_LONGEST] = longer
    top = max(counts.values())
    return [
        f"{n:>3}{'+' if n == _LONGEST else ' '} {c:>8} {'#' * round(_BAR * c / top)}".rstrip()
        for n, c in counts.items()
    ]
