"""Control and check points as CSV: a line a point, surveyed and adjusted coordinates, residuals and sigmas.

Coordinates have four decimals of the CRS's unit; what is not known is empty.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.io._atomic import write_atomically

CONTROL_COLUMNS = (
    "name", "role", "marks", "surveyed_x", "surveyed_y", "surveyed_z", "adjusted_x", "adjusted_y", "adjusted_z",
    "residual_east_m", "residual_north_m", "residual_up_m", "std_east_m", "std_north_m", "std_up_m", "mark_rms_px",
    "over_sigma", "suspect",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlTable:
    """Rows of the file; NaN where nothing is known.

    - `surveyed`, `adjusted`: in the target CRS. `residual_m`: adjusted minus surveyed, local east, north, up.
    - `std_m`: of the adjusted point. `over_sigma`: largest difference over its sigma. `is_suspect`: beyond the limit.
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


def write_csv_control(path: str | os.PathLike[str], table: ControlTable) -> None:
    """Write the points of a table, whole or not at all.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "control.csv")
    >>> one, row = np.ones(1), np.array([[1.0, 2.0, np.nan]])
    >>> write_csv_control(path, ControlTable(names=["a"], is_check=one > 2, num_marks=one.astype(int), surveyed=row,
    ...     adjusted=row, residual_m=row, std_m=row, mark_rms_px=one, over_sigma=one, is_suspect=one > 2))
    >>> print(path.read_text().splitlines()[1])
    a,control,1,1.0000,2.0000,,1.0000,2.0000,,1.0000,2.0000,,1.0000,2.0000,,1.00,1.0,no
    """
    lines = [",".join(CONTROL_COLUMNS)]
    for k, name in enumerate(table.names):
        numbers = [*table.surveyed[k], *table.adjusted[k], *table.residual_m[k], *table.std_m[k]]
        # csv's writer leaves blanks and semicolons bare, and spreadsheets split at them when they are told to
        cells = [
            '"' + name.replace('"', '""') + '"' if set(name) & set(',"; ') else name,
            "check" if table.is_check[k] else "control",
            str(table.num_marks[k]),
            *(_cell(value, 4) for value in numbers),
            _cell(table.mark_rms_px[k], 2),
            _cell(table.over_sigma[k], 1),
            "yes" if table.is_suspect[k] else "no",
        ]
        lines.append(",".join(cells))
    with write_atomically(path) as file:
        file.write("\n".join([*lines, ""]).encode())


def _cell(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else ""
