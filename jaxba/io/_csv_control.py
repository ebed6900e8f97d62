"""Control and check points as CSV: a line a point, surveyed and adjusted coordinates, residuals and sigmas.

Coordinates have four decimals of the CRS's unit, and residuals in the grid are the differences of what is written. What
is not known is empty, with the reason in the last column.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._atomic import write_atomically

if TYPE_CHECKING:
    from pandas import DataFrame
else:
    DataFrame = Any

CONTROL_COLUMNS = {
    "name": "name of the point in the list",
    "role": "control, or check: compared only",
    "marks": "marks of the point that are used",
    "surveyed_x": "surveyed coordinate, east, in the unit of the CRS; empty where it was not measured",
    "surveyed_y": "surveyed coordinate, north, in the unit of the CRS; empty where it was not measured",
    "surveyed_z": "surveyed height, in the height's unit; empty where it was not measured",
    "adjusted_x": "coordinate of the point in the block, east, in the unit of the CRS",
    "adjusted_y": "coordinate of the point in the block, north, in the unit of the CRS",
    "adjusted_z": "height of the point in the block, in the height's unit",
    "residual_x": "adjusted_x minus surveyed_x, along the grid, in the unit of the CRS",
    "residual_y": "adjusted_y minus surveyed_y, along the grid, in the unit of the CRS",
    "residual_z": "adjusted_z minus surveyed_z, in the height's unit",
    "residual_true_east_m": "adjusted minus surveyed along true east, metres on the ground",
    "residual_true_north_m": "adjusted minus surveyed along true north, metres on the ground",
    "residual_true_up_m": "adjusted minus surveyed up, metres",
    "std_east_m": "sigma of the adjusted point along true east, metres",
    "std_north_m": "sigma of the adjusted point along true north, metres",
    "std_up_m": "sigma of the adjusted point up, metres",
    "mark_rms_px": "RMS of the marks' reprojection errors, pixels",
    "over_sigma": "largest of the three differences between survey and all else, over its sigma",
    "suspect": "yes where it is larger than chance makes it",
    "set_aside": "axes along which the survey contradicts all else and does not hold the block",
    "without_east_m": "where all else places a control point, minus the survey, along true east, metres",
    "without_north_m": "the same along true north",
    "without_up_m": "the same of heights",
    "detectable_east_m": "smallest error of the survey that a test of 0.1% finds in four of five cases, metres",
    "detectable_north_m": "the same along true north; inf where nothing checks it",
    "detectable_up_m": "the same of heights",
    "reach_m": "by how much an error of that size moves the point, the largest of the three axes, metres",
    "reason": "why cells of the row are empty",
}
_DECIMALS = 4
_DECIMALS_OF = {
    **{"mark_rms_px": 2, "over_sigma": 1, "reach_m": 3},
    **dict.fromkeys(("detectable_east_m", "detectable_north_m", "detectable_up_m"), 3),
}
_AXES = ("east", "north", "up")


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlTable:
    """Rows of the file; NaN where nothing is known.

    - `surveyed`, `adjusted`: in the target CRS. `residual_m`: adjusted minus surveyed, local east, north, up.
    - `std_m`: of the adjusted point. `over_sigma`: largest difference over its sigma. `is_suspect`: beyond the limit.
    - `is_set_aside`, `without_m`, `detectable_m`, `reach_m`: see `ControlFit`.
    - `reasons`: why something is not known of a point, else empty.
    """

    names: Sequence[str]
    is_check: Bool[np.ndarray, " points"]
    num_marks: Int[np.ndarray, " points"]
    surveyed: Float[np.ndarray, "points 3"]
    adjusted: Float[np.ndarray, "points 3"]
    residual_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points 3"]
    mark_rms_px: Float[np.ndarray, " points"]
    over_sigma: Float[np.ndarray, " points"]
    is_suspect: Bool[np.ndarray, " points"]
    is_set_aside: Bool[np.ndarray, "points 3"]
    without_m: Float[np.ndarray, "points 3"]
    detectable_m: Float[np.ndarray, "points 3"]
    reach_m: Float[np.ndarray, "points 3"]
    reasons: Sequence[str]


def control_frame(table: ControlTable) -> DataFrame:
    """Return the points of a table as `control.csv` has them; NaN for an empty cell, coordinates as written."""
    import pandas as pd

    # of what is written, so that readers who subtract it find the same
    surveyed, adjusted = np.round(table.surveyed, _DECIMALS), np.round(table.adjusted, _DECIMALS)
    reach_m = np.where(np.isfinite(table.reach_m), table.reach_m, -np.inf).max(axis=1, initial=-np.inf)
    aside = [" ".join(axis for axis, is_so in zip(_AXES, row, strict=True) if is_so) for row in table.is_set_aside]
    columns = (
        list(table.names),
        np.where(table.is_check, "check", "control"),
        table.num_marks,
        *surveyed.T,
        *adjusted.T,
        *np.round(adjusted - surveyed, _DECIMALS).T,
        *table.residual_m.T,
        *table.std_m.T,
        table.mark_rms_px,
        table.over_sigma,
        np.where(table.is_suspect, "yes", "no"),
        aside,
        *table.without_m.T,
        *table.detectable_m.T,
        np.where(np.isfinite(reach_m), reach_m, np.nan),
        list(table.reasons),
    )
    return pd.DataFrame(dict(zip(CONTROL_COLUMNS, columns, strict=True)))


def write_csv_control(path: str | os.PathLike[str], table: ControlTable) -> None:
    """Write the points of a table, whole or not at all.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "control.csv")
    >>> one, row = np.ones(1), np.array([[1.0, 2.0, np.nan]])
    >>> write_csv_control(path, ControlTable(names=["a"], is_check=one > 2, num_marks=one.astype(int), surveyed=row,
    ...     adjusted=row, residual_m=row, std_m=row, mark_rms_px=one, over_sigma=one, is_suspect=one > 2,
    ...     is_set_aside=row > 9, without_m=row, detectable_m=row, reach_m=row, reasons=["no surveyed height"]))
    >>> print(path.read_text().splitlines()[1][:68])
    a,control,1,1.0000,2.0000,,1.0000,2.0000,,0.0000,0.0000,,1.0000,2.0000
    """
    lines = [",".join(CONTROL_COLUMNS)]
    for row in control_frame(table).itertuples(index=False):
        lines.append(",".join(_text(name, value) for name, value in zip(CONTROL_COLUMNS, row, strict=True)))
    with write_atomically(path) as file:
        file.write("\n".join([*lines, ""]).encode())


def _text(name: str, value: Any) -> str:
    """Return a cell of a column."""
    if isinstance(value, str):
        # csv's writer leaves blanks and semicolons bare, and spreadsheets split at them when they are told to
        return _quoted(value, ',"; ' if name == "name" else ',"')
    if name == "marks":
        return str(value)
    if name.startswith("detectable") and value == np.inf:
        return "inf"
    return _cell(value, _DECIMALS_OF.get(name, _DECIMALS))


def _cell(value: float, decimals: int) -> str:
    return f"{value + 0.0:.{decimals}f}" if np.isfinite(value) else ""


def _quoted(text: str, special: str) -> str:
    return '"' + text.replace('"', '""') + '"' if set(text) & set(special) else text
