"""Tables of an adjustment's statistics, for pandas: a row a measurement, units in the names of columns.

    observations: image, point, x_px, y_px, std_px, residual_x_px, ..., redundancy_x, ..., test_x, ..., row_test,
                  p_value, detectable_x_px, ..., reach_x_m, ..., weight

and so for every prior, whose first columns say what each row is about. What the other columns mean stands at the fields
of `RowStatistics`.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._reliability import RowStatistics

if TYPE_CHECKING:
    from pandas import DataFrame

    from jaxba.ba._variance_components import VarianceComponent
else:
    DataFrame = Any

_UNIT = {"std_m": "_m", "std_rad": "_rad"}  # by the field of a prior's sigmas


def observations_table(problem: Problem, rows: RowStatistics) -> DataFrame:
    """Return a row for each observation."""
    seen = problem.observations
    about = {
        "image": _images(problem, seen.image_index),
        "point": np.asarray(seen.point_index),
        "x_px": np.asarray(seen.xy_px)[:, 0],
        "y_px": np.asarray(seen.xy_px)[:, 1],
    }
    return _table(about, rows, ("x", "y"), "_px")


def prior_table(problem: Problem, prior: AbstractPrior, rows: RowStatistics) -> DataFrame:
    """Return a row for each row of a prior."""
    about: dict[str, Any] = {}
    for kind in ("image", "point", "camera"):
        index = getattr(prior, f"{kind}_index", None)
        if index is not None:
            about[kind] = _images(problem, index) if kind == "image" else np.asarray(index)
    components = rows.std.shape[1]
    names = type(problem.cameras).parameter_names()
    axes = names if components == len(names) and hasattr(prior, "parameters") else ("x", "y", "z")
    unit = next((unit for field, unit in _UNIT.items() if hasattr(prior, field)), "")
    return _table(about, rows, axes if components > 1 else ("",), unit)


def components_table(components: "tuple[VarianceComponent, ...]") -> DataFrame:
    """Return a row for each variance component."""
    import pandas as pd

    names = ("name", "count", "redundancy", "factor", "factor_std", "stated_std", "std", "is_known")
    return pd.DataFrame([{name: getattr(component, name) for name in names} for component in components])


def _images(problem: Problem, index: Any) -> np.ndarray:
    """Return the images' names, their numbers where they have none."""
    index = np.asarray(index)
    return np.array(problem.image_names)[index] if problem.image_names else index


def _table(about: dict[str, Any], rows: RowStatistics, axes: tuple[str, ...], unit: str) -> DataFrame:
    import pandas as pd  # 0.3 s

    columns = dict(about)
    for name, values, unit_of in (
        ("std", rows.std, unit),
        ("residual", rows.residual, unit),
        ("without", rows.without, unit),
        ("redundancy", rows.redundancy, ""),
        ("test", rows.test, ""),
        ("detectable", rows.detectable, unit),
        ("reach", rows.reach_m, "_m"),
    ):
        columns |= {f"{name}{f'_{axis}' if axis else ''}{unit_of}": values[:, k] for k, axis in enumerate(axes)}
    columns |= {"row_test": rows.row_test, "freedom": rows.freedom, "p_value": rows.p_value, "weight": rows.weight}
    return pd.DataFrame(columns)
