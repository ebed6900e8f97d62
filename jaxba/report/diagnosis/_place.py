"""Rules on the place: positions in another zone or with swapped axes, datums that are mixed, a GNSS that contradicts
itself. Where a list replaces the photos' tags, they are held against it."""

import numpy as np
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.engine._words import some
from jaxba.report._recorded import Recorded
from jaxba.report.diagnosis._adjustment import bounds_reached, has_large_errors
from jaxba.report.diagnosis._diagnosis import Diagnosis
from jaxba.report.diagnosis._listed import Against, against_tags, wgs84
from jaxba.scene import Position

_FAR_M = 100.0
_DATUM_M = 8.0  # between height systems, or horizontal datums; a receiver's heights differ by less within a flight
_STEADY = 0.3  # scatter of an offset over it: an offset in common
_OUTLIERS = 0.1
_SCATTERS = 3.0  # times the stated sigma
_METRE = 1.0


def far_off(case: Recorded) -> Diagnosis | None:
    """Positions hundreds of metres off: axis order or a wrong zone."""
    if case.stopped is not None and case.stopped.name == "crs":
        target = case.done.settings["crs"].target_crs
        diagnosis = _does_not_fit(case, target) if target is not None else None
        if diagnosis is not None:
            return diagnosis
    found = against_tags(case)
    if found is None or not np.median(found.away_m) > _FAR_M:
        return _control_far_off(case)
    source, median = found.listed[0].source, float(np.median(found.away_m))
    why, cure = _what_would_fit(found)
    return Diagnosis(
        name="far off",
        cause=f"The positions of {source} lie {_length(median)} from those of the photos' tags (median of "
        f"{len(found.away_m)} photos; the first, {found.photos[0].name}: x {found.listed[0].x:g}, y "
        f"{found.listed[0].y:g} in {found.listed[0].crs}): {why}. The block itself may be without fault.",
        cure=cure,
        figures={"median_m": median, "photos": len(found.away_m), "crs": found.listed[0].crs},
    )


def _does_not_fit(case: Recorded, target: str) -> Diagnosis | None:
    """The target CRS does not hold the positions: which zone does, and whether swapped axes would."""
    from jaxba import geo

    known = [photo.position for photo in case.done.photos if photo.position is not None]
    if not known:
        return None
    lon, lat = np.array([wgs84(position) for position in known]).T
    try:
        crs = geo.parse_crs(target)
        geo.target_crs(target, lon, lat)
        return None  # it fits: the stage stopped for another reason
    except JaxbaError as error:
        said = str(error)
        if "is no CRS" in said:
            return None
    area = crs.area_of_use
    west, south, east, north = area.bounds if area is not None else (-180, -90, 180, 90)
    x, y = float(np.median(lon)), float(np.median(lat))
    is_swapped = area is not None and west <= y <= east and south <= x <= north
    fitting = geo.describe(geo.utm_zone(y, x) if is_swapped else geo.utm_zone(x, y)) if abs(y) <= 90 else ""
    place = f"the positions lie around longitude {x:.4f}, latitude {y:.4f}"
    why = "with swapped axes they would lie inside" if is_swapped else "a wrong zone, or axes in another order"
    return Diagnosis(
        name="far off",
        cause=f"{geo.describe(crs)} is for longitude {west:g} to {east:g}, latitude {south:g} to {north:g}, and "
        f"{place}: {why}.",
        cure="Write longitude before latitude in the list of positions."
        if is_swapped
        else f"Give the CRS of the place{f', such as {fitting}' if fitting else ''}, or mend the list of positions: x "
        "(longitude) comes first.",
        figures={"longitude": x, "latitude": y, "area_of_use": [west, south, east, north]},
    )


def mixed_datum(case: Recorded) -> Diagnosis | None:
    """Heights, or positions, tens of metres off: an implicit datum, or two of them."""
    found = against_tags(case)
    if found is not None:
        diagnosis = _other_datum(case, found)
        if diagnosis is not None:
            return diagnosis
    return _control_of_another_datum(case) or _two_height_systems(case)


def _control_far_off(case: Recorded) -> Diagnosis | None:
    """Control lies hundreds of metres from the positions, and the block on control."""
    away_m = _gnss_minus_control_m(case)
    across = float(np.hypot(*away_m[:2]))
    if not across > _FAR_M:
        return None
    return Diagnosis(
        name="far off",
        cause=f"The measured positions lie {_length(across)} from where control puts them, all alike (adjusted "
        f"minus measured: east {-away_m[0]:+.1f} m, north {-away_m[1]:+.1f} m): control in another zone, or with "
        "swapped axes.",
        cure="Compare the CRS in the first line of the list of control points with that of its coordinates; x (east) "
        "comes first.",
        figures={"gnss_minus_control_m": away_m.tolist()},
    )


def _control_of_another_datum(case: Recorded) -> Diagnosis | None:
    """Control and positions are tens of metres apart, all alike: two datums."""
    away_m = _gnss_minus_control_m(case)
    across = float(np.hypot(*away_m[:2]))
    if across > _FAR_M or not (across > _DATUM_M or abs(away_m[2]) > _DATUM_M):
        return None
    settings, frame = case.done.settings, case.done.control.reference.frame
    above = "" if frame is None else f" Heights of the photos are {frame.height_datum}"
    return Diagnosis(
        name="mixed datum",
        cause=f"All measured positions are off from control by the same (adjusted minus measured: east "
        f"{-away_m[0]:+.1f} m, north {-away_m[1]:+.1f} m, up {-away_m[2]:+.1f} m): they are in two datums.{above} "
        f"(crs.height_datum={settings['crs'].height_datum}), those of control are taken "
        f"control.height_datum={settings['control'].height_datum}; a geoid lies up to 100 m off the ellipsoid.",
        cure="Say what each is above: control.height_datum and crs.height_datum, ellipsoidal, mean_sea_level, or a "
        "vertical CRS such as EPSG:5773. Control holds the block meanwhile.",
        figures={"gnss_minus_control_m": away_m.tolist()},
    )


def _gnss_minus_control_m(case: Recorded) -> Float[np.ndarray, "3"]:
    """Return what the positions are off from control in common, 0 where that is not known."""
    adjusted = case.done.adjust
    return np.zeros(3) if adjusted is None else np.nan_to_num(np.asarray(adjusted.gnss_minus_control_m, float))


def _other_datum(case: Recorded, found: Against) -> Diagnosis | None:
    """The list is steadily off the tags: up, by another height system; across, by another horizontal datum."""
    across, up = float(np.median(found.away_m)), float(np.nanmedian(np.append(found.up_m, np.nan)))
    spread = float(np.nanmedian(np.abs(np.append(found.up_m, np.nan) - up)))
    listed, tagged = found.listed[0], found.tagged[0]
    is_up = abs(up) > _DATUM_M and spread < _STEADY * abs(up)
    is_across = _DATUM_M < across <= _FAR_M and np.ptp(found.away_m) < _STEADY * across
    if not is_up and not is_across:
        return None
    datum = case.done.settings["crs"].height_datum
    texts = []
    if is_up:
        texts.append(
            f"Heights of {listed.source} are {up:+.1f} m against the photos' tags (median of {len(found.up_m)}, "
            f"scatter {spread:.1f} m). Those of the list are {_kind(listed)}, those of the tags {_kind(tagged)}, and "
            f"crs.height_datum={datum}: a geoid lies between them, or one of them is not what it says"
        )
    if is_across:
        texts.append(
            f"Positions of {listed.source}, in {listed.crs}, lie {across:.1f} m from the tags, in {tagged.crs}, all of "
            "them alike: another horizontal datum"
        )
    return Diagnosis(
        name="mixed datum",
        cause=f"{'. '.join(texts)}.",
        cure="Say what the list's heights are above: crs.height_datum=ellipsoidal, mean_sea_level, or a vertical CRS "
        "such as EPSG:5773; and write the CRS of its positions into its first line.",
        figures={"up_m": up, "across_m": across, "list": listed.height_kind, "tags": tagged.height_kind},
    )


def _kind(position: Position) -> str:
    return {"ellipsoidal": "above the ellipsoid", "mean_sea_level": "above mean sea level"}.get(
        position.height_kind, "above nothing that is said"
    )


def _two_height_systems(case: Recorded) -> Diagnosis | None:
    """Heights less those that the flight or the photos tell fall into two groups: two datums in one set."""
    done = case.done
    if done.crs is None:
        return None
    z = np.array([np.nan if (p := photo.position) is None or p.z_m is None else p.z_m for photo in done.photos])
    relative = [None if photo.position is None else photo.position.relative_altitude_m for photo in done.photos]
    base = z - np.array([np.nan if value is None else value for value in relative], float)
    what = "heights less the heights above take-off"
    if done.adjust is not None and done.adjust.block.is_georeferenced and not np.isfinite(base).any():
        block = done.adjust.block
        base = np.full(len(z), np.nan)
        base[block.image_index] = z[block.image_index] - block.centers_m[:, 2]
        what = "measured less adjusted heights"
    rows = np.flatnonzero(np.isfinite(base))
    if len(rows) < 4:
        return None
    ordered = np.sort(base[rows])
    gaps = np.diff(ordered)
    cut = int(np.argmax(gaps))
    low, high = ordered[: cut + 1], ordered[cut + 1 :]
    within = max(float(np.ptp(low)), float(np.ptp(high)), _METRE)
    if min(len(low), len(high)) < 2 or gaps[cut] < max(_DATUM_M, 2 * within):
        return None
    upper = rows[base[rows] > (ordered[cut] + ordered[cut + 1]) / 2]
    names = [photo.name for photo in done.photos]
    kinds = sorted({_kind(photo.position) for photo in done.photos if photo.position is not None})
    apart = float(np.median(high) - np.median(low))
    return Diagnosis(
        name="mixed datum",
        cause=f"The {what} fall into two groups {apart:.1f} m apart: {len(low)} photos around {np.median(low):.1f} m, "
        f"{len(high)} around {np.median(high):.1f} m ({some([names[i] for i in upper], 3)}). Heights are said to be "
        f"{' and '.join(kinds)}: two height systems in one set.",
        cure="Bring all heights into one system in a geo.txt, and say which: crs.height_datum=ellipsoidal, "
        "mean_sea_level, or a vertical CRS such as EPSG:5773.",
        figures={"apart_m": apart, "low": len(low), "high": len(high), "kinds": kinds},
    )


def contradicting_gnss(case: Recorded) -> Diagnosis | None:
    """A GNSS that contradicts itself or the photos: heights that drift, outliers, more scatter than it states."""
    done = case.done
    if done.crs is None or done.crs.reference.frame is None:
        return None
    reference, texts = done.crs.reference, []
    figures: dict[str, object] = {}
    z = np.array([np.nan if (p := photo.position) is None or p.z_m is None else p.z_m for photo in done.photos])
    used = np.asarray(reference.is_used)
    if used.any() and np.isfinite(z[used]).any() and not np.isfinite(reference.std_m[used, 2]).any():
        order = sorted(np.flatnonzero(used & np.isfinite(z)), key=lambda i: (done.photos[i].time or "", i))
        first, last = order[0], order[-1]
        figures |= {"first_m": z[first], "last_m": z[last]}
        texts.append(
            f"altitudes go from {z[first]:.1f} m ({done.photos[first].name}) to {z[last]:.1f} m "
            f"({done.photos[last].name}) in one flight, over {np.ptp(z[order]):.1f} m, which neither the ground nor "
            "the flight explains; no height is used"
        )
    names = {photo.name for photo, is_used in zip(done.photos, used, strict=True) if not is_used}
    unused = [left for left in reference.review if left.name in names]
    if len(unused) > _OUTLIERS * len(used):
        figures["review"] = [left.name for left in unused]
        texts.append(
            f"{len(unused)} of {len(used)} positions are not used ({unused[0].name} {unused[0].reason.rstrip('.')})"
        )
    if _is_sound(case):
        texts += _against_photos(case, figures)
    if not texts:
        return None
    return Diagnosis(
        name="GNSS contradicts itself",
        cause=f"The measured positions cannot all be right: {'; '.join(texts)}.",
        cure="Take post-processed positions or ground control; or give a geo.txt with heights that can be trusted, and "
        "larger sigmas for the photos named.",
        figures=figures,
    )


def _is_sound(case: Recorded) -> bool:
    """Whether the block has a place on earth, and nothing says that it is itself what is bent."""
    adjusted = case.done.adjust
    if adjusted is None or not adjusted.block.is_georeferenced:
        return False
    return not has_large_errors(case) and not bounds_reached(case)


def _against_photos(case: Recorded, figures: dict[str, object]) -> list[str]:
    """Return what the adjusted block says against the positions."""
    from jaxba.sfm import gnss_fit, without_offsets  # loads jax

    done, texts = case.done, []
    block, reference = done.adjust.block, without_offsets(done.control.reference, done.adjust.flights)
    fit = gnss_fit(block, reference)
    bad: Bool[np.ndarray, " images"] = fit.is_outlier
    most = float(np.nanmax(np.abs(fit.residual_m[bad] - fit.middle_m))) if bad.any() else 0.0
    if bad.sum() > _OUTLIERS * (fit.num + bad.sum()) and most > _METRE:
        names = [done.photos[i].name for i in block.image_index[bad]]
        figures |= {"outliers": names, "largest_m": most}
        texts.append(
            f"{bad.sum()} of {fit.num + bad.sum()} contradict the photos, by up to {most:.1f} m ({some(names, 3)})"
        )
    stated = np.median(reference.std_m[reference.is_used], axis=0)
    for axis, scale, std in zip(("east", "north", "up"), fit.scale_m, stated, strict=True):
        if np.isfinite(std) and scale > max(_SCATTERS * std, _METRE):
            figures[f"scatter_{axis}_m"] = float(scale)
            texts.append(f"they scatter by {scale:.1f} m {axis}, where {std:.1f} m are stated")
    return texts


def _what_would_fit(found: Against) -> tuple[str, str]:
    """Return why positions are off, as far as a usual mistake explains it, and the cure."""
    from jaxba import geo

    tagged = np.array([wgs84(position) for position in found.tagged])
    of_first = [k for k, position in enumerate(found.listed) if position.crs == found.listed[0].crs]
    xy = np.array([(found.listed[k].x, found.listed[k].y) for k in of_first])
    fit = geo.would_fit(found.listed[0].crs, xy, *tagged[of_first].T, within_m=_FAR_M)
    if fit is None:
        return (
            "no usual mistake explains it (axes, degrees, feet, zone, hemisphere)",
            "Compare the list with the photos' tags, row by row.",
        )
    return f"with {fit[0]} it would be {_length(fit[1])}", f"Correct the list: {fit[0]}."


def _length(metres: float) -> str:
    if not np.isfinite(metres):
        return "beyond the earth"
    return f"{metres / 1000:,.0f} km" if metres >= 10_000 else f"{metres:.0f} m"
