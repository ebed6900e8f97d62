"""Stage crs: the target CRS, positions and attitudes in the local frame, and which positions are trusted."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.report import Told, grouped, reference_facts, with_ranges
from jaxba.scene import AssumedDatum, LeftOut, Photo, Reference


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`: of the metadata stage."""

    photos: tuple[Photo, ...]


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    target_crs: str | None = parameter(None, help="projected CRS of the results; none proposes the UTM zone")
    height_datum: str = parameter(
        "as_tagged",
        help="what the photos' heights are above: as_tagged, ellipsoidal, mean_sea_level, or a vertical CRS such as "
        "EPSG:5773",
    )
    h_accuracy_threshold: float = parameter(
        2.0, low=0.05, high=100, help="a stated horizontal accuracy over this, metres, is named for review"
    )
    altitude_variance: float = parameter(
        0.05, low=0.01, high=0.5, help="off the median by more than this share of the flight height goes to review"
    )
    max_height_drift: float = parameter(
        20.0, low=5, high=10_000, help="GNSS altitudes that drift by more than this in a flight are not used, metres"
    )
    max_extent_km: float = parameter(
        100.0, low=1, high=1000, help="positions farther from the survey's middle go to review, kilometres"
    )
    max_distance_km: float = parameter(
        5.0,
        low=0.1,
        high=25_000,
        help="stop where a list of positions lies farther from the photos' own tags, kilometres",
    )
    min_positions: int = parameter(3, low=1, high=1_000_000, help="stop where fewer positions can be used")
    std_h: float = parameter(
        3.0, low=0.01, high=100, help="sigma east and north of a position without accuracy or fix, metres"
    )
    std_v: float = parameter(5.0, low=0.01, high=200, help="sigma of its height, metres")
    flight_offset: float | None = parameter(
        None,
        low=0.001,
        high=100,
        help="sigma of an offset that the positions of each flight have in common, metres; none: no flight has its own",
    )
    attitude_std: float = parameter(2.0, low=0.01, high=90, help="sigma of gimbal pitch and roll, degrees")
    yaw_std: float = parameter(5.0, low=0.01, high=180, help="sigma of gimbal yaw, degrees")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `reference`: positions and attitudes in the local frame, a row a photo. `target_crs`: as it was asked for."""

    reference: Reference
    target_crs: str | None = None


def run(inputs: Inputs, params: Params) -> Outputs:
    """Turn measured positions into the local frame and judge them.

    Raises `JaxbaError` for a list of positions that lies elsewhere than the photos' own tags, for a target CRS that
    does not fit the survey, for heights that cannot be had in it, and where positions are given but fewer than
    `min_positions` of them can be used.
    """
    from jaxba import geo  # loads pyproj

    photos = inputs.photos
    if all(photo.position is None for photo in photos):
        return Outputs(reference=_without_positions(photos, params), target_crs=params.target_crs)
    told = geo.hold_against_tags(photos, 1000 * params.max_distance_km)
    measured = geo.measured_positions(
        photos, height_datum=params.height_datum, std_h_m=params.std_h, std_v_m=params.std_v
    )
    judged = geo.judge_positions(
        measured,
        h_accuracy_threshold_m=params.h_accuracy_threshold,
        altitude_variance=params.altitude_variance,
        max_height_drift_m=params.max_height_drift,
        max_extent_m=1000 * params.max_extent_km,
        std_v_m=params.std_v,
    )
    _stop_if_too_few(judged.is_used, judged.counts, judged.review, params)
    lon, lat = measured.longitude_deg, measured.latitude_deg
    place = lon[judged.is_used], lat[judged.is_used]
    crs = geo.target_crs(params.target_crs, *place)
    frame = geo.local_frame(crs, *place, measured.height_m[judged.is_used], measured.height_datum, measured.declared)
    if judged.drift is not None:
        frame = replace(frame, height_note=f"{frame.height_note} {geo.UNTRUSTED}")
    std_m = measured.std_m.copy()
    has_height = np.isfinite(measured.height_m) & (judged.drift is None)
    std_m[~has_height & np.isfinite(lon), 2] = np.inf
    std_m[np.isnan(lon)] = np.nan
    height_m = np.where(has_height, measured.height_m, frame.height_m)
    xyz_m = geo.local_from_geodetic(frame, lon, lat, height_m)
    xyz_m[np.isnan(lon)] = np.nan
    quaternion, attitude_std_rad, attitude_notes = geo.local_attitudes(
        frame,
        [photo.attitude for photo in photos],
        lon,
        lat,
        tilt_std_rad=np.radians(params.attitude_std),
        yaw_std_rad=np.radians(params.yaw_std),
    )
    flight = None if params.flight_offset is None else geo.flight_numbers(photos, measured)
    reference = Reference(
        frame=frame,
        xyz_m=xyz_m,
        std_m=std_m,
        quaternion=quaternion,
        attitude_std_rad=attitude_std_rad,
        is_used=judged.is_used,
        height_above_ground_m=judged.height_above_ground_m,
        review=judged.review,
        notes=(
            *geo.frame_notes(frame, is_proposed=params.target_crs is None),
            *told,
            *measured.notes,
            *geo.height_notes(measured, judged, frame),
            *judged.notes,
            *attitude_notes,
            *_flight_notes(flight, params, has_time=measured.has_time),
        ),
        flight=flight,
        flight_std_m=params.flight_offset,
        assumed_datum=AssumedDatum(("photos",), measured.height_datum)
        if measured.is_datum_assumed and has_height.any()
        else None,
    )
    return Outputs(reference=reference, target_crs=params.target_crs)


def _flight_notes(flight: np.ndarray | None, params: Params, *, has_time: bool) -> list[str]:
    if flight is None:
        return []
    counts = np.bincount(flight)
    if len(counts) < 2:
        timeless = "" if has_time else ", since not every photo has a time"
        return [f"crs.flight_offset={params.flight_offset:g} has no effect: all photos count as one flight{timeless}."]
    photos = ", ".join(map(str, counts))
    return [
        f"{len(counts)} flights, told by pauses and cameras, of {photos} photos: the positions of each have an offset "
        f"of their own, of a sigma of {params.flight_offset:g} m (crs.flight_offset)."
    ]


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    reference = outputs.reference
    where = reference.frame.crs_name if reference.frame is not None else "no place on earth"
    first = f"{where}; {int(reference.is_used.sum())} of {len(reference.is_used)} positions used"
    return [first, *reference.notes, *grouped(with_ranges(reference.review))]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return the CRS, what heights are above, and the positions on review."""
    return reference_facts(outputs.reference)


def _stop_if_too_few(is_used: np.ndarray, counts: dict[str, int], review: tuple[LeftOut, ...], params: Params) -> None:
    if is_used.sum() >= params.min_positions:
        return
    if len(is_used) == 1:
        raise JaxbaError("there is only one photo that can be used; give two or more that overlap.")
    why = "; ".join(f"{kind}: {count}" for kind, count in counts.items()) or "no other photo"
    first = f" (first: {review[0].name} {review[0].reason})" if review else ""
    raise JaxbaError(
        f"only {is_used.sum()} of {len(is_used)} photos have a position that can be used, and crs.min_positions="
        f"{params.min_positions}. To review: {why}{first}. Mend the positions with a geo.txt, or loosen "
        "crs.altitude_variance or crs.min_positions."
    )


def _without_positions(photos: tuple[Photo, ...], params: Params) -> Reference:
    """Return the reference of photos of which none has a position: attitudes have no frame either."""
    count = len(photos)
    notes = [
        "No photo has a position: without control points the block is adjusted without a place on earth, its scale and "
        "axes free."
    ]
    if params.target_crs is not None:
        from jaxba import geo

        crs = geo.target_crs(params.target_crs, np.zeros(0), np.zeros(0))
        notes.append(f"crs.target_crs={geo.describe(crs)} has no effect without positions or control points.")
    nan = np.full(count, np.nan)
    return Reference(
        frame=None,
        xyz_m=np.full((count, 3), np.nan),
        std_m=np.full((count, 3), np.nan),
        quaternion=np.full((count, 4), np.nan),
        attitude_std_rad=np.full((count, 3), np.nan),
        is_used=np.zeros(count, bool),
        height_above_ground_m=nan,
        review=tuple(
            LeftOut(name=p.name, reason="has no position in its tags or list; it is adjusted") for p in photos
        ),
        notes=tuple(notes),
    )
