"""Tables of GNSS positions, attitudes, control and check points, scale bars, variance components and accuracy."""

from typing import Any

from jaxba.report.page._drawing import short_unit
from jaxba.report.page._tables import AXIS_NAMES, Column, Table, along, number, state, table, text


def position_tables(found: dict[str, Any]) -> list[Table]:
    """Return the differences from the GNSS positions along each axis, and the offset of each flight."""
    keys = {
        "mean_m": "mean, adjusted - GNSS", "rms_m": "RMS, adjusted - GNSS", "stated_m": "sigma as stated",
        "taken_m": "sigma as used", "common_m": "common, GNSS - adjusted", "common_std_m": "its sigma",
    }  # fmt: skip
    known = {name: found[key] for key, name in keys.items() if found[key] is not None}
    tables = [
        table(
            f"{found['num']:,} GNSS positions", [text("axis"), *(Column(name=name, unit="m") for name in known)],
            [[axis, *(values[k] for values in known.values())] for k, axis in enumerate(AXIS_NAMES)],
        )
    ]  # fmt: skip
    if found["flights"]:
        rows = [[row["number"], row["num_photos"], *row["offset_m"], *row["std_m"]] for row in found["flights"]]
        columns = [Column(name="flight"), Column(name="photos"), *along("offset"), *along("sigma")]
        tables.append(
            table(
                "Offset of each flight",
                columns,
                rows,
                note="What the GNSS positions of a flight have in common: GNSS minus adjusted.",
            )
        )
    return tables


def attitude_table(found: dict[str, Any]) -> Table:
    """Return the differences from the recorded attitudes."""
    figures = ("mean, adjusted - recorded", "RMS, adjusted - recorded")
    columns = [text("angle"), *(Column(name=name, unit="°") for name in figures)]
    rows = zip(found["names"], found["mean_deg"], found["rms_deg"], strict=True)
    return table(f"{found['num']:,} attitudes", columns, rows, digits=2)


def control_tables(report: dict[str, Any]) -> list[Table]:
    """Return control and check points together, each by itself, what would be noticed at each, and their places."""
    found = report["control"]
    points = found["points"]
    unit, height_unit = (short_unit(report["project"][key]) for key in ("unit", "height_unit"))
    axes = [("east", unit), ("north", unit), ("up", height_unit)]
    differences = [
        [point["name"], point["role"], point["marks"], point["marks_used"], number(point["mark_rms_px"], 2),
         *point["residual_m"], *point["std_m"], *point["survey_std_m"], number(point["over_sigma"], 1), _remark(point)]
        for point in points
    ]  # fmt: skip
    reliability = [
        [point["name"], point["role"], *point["without_m"], *map(_detectable, point["detectable_m"]),
         *map(_detectable, point["reach_m"])]
        for point in points
        if point["role"] == "control"
    ]  # fmt: skip
    places = [[point["name"], point["role"], *point["surveyed"], *point["adjusted"]] for point in points]
    role = [text("point"), text("role")]
    return [
        _control_summary(found),
        table(
            "Differences at each point",
            [*role, Column(name="marks"), Column(name="marks used"), Column(name="RMS of marks", unit="px"),
             *along("adj. - surveyed"), *along("sigma adj."), *along("sigma survey"),
             Column(name="off by", unit="sigmas"), text("remark")],
            differences, is_wide=True, digits=3,
            note="Adjusted minus surveyed place. A point that is off by more than 3 sigmas deserves a look at its "
            "marks and at its survey.",
        ),
        table(
            "Reliability: what would be noticed at each point",
            [*role, *along("without it"), *along("noticed from"), *along("reaches")],
            reliability, is_wide=True,
            note="Without it: how far the point would be off had it taken no part. Noticed from: the smallest error "
            "of its survey that the other observations would show; smaller ones stay hidden. Reaches: how far a "
            "hidden error moves results. “Unchecked” means that nothing else checks the point, so that any error "
            "stays hidden.",
        ),
        table(
            "Coordinates of each point",
            [*role, *(Column(name=f"{of} {name}", unit=its) for of in ("surveyed", "adjusted") for name, its in axes)],
            places, is_closed=True, is_wide=True, digits=3,
        ),
    ]  # fmt: skip


def bar_table(found: dict[str, Any]) -> Table:
    """Return the scale bars."""
    metres = ("length", "its sigma", "adjusted", "sigma adjusted", "difference")
    columns = [text("from"), text("to"), text("role"), *(Column(name=name, unit="m") for name in metres)]
    rows = [
        [row["first"], row["second"], row["role"],
         *(row[key] for key in ("length_m", "std_m", "adjusted_m", "adjusted_std_m", "residual_m")),
         number(row["over_sigma"], 1), "set aside" if row["set_aside"] else "used" if row["used"] else "not used"]
        for row in found["bars"]
    ]  # fmt: skip
    return table("", [*columns, Column(name="off by", unit="sigmas"), text("how")], rows, digits=4)


def statistics_table(found: dict[str, Any]) -> Table:
    """Return the kinds of observations with the sigmas that the block itself gives them."""
    columns = [
        text("measurements"), Column(name="coordinates"), Column(name="redundancy"), text("unit"),
        Column(name="sigma as stated"),
        Column(name="sigma found"), Column(name="its own sigma", unit="%"), text("reliable"),
    ]  # fmt: skip
    rows = [
        [kind["name"], kind["count"], number(kind["redundancy"], 1), kind["unit"], kind["taken_std"], kind["std"],
         _percent(kind["std_share"]), "yes" if kind["is_known"] else "no, too few"]
        for kind in found["kinds"]
    ]  # fmt: skip
    return table(
        "Sigmas of the measurements",
        columns,
        rows,
        note="The sigma that was found is reliable where the redundancy is large enough.",
    )


def accuracy_table(found: dict[str, Any]) -> Table:
    """Return the accuracy of the product as ASPRS (2023) counts it."""
    names = ("RMSE of the fit", "RMSE of the survey", "RMSE of the product", "target")
    columns = [
        text("along"),
        Column(name="check points"),
        *(Column(name=name, unit="m") for name in names),
        state("target met"),
    ]
    rows = [
        [
            row["name"],
            row["num"],
            *(row[key] for key in ("fit_m", "survey_m", "product_m", "target_m")),
            "no target" if row["target_m"] is None else row["state"],
        ]
        for row in found["rows"]
    ]
    return table("", columns, rows, digits=3)


def _control_summary(found: dict[str, Any]) -> Table:
    rows = [
        ("RMS of control points", found["num_control"], found["control_rms_m"]),
        ("RMSE of check points", found["num_check"], found["check_rms_m"]),
        ("mean shift of check points", found["num_check"], found["check_shift_m"]),
        ("sigma of that shift", found["num_check"], found["check_shift_std_m"]),
    ]
    known = [(name, count, *values) for name, count, values in rows if count and values is not None]
    return table("All points together", [text("figure"), Column(name="points"), *along("")], known, digits=3)


def _remark(point: dict[str, Any]) -> str:
    parts = ["suspect"] if point["suspect"] else []
    parts += [f"set aside: {', '.join(point['set_aside'])}"] if point["set_aside"] else []
    return "; ".join(parts)


def _detectable(value: float | str | None) -> float | str | None:
    return "unchecked" if value == "any" else value


def _percent(share: float | None) -> str:
    return number(None) if share is None else f"{100 * share:.2g}" if share < 0.1 else f"{100 * share:,.0f}"
