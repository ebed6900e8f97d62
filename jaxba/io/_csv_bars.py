"""Scale bars as CSV: a line a bar, its measured and its adjusted length, with sigmas and what became of it."""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jaxba._atomic import write_atomically

if TYPE_CHECKING:
    from pandas import DataFrame
else:
    DataFrame = Any

BAR_RESULT_COLUMNS = {
    "first": "name of the point at one end",
    "second": "name of the point at the other end",
    "role": "control, or check: compared only",
    "length_m": "measured length, metres",
    "std_m": "its sigma, metres",
    "adjusted_m": "distance between the ends in the block, metres; empty where an end has no place",
    "adjusted_std_m": "its sigma, metres; empty where it was not computed",
    "residual_m": "adjusted minus measured, metres",
    "over_sigma": "what the block says without the bar minus its length, over the sigma of that difference",
    "used": "yes where the bar took part in the adjustment",
    "set_aside": "yes where it contradicts all else and takes no part",
}
_DECIMALS = {"over_sigma": 1}
_USUAL = 4


def bars_frame(rows: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return scale bars as `bars.csv` has them; `rows` as of `write_csv_bars`."""
    import pandas as pd

    return pd.DataFrame([[row[name] for name in BAR_RESULT_COLUMNS] for row in rows], columns=list(BAR_RESULT_COLUMNS))


def write_csv_bars(path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write scale bars, whole or not at all.

    - `rows`: a mapping a bar, with the names of `BAR_RESULT_COLUMNS`; NaN where a number is not known.
    """
    lines = [",".join(BAR_RESULT_COLUMNS)]
    for row in bars_frame(rows).itertuples(index=False):
        cells = zip(BAR_RESULT_COLUMNS, row, strict=True)
        lines.append(",".join(_cell(value, _DECIMALS.get(name, _USUAL)) for name, value in cells))
    with write_atomically(path) as file:
        file.write("\n".join([*lines, ""]).encode())


def _cell(value: Any, decimals: int) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return '"' + value.replace('"', '""') + '"' if set(value) & set(',"; ') else value
    return f"{value + 0.0:.{decimals}f}" if value == value else ""
