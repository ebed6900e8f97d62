"""Tables of photos, of cameras, and of what was left out."""

from typing import Any

from jaxba.report.page._drawing import short_unit
from jaxba.report.page._tables import Column, Table, along, digits_for, number, table, text

_MOST_OPEN_ROWS = 60
_UNKNOWN_TRIPLE = (None, None, None)


def photo_table(report: dict[str, Any]) -> Table:
    """Return a row for each photo; it is closed where there are many."""
    photos = report["photos"]
    unit, height_unit = (short_unit(report["project"][key]) for key in ("unit", "height_unit"))
    columns = [
        text("photo"), text("state"), Column(name="camera"),
        Column(name="x", unit=unit), Column(name="y", unit=unit), Column(name="z", unit=height_unit),
        *along(sigma_of(report["sigmas"])), text("GNSS position"),
        *along("adjusted - GNSS"),
        *(Column(name=name, unit="°") for name in ("omega", "phi", "kappa")),
        Column(name="keypoints"), Column(name="tie points"), Column(name="partners"),
        *(Column(name=name, unit="px") for name in ("median error", "RMS error", "max. error")),
        text("why not adjusted"),
    ]  # fmt: skip
    rows = []
    for photo in photos:
        turned = photo["omega_phi_kappa_deg"] or _UNKNOWN_TRIPLE
        rows.append([
            photo["name"], photo["state"], photo["camera"],
            photo["x"], photo["y"], photo["z"], *(photo["std_m"] or _UNKNOWN_TRIPLE), photo["position"],
            *(photo["residual_m"] or _UNKNOWN_TRIPLE), *(number(value, 2) for value in turned),
            photo["keypoints"], photo["observations"], photo["partners"],
            *(number(photo[key], 2) for key in ("median_px", "rms_px", "max_px")), photo["reason"] or "",
        ])  # fmt: skip
    return table(
        f"Every photo ({len(photos):,})", columns, rows, is_wide=True, is_closed=len(photos) > _MOST_OPEN_ROWS,
        note=f"{report['sigmas'].get('text', '')} Tie points are those that take part in the adjustment; partners are "
        "the photos that this one is matched with. A GNSS position that contradicts the block was let go of; one that "
        "was left out took no part.".lstrip(),
    )  # fmt: skip


def sigma_of(found: dict[str, Any]) -> str:
    """Return the heading of a sigma, which says what it is of."""
    scope = found.get("scope", "")
    return "absolute sigma" if scope == "absolute" else f"sigma {scope}".rstrip()


def camera_table(number_in_table: int, camera: dict[str, Any]) -> Table:
    """Return the parameters of a camera with their sigmas.

    - `number_in_table`: by which the table of photos names the camera.
    """
    columns = [
        text("parameter"),
        text("unit"),
        *(Column(name=name) for name in ("by the tags", "adjusted", "change", "sigma")),
        Column(name="change", unit="sigmas"),
        text("how"),
    ]
    rows = [
        [part["name"], part["unit"] or "none", *(_parameter(part, key) for key in ("start", "value", "change", "std")),
         number(part["change_over_sigma"], 1), "held fixed" if part["fixed"] else "adjusted"]
        for part in camera["parameters"]
    ]  # fmt: skip
    size = "" if camera["width_px"] is None else f", {camera['width_px']:,} x {camera['height_px']:,} px"
    photos = "1 photo" if camera["num_photos"] == 1 else f"{camera['num_photos']:,} photos"
    return table(
        f"Camera {number_in_table}, {camera['name']}: {camera['model']}{size}, {photos}",
        columns, rows, note=_by_the_tags(camera["focal_from"]),
    )  # fmt: skip


def _by_the_tags(focal_from: str | None) -> str:
    focal = "the start values, since no tag tells it" if focal_from is None else focal_from
    return (
        f"By the tags: the focal length is from {focal}; the principal point is taken in the middle of the photo, and "
        "the lens without distortion. A large change in sigmas only says that the adjustment knows it better than that."
    )


def left_out_table(report: dict[str, Any]) -> Table:
    """Return what was left out, where, and why."""
    rows = [[row["stage"], row["name"], row["reason"]] for row in report["left_out"]]
    return table("", [text("stage"), text("what"), text("why")], rows)


def _parameter(part: dict[str, Any], key: str) -> str:
    """Return a number with so many digits after the point that two of its sigma's count."""
    if part[key] is None or (key == "std" and part["fixed"]):
        return number(None)
    return number(float(part[key]), digits_for([part["std"]], least=3 if part["unit"] == "px" else 6))
