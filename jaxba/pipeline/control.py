"""Stage control: surveyed points in the local frame, their marks in the photos, which are control and which check.

A point is a check point if any of these says so: it stands in the check list, its role in a CSV is check, its name
begins with CHK- and no role says otherwise, or the parameter `check` names it. All others are control points. A check
point takes no part in anything but the comparison. A name may stand in both lists, with the same coordinates; it is a
check point then, with the marks of both.

Where no photo has a position, the control points place the local frame, and their CRS is that of the results unless
another is given. Without a list the reference passes through.

Points without coordinates are marked for scale bars alone, which call their ends by name.
"""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.io import SurveyedPoint
from jaxba.pipeline._bar_ends import bars_of
from jaxba.pipeline._control_lists import heights_of_points, points_of_lists
from jaxba.pipeline._mark_turn import expected_px
from jaxba.pipeline._marks import marks_in_photos
from jaxba.report import Told, bar_facts, control_facts, control_lines, reference_facts
from jaxba.scene import AssumedDatum, Control, LeftOut, LocalFrame, Photo, Reference, ScaleBars

_ASSUMED_MARK_STD_PX = 1.0
_LEAST_FIT = {"helmert": 3, "affine": 4}  # control points that are marked twice


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`, `reference`: of the stages before. `target_crs`: that was asked for.

    - `gcp`, `check`, `bars`: name and text of the lists; None where there is none. `is_gcp_found`: nobody named `gcp`,
      which lies among the photos. `list_crs`: of a list that names none.
    """

    photos: tuple[Photo, ...]
    reference: Reference
    target_crs: str | None = None
    gcp: tuple[str, str] | None = None
    check: tuple[str, str] | None = None
    bars: tuple[str, str] | None = None
    is_gcp_found: bool = False
    list_crs: str = ""


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    method: str = parameter(
        "adjust",
        choices=("adjust", "helmert", "affine", "none"),
        help="control in the adjustment, or a fit of 7 or 12 parameters after it, or only compared",
    )
    check: str | None = parameter(None, help="names of points that are check points, such as gcp03, gcp07")
    std_h: float = parameter(0.02, low=0.001, high=10, help="sigma east and north of a point that states none, metres")
    std_v: float = parameter(0.03, low=0.001, high=20, help="sigma of its height, metres")
    bar_std: float = parameter(0.005, low=1e-5, high=1, help="sigma of a scale bar that states none, metres")
    mark_std_px: float | None = parameter(
        None, low=0.05, high=20, help="sigma of a mark an axis, px; none: as the marks of each point scatter about it"
    )
    mark_width_px: int | None = parameter(
        None, low=16, high=200_000, help="width of the photos in which marks were set; none: as the files, or EXIF"
    )
    mark_orientation: str = parameter(
        "auto",
        choices=("auto", "stored", *map(str, range(2, 9)), "exif"),
        help="how photos were turned when marks were set: stored: not; exif: by their EXIF orientation; 2 to 8: by "
        "this one; auto: stored, and another that fits is named",
    )
    heights: str = parameter(
        "auto", choices=("auto", "use", "ignore"), help="heights of points; auto: not where all of them are 0"
    )
    height_datum: str = parameter(
        "as_photos",
        help="what heights are above where the list's CRS does not say it: as_photos, ellipsoidal, mean_sea_level, or "
        "a vertical CRS such as EPSG:5773",
    )
    max_distance_km: float = parameter(
        5.0, low=0.1, high=1000, help="stop where control lies farther from the photos' positions, kilometres"
    )


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `reference`: with a frame from the control points where the photos have none. `control`: the points.

    - `bars`: the scale bars, with the marks of their ends.
    - `left_out`: marks and points that cannot be used, with the reason. `notes`: what was found and decided.
    """

    reference: Reference
    control: Control
    bars: ScaleBars = field(default_factory=ScaleBars.nothing)
    left_out: tuple[LeftOut, ...] = ()
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Bring the lists into the local frame.

    Raises `JaxbaError`, which names file and line, for what cannot be read; for a CRS or heights that do not fit the
    photos; for marks whose scale is not known; and where the method needs more control points.
    """
    if inputs.gcp is None and inputs.check is None:
        if inputs.bars is not None:
            raise JaxbaError(
                f"{inputs.bars[0]}: no list marks the ends of scale bars in photos; give one as --gcp, in which a "
                "point may have no coordinates."
            )
        return Outputs(reference=inputs.reference, control=Control.nothing())
    if inputs.gcp is None or not inputs.is_gcp_found:
        return _placed(inputs, params)
    name = inputs.gcp[0]
    try:
        made = _placed(inputs, params)
    except JaxbaError as error:
        raise JaxbaError(
            f"{error} {name} was found among the photos: mend it, or go without it by --gcp none."
        ) from error
    found = f"{name} was found among the photos, and is used as control (--gcp names another list, or none)."
    return dataclasses.replace(made, notes=(found, *made.notes))


def _placed(inputs: Inputs, params: Params) -> Outputs:
    """Return the points of the lists in the local frame, and the scale bars."""
    names = " and ".join(entry[0] for entry in (inputs.gcp, inputs.check) if entry is not None)
    every, notes = points_of_lists(inputs.gcp, inputs.check, params.check, inputs.photos, inputs.list_crs)
    before_marks = len(notes)
    every.sort(key=lambda point: not point.is_surveyed)
    points = [point for point in every if point.is_surveyed]
    mark = functools.partial(
        marks_in_photos,
        every,
        inputs.photos,
        params.mark_width_px,
        names,
        orientation=params.mark_orientation,
    )
    placed = _Placed(inputs.reference, None, None)
    if points:
        placed = _surveyed(inputs, params, points, names, notes)
    xyz_m = np.full((len(every), 3), np.nan)
    if placed.xyz_m is not None:
        xyz_m[: len(points)] = placed.xyz_m
    expected = functools.partial(expected_px, inputs.photos, inputs.reference, xyz_m)
    found = mark() if placed.reference.frame is None else mark(expected=expected)
    notes[before_marks:before_marks] = found.notes
    mark_std_px = _ASSUMED_MARK_STD_PX if params.mark_std_px is None else params.mark_std_px
    assumed = params.mark_std_px is None
    bars, told = bars_of(inputs.bars, every, found, params.bar_std, mark_std_px, is_assumed=assumed)
    notes += told
    control = dataclasses.replace(Control.nothing(), method=params.method)
    left = list(found.left_out)
    if placed.xyz_m is not None and placed.std_m is not None:
        mine = found.point < len(points)
        control = Control(
            names=tuple(point.name for point in points),
            xyz_m=placed.xyz_m,
            std_m=placed.std_m,
            is_check=np.array([point.is_check for point in points]),
            mark_point=found.point[mine],
            mark_image=found.image[mine],
            mark_xy_px=found.xy_px[mine],
            mark_std_px=mark_std_px,
            mark_std_is_assumed=assumed,
            method=params.method,
        )
        _refuse_too_few(control, params.method, names)
    left += _weak(control)
    return Outputs(reference=placed.reference, control=control, bars=bars, left_out=tuple(left), notes=tuple(notes))


class _Placed(NamedTuple):
    """The reference with a frame, if there is one, and surveyed points in it, with their sigmas."""

    reference: Reference
    xyz_m: np.ndarray | None
    std_m: np.ndarray | None


def _surveyed(inputs: Inputs, params: Params, points: Sequence[SurveyedPoint], names: str, notes: list[str]) -> _Placed:
    from jaxba import geo  # loads pyproj

    xyz = np.array([[point.x, point.y, np.nan if point.z_m is None else point.z_m] for point in points])
    xyz[:, 2] = heights_of_points(points, params.heights, names, notes)
    frame = inputs.reference.frame
    surveyed = geo.surveyed_points(
        [point.crs for point in points],
        xyz,
        name=names,
        height_datum=params.height_datum,
        photos_datum=None if frame is None else frame.height_datum,
        near=None if frame is None else (frame.longitude_deg, frame.latitude_deg),
    )
    notes += surveyed.notes
    is_check = np.array([point.is_check for point in points])
    reference = inputs.reference
    if frame is None:
        reference = _with_frame(inputs, surveyed, ~is_check, notes)
        frame = reference.frame
    elif params.method != "none" and np.isfinite(xyz[~is_check, 2]).any():
        reference = dataclasses.replace(reference, frame=_with_trusted_heights(frame, geo.UNTRUSTED))
    if frame is None:
        return _Placed(reference, None, None)
    height_m, told = geo.heights_above(frame.height_datum, surveyed, names)
    notes += told
    known = np.isfinite(height_m)
    if surveyed.is_datum_assumed and params.method != "none":
        of = () if reference.assumed_datum is None else reference.assumed_datum.of
        assumed = AssumedDatum((*of, names), frame.height_datum)
        reference = dataclasses.replace(reference, assumed_datum=assumed)
    std_h, std_v = (
        np.array([getattr(point, f"std_{axis}_m") or getattr(params, f"std_{axis}") for point in points])
        for axis in ("h", "v")
    )
    xyz_m = geo.local_from_geodetic(
        frame, surveyed.longitude_deg, surveyed.latitude_deg, np.where(known, height_m, frame.height_m)
    )
    _refuse_far(xyz_m, xyz, points, inputs.reference, frame, params, names)
    return _Placed(reference, xyz_m, np.stack([std_h, std_h, np.where(known, std_v, np.inf)], axis=1))


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    return control_lines(outputs.control, outputs.notes, outputs.left_out, outputs.bars)


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return the CRS, which control may have placed, and the points with what of the lists cannot be used."""
    found = reference_facts(outputs.reference)
    if outputs.control.num_points:
        left = [{"name": entry.name, "reason": entry.reason} for entry in outputs.left_out]
        points = control_facts(outputs.control)
        found["control"] = {"asked_method": outputs.control.method, "left_out": left, **points}
    if outputs.bars.num:
        found["bars"] = bar_facts(outputs.bars)
    return found


def _with_frame(inputs: Inputs, surveyed, is_control: np.ndarray, notes: list[str]) -> Reference:
    """Return the reference with a frame around the control points."""
    from jaxba import geo

    if not is_control.any():
        notes.append("No photo has a position and all points are check points: nothing places the block on earth.")
        return inputs.reference
    lon, lat = surveyed.longitude_deg[is_control], surveyed.latitude_deg[is_control]
    text = inputs.target_crs
    if text is None:
        own = geo.parse_crs(surveyed.crs)
        text = surveyed.crs if own.is_projected or (own.is_compound and own.sub_crs_list[0].is_projected) else None
    crs = geo.target_crs(text, lon, lat)
    frame = geo.local_frame(crs, lon, lat, surveyed.height_m[is_control], surveyed.height_datum, surveyed.declared)
    if np.isnan(surveyed.height_m[is_control]).all():
        frame = dataclasses.replace(
            frame,
            height_note="Heights are metres from a zero of their own: neither photos nor control points have any.",
        )
    notes.append("No photo has a position: the control points place the block on earth.")
    told = geo.frame_notes(frame, is_proposed=False)
    if inputs.target_crs is None:
        of = "the CRS of the control points" if text is not None else "proposed, since none was given"
        told = (told[0].replace("as given", f"{of} (--crs sets another)"), *told[1:])
    notes += told
    return dataclasses.replace(inputs.reference, frame=frame)


def _with_trusted_heights(frame: LocalFrame, doubt: str) -> LocalFrame:
    """Return the frame without the doubt that altitudes of the photos cast on heights: control has measured them."""
    if not frame.height_note.endswith(doubt):
        return frame
    note = f"{frame.height_note.removesuffix(doubt).rstrip()} Control points hold them; the GNSS altitudes do not."
    return dataclasses.replace(frame, height_note=note)


def _refuse_far(
    xyz_m: np.ndarray,
    given: np.ndarray,
    points: Sequence[SurveyedPoint],
    reference: Reference,
    frame: LocalFrame,
    params: Params,
    names: str,
) -> None:
    """Refuse control that lies far from the photos, with the usual mistake that brings it there."""
    from jaxba import geo

    photos = reference.xyz_m[reference.is_used, :2]
    if not len(photos):
        return
    middle = np.median(photos, axis=0)
    away_km = float(np.hypot(*(np.median(xyz_m[:, :2], axis=0) - middle))) / 1000
    if away_km <= params.max_distance_km:
        return
    lon, lat = np.full(len(given), frame.longitude_deg), np.full(len(given), frame.latitude_deg)
    fit = geo.would_fit(points[0].crs, given[:, :2], lon, lat, 1000 * params.max_distance_km)
    tried = "" if fit is None else f" With {fit[0]} it would be {fit[1] / 1000:.2f} km: correct the list."
    raise JaxbaError(
        f"{names}: control lies {away_km:,.1f} km from the photos' positions, over {params.max_distance_km:g} km "
        f"(control.max_distance_km), by {points[0].crs}, the CRS of the list.{tried or ' A wrong zone or datum?'}"
    )


def _weak(control: Control) -> list[LeftOut]:
    """Return the points that too few photos show."""
    count = np.bincount(control.mark_point, minlength=control.num_points)
    return [
        LeftOut(name=control.names[k], reason=f"is marked in {count[k]} of the photos; two or more fix a point")
        for k in np.flatnonzero(count < 2)
    ]


def _refuse_too_few(control: Control, method: str, names: str) -> None:
    count = np.bincount(control.mark_point, minlength=control.num_points)
    usable = int(np.count_nonzero((count >= 2) & ~control.is_check))
    if usable < _LEAST_FIT.get(method, 0):
        raise JaxbaError(
            f"control.method={method} needs {_LEAST_FIT[method]} control points that two photos or more show, and "
            f"{names} has {usable}; mark more, or use control.method=adjust."
        )
