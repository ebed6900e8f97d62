"""The sections of the page after its opening: what each shows, in order, or why it shows nothing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from jaxba.report.page._audit_tables import audit_blocks
from jaxba.report.page._cloud_views import in_space, preview
from jaxba.report.page._drawing import Figure
from jaxba.report.page._error_charts import correlation, histogram, radial_profile, sensor_field
from jaxba.report.page._match_graph import match_graph
from jaxba.report.page._photo_maps import overlap_map, residual_map, sigma_map
from jaxba.report.page._photo_tables import camera_table, left_out_table, photo_table
from jaxba.report.page._processing_tables import hash_table, parameter_table, stage_table, version_table
from jaxba.report.page._survey_charts import control_chart, control_map, positions_chart
from jaxba.report.page._survey_tables import (
    accuracy_table,
    attitude_table,
    bar_table,
    control_tables,
    position_tables,
    sigma_blocks,
    statistics_table,
)  # fmt: skip
from jaxba.report.page._tables import Table, number

Block = Figure | Table | str
"""A figure, a table, or a paragraph."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A section of the page.

    - `name`: in the page's addresses. `title`: above it. `none`: why there is nothing to show, or None.
    - `blocks`: what it shows, in order.
    """

    name: str
    title: str
    none: str | None
    blocks: Sequence[Block]

    @property
    def is_wide(self) -> bool:
        """Return whether it is printed on pages that lie on their side, heading and all."""
        return bool(self.blocks) and all(isinstance(block, Table) and block.is_wide for block in self.blocks)


def sections(report: dict[str, Any]) -> list[Section]:
    """Return the sections in the order of the page."""
    residuals, accuracy = report["residuals"], report["accuracy"]
    no_photos = None if report["photos"] else "There are no photos."
    no_points = _none(report["cloud"], "x", "There are no points.")
    sigmas, matches = sigma_map(report), match_graph(report)
    audit = [_section("audit", "Audit of the model", None, *audit_blocks(report))] if "audit" in report else []
    return [
        *audit,
        _section("preview", "The block from above", no_points, preview(report)),
        _section(
            "positions-map", "Cameras and their accuracy",
            no_photos or (None if sigmas else "No photo has a place, neither by GNSS nor by the adjustment."),
            *_of(report["sigmas"], sigma_blocks), sigmas, residual_map(report),
        ),
        _section("overlap", "Overlap", _none(report["overlap"], "rows", "No photo sees the ground."),
                 overlap_map(report)),
        _section(
            "matches", "Matches between photos",
            None if matches else _no_matches(report),
            matches, _told_pairs(report) if matches else None,
        ),
        _section("space", "The block in three dimensions", no_points, in_space(report)),
        _section(
            "residuals", "Reprojection errors", _none(residuals),
            *(draw(report, one) for one in residuals.get("sensors", ()) for draw in (sensor_field, radial_profile)),
            histogram(report),
        ),
        _section(
            "cameras", "Camera calibration", None if report["cameras"] else "No camera was adjusted.",
            *(camera_table(k, camera) for k, camera in enumerate(report["cameras"])),
            *_or_reason(report["correlation"], correlation(report)),
        ),
        _section(
            "positions", "GNSS positions", _none(report["positions"]),
            *_of(report["positions"], position_tables), positions_chart(report),
        ),
        _section("attitudes", "Attitudes", _none(report["attitudes"]), *_of(report["attitudes"], attitude_table)),
        _section("control", "Control and check points", _none(report["control"]), *_control(report)),
        _section("bars", "Scale bars", _none(report["bars"], "bars", "There are no scale bars."),
                 *_of(report["bars"], bar_table)),
        _section("statistics", "Variance components", _none(report["statistics"]),
                 *_of(report["statistics"], _statistics)),
        _section("accuracy", "Accuracy by check points", _none(accuracy), *_of(accuracy, _accuracy)),
        _section("photos", "Photos", no_photos, photo_table(report)),
        _section(
            "left-out", "What was left out", None if report["left_out"] else "Nothing was left out.",
            left_out_table(report),
        ),
        _section("processing", "Processing", None, *_processing(report["processing"])),
    ]  # fmt: skip


def _section(name: str, title: str, none: str | None, *blocks: Block | None) -> Section:
    shown = [] if none is not None else [block for block in blocks if block]
    return Section(name=name, title=title, none=none, blocks=shown)


def _none(found: dict[str, Any], key: str = "", empty: str = "") -> str | None:
    """Return why a part of the report has nothing to show; None where it has."""
    if "none" in found:
        return found["none"]
    return empty if key and not found[key] else None


def _of(found: dict[str, Any], blocks: Any) -> Iterable[Block]:
    """Return what a function makes of a part of the report; nothing where that has no data."""
    made = [] if "none" in found else blocks(found)
    return [made] if isinstance(made, Table) else made


def _or_reason(found: dict[str, Any], figure: Figure | None) -> Iterable[Block]:
    """Return a figure, or the reason why there is none."""
    if figure is not None:
        return [figure]
    return [f"Correlations: {found['none']}"] if "none" in found else []


def _no_matches(report: dict[str, Any]) -> str:
    if "audit" in report:
        return "The files of a model hold points and their observations, and no matches between photos."
    return _none(report["pairs"]) or "No photos that have a place were matched with each other."


def _told_pairs(report: dict[str, Any]) -> str:
    """Return how many pairs there are of each state."""
    states = report["pairs"]["state"]
    counts = [(state, states.count(state)) for state in ("good", "weak", "rejected", "pruned")]
    return f"Of {len(states):,} pairs of photos: " + ", ".join(f"{count:,} {state}" for state, count in counts) + "."


def _control(report: dict[str, Any]) -> Iterable[Block | None]:
    found = report["control"]
    if "none" in found:
        return []
    how = _METHODS.get(found["method"], found["method"]) if found["num_control"] else ""
    told = f"{found['num_control']:,} control and {found['num_check']:,} check points. {how}".strip()
    first, *others = control_tables(report)
    shown = [one for one in others if one.rows]  # check points have no reliability
    return [told, first, control_map(report), control_chart(report), *shown]


_METHODS = {
    "adjust": "Control points took part in the adjustment as measurements with their sigmas.",
    "helmert": "The adjusted block was fitted to the control points by a similarity of seven parameters.",
    "affine": "The adjusted block was fitted to the control points by an affine map of twelve parameters.",
    "none": "Control points were not used to place the block.",
}


def _statistics(found: dict[str, Any]) -> list[Block]:
    factor = found["variance_factor"]
    return [
        f"Redundancy of the whole adjustment: {number(found['redundancy'], 0)}. Variance factor: {number(factor, 2)}. "
        "A sigma that was found well above the sigma that was stated says that these measurements are worse than they "
        "were taken to be.",
        statistics_table(found),
    ]


def _accuracy(found: dict[str, Any]) -> list[Block]:
    blunders = found["blunders"]
    told = [f"Off by more than three times the target: {', '.join(blunders)}."] if blunders else []
    return [found["text"], *told, accuracy_table(found)]


def _processing(found: dict[str, Any]) -> list[Block]:
    return [
        stage_table(found["stages"]), parameter_table(found["parameters"]), version_table(found["versions"]),
        hash_table("Input files", found["inputs"]), hash_table("Output files", found["outputs"]),
    ]  # fmt: skip
