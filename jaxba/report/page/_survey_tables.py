"""Tables of GNSS positions, attitudes, control and check points, scale bars, variance components and accuracy."""

from typing import Any

from jaxba.report.page._drawing import short_unit
from jaxba.report.page._photo_tables import sigma_of
from jaxba.report.page._tables import AXIS_NAMES, Column, Table, along, number, state, table, text


def sigma_blocks(found: dict[str, Any]) -> list[Table | str]:
    """Return what the sigmas of cameras and points are of, their medians, and the absolute accuracy."""
    rows = [
        [f"{sigma_of(found)} of a {what}, median", *found[key]]
        for what, key in (("camera", "camera_m"), ("point", "point_m"))
    ]
    rows.append(["absolute accuracy of a point", *(found["absolute_m"] or ["not known"] * 3)])
    told = f"Absolute accuracy: {found['absolute_text']}"
    return [found["text"], table("Sigmas and absolute accuracy", [text("figure"), *along("")], rows, note=told)]


def position_tables(found: dict[str, Any]) -> list[Table]:
    """Return the differences from the GNSS positions along each axis, and the offset of each flight."""
    keys = {
        "mean_m": "mean", "rms_m": "RMS", "stated_m": "sigma as stated", "taken_m": "sigma as used",
        "common_m": "offset in common", "common_std_m": "its sigma",
    }  # fmt: skip
    known = {name: found[key] or ["not determined"] * 3 for key, name in keys.items()}
    for name in ("offset in common", "its sigma"):
        known[name] = ["not determined" if value is None else value for value in known[name]]
    apart = [
        f"{count:,} {what}"
        for count, what in (
            (found["num_let_go"], "that contradict the block were let go of"),
            (found["num_left_out"], "took no part"),
        )
        if count
    ]
    tables = [
        table(
            f"{found['num']:,} GNSS positions, adjusted minus measured",
            [text("axis"), *(Column(name=name, unit="m") for name in known)],
            [[axis, *(values[k] for values in known.values())] for k, axis in enumerate(AXIS_NAMES)],
            note="The sigma as stated is that of photos, lists or parameters; the sigma as used is what the adjustment "
            f"weighed positions with.{' Beside these, ' + ', and '.join(apart) + '.' if apart else ''}",
        )
    ]
    if found["flights"]:
        rows = [[row["number"], row["num_photos"], *row["offset_m"], *row["std_m"]] for row in found["flights"]]
        columns = [Column(name="flight"), Column(name="photos"), *along("offset in common"), *along("sigma")]
        note = "What the GNSS positions of a flight have in common: adjusted minus measured."
        tables.append(table("Offset of each flight", columns, rows, note=note))
    return tables


def attitude_table(found: dict[str, Any]) -> Table:
    """Return the differences from the recorded attitudes."""
    columns = [text("angle"), *(Column(name=name, unit="°") for name in ("mean direction", "circular spread"))]
    rows = zip(found["names"], found["mean_deg"], found["spread_deg"], strict=True)
    bad = found["contradict"]
    told = f" {len(bad):,} of them contradict the block, which the findings name." if bad else ""
    return table(
        f"{found['num']:,} attitudes, adjusted minus measured", columns, rows, digits=2,
        note="Attitudes take part as weak measurements: those of a flight err alike, so that all together count as "
        f"one, and those that contradict the block hardly count.{told}",
    )  # fmt: skip


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
        [point["name"], point["role"], *(number(value, 2) for value in point["redundancy"]), *point["without_m"],
         *map(_detectable, point["detectable_m"]), *map(_detectable, point["reach_m"])]
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
             *along("adjusted - surveyed"), *along("sigma adjusted"),
             *along("sigma of survey"),
             Column(name="off by", unit="sigmas"), text("remark")],
            differences, is_wide=True, digits=3,
            note="Adjusted minus surveyed place. A point that is off by more than 3 sigmas deserves a look at its "
            "marks and at its survey.",
        ),
        table(
            "Reliability of control points",
            [*role, *along("redundancy number", ""), *along("residual without the point"),
             *along("internal reliability"), *along("external reliability")],
            reliability, is_wide=True,
            note="Redundancy number: the share of an error of the survey that shows, 0 to 1. Internal reliability: the "
            "minimal detectable error; smaller ones stay hidden. External reliability: how far an error of that size "
            "moves the point. “Unchecked” means that nothing else checks the point, so that any error stays hidden.",
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
    """Return the kinds of measurements with the sigmas that the block itself gives them."""
    columns = [
        text("measurements"), Column(name="components"), Column(name="redundancy"), text("unit"),
        Column(name="sigma as stated"), Column(name="sigma as used"), Column(name="sigma found"),
        Column(name="its own sigma", unit="%"), text("reliable"),
    ]  # fmt: skip
    rows = [
        [kind["name"], kind["count"], number(kind["redundancy"], 1), kind["unit"], kind["taken_std"],
         kind["weighed_std"], kind["std"], _percent(kind["std_share"]), _reliable(kind["is_known"])]
        for kind in found["kinds"]
    ]  # fmt: skip
    return table(
        "Sigmas of the measurements",
        columns,
        rows,
        note="Nothing states the sigma of tie points: the one that was used is estimated from their errors. Assumed "
        "beforehand are weak values of the cameras' intrinsics and of offsets in common, which count as measurements "
        "do, so that all rows sum up to the redundancy. Attitudes of a flight err alike, so that the sigma as used is "
        "that of one times the root of their number. The sigma that was found is reliable where the redundancy is "
        "large enough.",
    )


def _reliable(is_known: bool | None) -> str:
    return "" if is_known is None else "yes" if is_known else "no, too few"


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
