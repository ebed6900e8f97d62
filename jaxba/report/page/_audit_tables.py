"""The section of an audit: faults, what the files claim beside what is so, and what moved in the new adjustment."""

from typing import Any

from jaxba.report.page._tables import Column, Table, number, table, text

_MOST_OPEN_ROWS = 60


def audit_blocks(report: dict[str, Any]) -> list[Table | str]:
    """Return the section's paragraphs and tables."""
    found = report["audit"]
    return [_told(found), *_faults(found), _claims(found), _of_the_rest(found), _intrinsics(found), _images(report)]


def _told(found: dict[str, Any]) -> str:
    return (
        f"{found['model']}, in the form of {found['program']}. Its residuals were computed anew by that program's own "
        "definition, and the model was adjusted again from its own observations, each weighed by the sigma that the "
        "errors themselves show, wrong ones rejected. All sections after this one are of the new adjustment."
    )


def _faults(found: dict[str, Any]) -> list[Table | str]:
    rows = [[fault["kind"], fault["text"]] for fault in found["faults"]]
    return [table("Faults", [text("fault"), text("figures and limits")], rows)] if rows else ["No fault was found."]


def _claims(found: dict[str, Any]) -> Table:
    columns = [text(name) for name in ("figure", "stated", "computed", "difference", "so", "definition")]
    rows = [
        [
            f"{row['name']} ({row['unit']})" if row["unit"] else row["name"],
            *(_digits(row[key]) for key in ("stated", "recomputed")), _difference(row),
            "" if row["stated"] is None else "no" if row["differs"] else "yes", row["definition"],
        ]
        for row in found["claims"]
    ]  # fmt: skip
    return table(
        "What the files state, and what their own numbers give", columns, rows,
        note="Unknown: the files do not state it. The difference is stated minus computed; it is none where rounding "
        "of the files explains it.",
    )  # fmt: skip


def _digits(value: float | None) -> str:
    if value is None:
        return number(None)
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.6g}"


def _difference(row: dict[str, Any]) -> str:
    """Return stated minus computed; none where it is rounding in float64."""
    if row["difference"] is not None and abs(row["difference"]) <= 1e-12 * abs(row["recomputed"]):
        return "0"
    return _digits(None if row["difference"] is None else float(f"{row['difference']:.3g}"))


def _of_the_rest(found: dict[str, Any]) -> str:
    seen, points, errors = found["observations"], found["points"], found["point_errors"]
    of_points = (
        f"Of {errors['stated']:,} stated errors of points {errors['differing']:,} are not those of their observations "
        f"(largest difference {errors['largest']:.3g} {errors['unit']}). "
        if errors["stated"]
        else ""
    )
    held = f" Held as not calibrated: {', '.join(found['held'])}." if found["held"] else ""
    return (
        f"{of_points}Of {seen['num']:,} observations the new adjustment rejected {seen['rejected']:,}; "
        f"{seen['wrong']:,} miss their points by more than {seen['wrong_limit_px']:.1f} px, and {seen['behind']:,} "
        f"show points behind the camera. Of {points['num']:,} points {points['near_parallel']:,} are seen under "
        f"angles below {points['min_angle_deg']:g} degrees alone.{held}"
    )


def _intrinsics(found: dict[str, Any]) -> Table:
    columns = [
        text("camera"), text("intrinsic"), text("model"), text("adjusted"), text("sigma"), Column(name="over sigma"),
        Column(name="moves by", unit="px"), text("off"),
    ]  # fmt: skip
    rows = [
        [
            row["camera"], row["name"], *(f"{row[key]:.6g}" for key in ("before", "after")), f"{row['std']:.2g}",
            number(row["over_sigma"], 1), number(row["apart_px"], 2), row["off"],
        ]
        for row in found["intrinsics"]
    ]  # fmt: skip
    return table(
        "Intrinsics of the model and of the new adjustment", columns, rows,
        note="Moves by: the farthest that a pixel moves by this change alone.",
    )  # fmt: skip


def _images(report: dict[str, Any]) -> Table:
    found = report["audit"]
    unit = "m" if report["project"]["crs"] else ""
    columns = [
        text("photo"), Column(name="shift", unit=unit), Column(name="turn", unit="°"), Column(name="over sigma"),
        Column(name="points apart", unit="px"), text("off"),
    ]  # fmt: skip
    rows = [
        [
            row["name"], _digits(row["shift"]), number(row["turn_deg"], 3), number(row["over_sigma"], 1),
            number(row["apart_px"], 2), row["off"],
        ]
        for row in found["images"]
    ]  # fmt: skip
    limits = (number(found[key], 1) for key in ("images_limit_sigma", "images_limit_px"))
    return table(
        "Images of the model beside the new adjustment", columns, rows, is_closed=len(rows) > _MOST_OPEN_ROWS,
        note="Behind a similarity over the points of both. An image is off over {} sigmas and {} px; points apart: how "
        "far its points lie apart in the photo, seen from both poses, in the median.".format(*limits),
    )  # fmt: skip
