"""The tables of a report as CSV: a row a photo, pair, point, bar, intrinsic, kind of measurement or parameter.

Columns are the fields of `report.json`; a list has a column an entry, named by its axis. What is not known is empty.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

_EAST_NORTH_UP = "east", "north", "up"
_ENTRIES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("measured", "surveyed", "adjusted"), ("x", "y", "z")),
    **dict.fromkeys(
        ("std_m", "residual_m", "survey_std_m", "without_m", "without_std_m", "redundancy", "detectable_m", "reach_m"),
        _EAST_NORTH_UP,
    ),
    "ellipse_m": ("a_m", "b_m", "azimuth_deg"),
    "omega_phi_kappa_deg": ("omega_deg", "phi_deg", "kappa_deg"),
}
"""What the entries of a list are, by its field."""
_DRAWN = ("outline",)  # of no use in a table
_UNITS = ("_m", "_deg", "_px")


def tables(facts: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of a report's tables by name; a table that has no rows is left out.

    >>> tables({"photos": [{"name": "a.jpg", "std_m": [0.1, 0.2, None]}]})["photos.csv"].decode().splitlines()
    ['name,std_east_m,std_north_m,std_up_m', 'a.jpg,0.1,0.2,']
    """
    names = [photo["name"] for photo in facts.get("photos", ())]
    pairs = _pairs(facts.get("pairs", {}), names)
    intrinsics = [
        {"camera": camera["name"], **parameter}
        for camera in facts.get("cameras", ())
        for parameter in camera["parameters"]
    ]
    processing, audit = facts.get("processing", {}), facts.get("audit", {})
    found = {
        "photos": facts.get("photos", ()),
        "pairs": pairs,
        "intrinsics": intrinsics,
        "control": facts.get("control", {}).get("points", ()),
        "bars": facts.get("bars", {}).get("bars", ()),
        "components": facts.get("statistics", {}).get("kinds", ()),
        "accuracy": facts.get("accuracy", {}).get("rows", ()),
        "left_out": facts.get("left_out", ()),
        "parameters": processing.get("parameters", ()),
        **{f"audit_{name}": audit.get(name, ()) for name in ("claims", "intrinsics", "images")},
    }
    return {f"{name}.csv": _csv(rows) for name, rows in found.items() if rows}


def _pairs(found: Mapping[str, Any], names: Sequence[str]) -> list[dict[str, Any]]:
    if "none" in found or not found:
        return []
    rows = [dict(zip(found, values, strict=True)) for values in zip(*found.values(), strict=True)]
    return [row | {side: names[row[side]] for side in ("first", "second")} for row in rows]


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    flat = [_flat(row) for row in rows]
    columns = list(dict.fromkeys(column for row in flat for column in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return buffer.getvalue().encode()


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if name in _DRAWN:
            continue
        entries = _ENTRIES.get(name)
        if entries is not None and not (name == "redundancy" and not isinstance(value, list)):
            values = value if isinstance(value, list) else [value] * len(entries)
            flat |= {_column(name, entry): _cell(of) for entry, of in zip(entries, values, strict=True)}
        else:
            flat[name] = " ".join(value) if isinstance(value, list) else _cell(value)  # names of axes
    return flat


def _column(name: str, entry: str) -> str:
    """Return `std_east_m` for the entry `east` of `std_m`; entries that have units of their own replace the field's."""
    if entry.endswith(_UNITS):
        return entry if name == "omega_phi_kappa_deg" else f"{name.partition('_')[0]}_{entry}"
    stem, unit = (name[: -len("_m")], "_m") if name.endswith("_m") else (name, "")
    return f"{stem}_{entry}{unit}"


def _cell(value: Any) -> Any:
    return "" if value is None else ("yes" if value else "no") if isinstance(value, bool) else value
