"""What `jaxba solve --statistics` tells: whether sigmas are true, what contradicts, what depends on what."""

from typing import Any

import numpy as np

from jaxba.ba import Reweighted, RowStatistics, Statistics
from jaxba.cli._text import first_of

_SHOWN = 6
_CORRELATED = 0.8
_LIMIT = 3.29  # sigmas: one of a thousand by chance


def statistics_facts(found: Statistics | str) -> dict[str, Any]:
    """Return the statistics by name, or why there are none, for `--json`."""
    if isinstance(found, str):
        return {"why_not": found}
    covariance = found.covariance
    groups = (found.observations, *found.priors)
    return {
        "variance_factor": covariance.variance_factor,
        "redundancy": covariance.redundancy,
        "p_value": found.p_value,
        "components": found.components_frame().to_dict("records"),
        "tests": {rows.name: _tests(rows) for rows in groups},
        "largest": [
            {"group": rows.name, "row": row, "test": test, "p_value": float(rows.p_value[row])}
            for rows, row, test in _largest(groups)
        ],
        "unknowns": list(covariance.border_names),
        "std": np.sqrt(np.diagonal(covariance.border)),
        "correlation": covariance.correlation,
    }


def statistics_rows(found: Statistics | str) -> list[tuple[str, list[str]]]:
    """Return the rows of the summary in words."""
    if isinstance(found, str):
        return [("sigmas", [f"There are none. {found}"])]
    covariance = found.covariance
    groups = (found.observations, *found.priors)
    judged = f"variance factor {covariance.variance_factor:.3f}, redundancy {covariance.redundancy}"
    if np.isfinite(found.p_value):
        judged += f"; chance makes it so in {found.p_value:.1%} of surveys whose sigmas are true"
    components = [_component_text(component) for component in found.components]
    tests = []
    for rows in groups:
        told = _tests(rows)
        if told["num"]:
            tests.append(
                f"{rows.name}: {told['num_over']} of {told['num']} over {_LIMIT} sigmas ({told['expected']:.1f} by "
                f"chance); median redundancy {told['median_redundancy']:.2f}"
            )
    named = [f"{_label(found, rows, row)} {test:.1f} sigmas" for rows, row, test in _largest(groups)]
    pairs = _correlated(found)
    return [
        ("sigmas", [judged, *components]),
        ("tests", [*tests, *([f"largest: {first_of(named, _SHOWN)}"] if named else [])]),
        ("correlated", [first_of(pairs, _SHOWN)] if pairs else []),
    ]


def weights_facts(found: Reweighted) -> dict[str, Any]:
    """Return the estimated sigmas by kind, for `--json`."""
    return {"times": found.times, "std": _stds(found), "at_limit": list(found.at_limit), "settled": found.is_settled}


def weights_rows(found: Reweighted) -> list[tuple[str, list[str]]]:
    """Return the row of the summary in words."""
    texts = []
    for component in found.statistics.components:
        if not component.is_known:
            texts.append(f"{component.name}: kept, its redundancy is {component.redundancy:.1f}")
            continue
        share = component.factor_std / (2 * max(component.factor, 1e-12))
        text = f"{component.name}: {_stds(found)[component.name]:.3g} +- {share:.0%}"
        text += f", {found.times[component.name]:.2f} times what was stated"
        texts.append(text + (", the most that is allowed" if component.name in found.at_limit else ""))
    if not found.is_settled:
        texts.append(f"still changing after {len(found.solutions)} rounds")
    return [("estimated", texts)]


def _stds(found: Reweighted) -> dict[str, float]:
    """Return the sigma that each kind was solved with, in its own unit."""
    return {component.name: component.stated_std for component in found.statistics.components}


def _component_text(component: Any) -> str:
    if not component.is_known:
        return f"{component.name}: too little redundancy ({component.redundancy:.1f}) to tell its sigmas"
    times, std = np.sqrt(component.factor), component.factor_std / (2 * np.sqrt(max(component.factor, 1e-12)))
    scatter = f"scatter by {times:.2f} +- {std:.2f} times their sigmas"
    return f"{component.name}: {scatter}, redundancy {component.redundancy:.0f}"


def _tests(rows: RowStatistics) -> dict[str, Any]:
    tested = np.isfinite(rows.test)
    num = int(tested.sum())
    return {
        "num": num,
        "num_over": int(np.count_nonzero(np.abs(rows.test[tested]) > _LIMIT)),
        "expected": 0.001 * num,
        "median_redundancy": float(np.median(rows.redundancy[tested])) if num else None,
    }


def _largest(groups: tuple[RowStatistics, ...]) -> list[tuple[RowStatistics, int, float]]:
    """Return the rows with the largest tests over the limit, the largest first."""
    found = []
    for rows in groups:
        test = np.abs(rows.test)
        largest = np.max(np.where(np.isfinite(test), test, 0.0), axis=1, initial=0.0)
        for row in np.argsort(-largest, kind="stable")[:_SHOWN]:
            if largest[row] > _LIMIT:
                found.append((rows, int(row), float(largest[row])))
    return sorted(found, key=lambda entry: -entry[2])[:_SHOWN]


def _label(found: Statistics, rows: RowStatistics, row: int) -> str:
    """Name what a row measured."""
    problem = found.problem
    if rows.name == "observations":
        seen = problem.observations
        return f"point {seen.point_index[row]} in {problem.image_label(int(seen.image_index[row]))}"
    prior = problem.prior(rows.name)
    if hasattr(prior, "image_index"):
        return f"{rows.name} of {problem.image_label(int(prior.image_index[row]))}"  # type: ignore[union-attr]
    if rows.name == "scale_bar":
        one, other = np.asarray(prior.point_index)[2 * row : 2 * row + 2]  # type: ignore[union-attr]
        return f"scale bar of points {one} and {other}"
    if hasattr(prior, "point_index"):
        return f"{rows.name} of point {prior.point_index[row]}"  # type: ignore[union-attr]
    return f"{rows.name} {row}"


def _correlated(found: Statistics) -> list[str]:
    """Return the pairs of shared unknowns that are strongly correlated, the strongest first."""
    names, correlation = found.covariance.border_names, np.nan_to_num(found.covariance.correlation)
    first, second = np.nonzero(np.triu(np.abs(correlation) >= _CORRELATED, 1))
    strongest = np.argsort(-np.abs(correlation[first, second]), kind="stable")
    single = all(name.startswith(("camera 0 ", "lever", "position")) for name in names)
    short = [name.removeprefix("camera 0 ") if single else name for name in names]
    return [f"{short[first[k]]} and {short[second[k]]} {correlation[first[k], second[k]]:+.2f}" for k in strongest]
