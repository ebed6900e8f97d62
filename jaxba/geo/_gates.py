"""Which measured positions are trusted, and which go to review with the reason; no image is dropped here.

Not used are:

- Coordinates that are missing, out of range, or the (0, 0) of a receiver without a fix.
- Far from the others: a wrong sign or a foreign photo.
- A height off the median flight. Where photos have a relative altitude, that is the flight height, and the gate is a
  share of it. Where they have none, the height above ground is not known: then it is five robust sigmas (of the median
  absolute deviation), three sigmas of the receiver's height at least.
- Heights that contradict each other: a receiver without a good fix can drift by tens of metres during a flight while it
  reports nothing. Then no single frame is wrong, and none is right: all keep their horizontal position, and no height.

A stated horizontal accuracy over the threshold goes to review, too, and the position is used: its own sigma weighs it.

The drift is told from a real change of height by what it depends on. With relative altitudes: the barometer does not
see it. Without: a drone that follows the terrain or flies several heights has heights that depend on the place, a drift
has heights that depend on the time. So heights are fitted by a quadratic surface of place, then by the surface and the
time; they drift where time explains most of what place leaves, more metres than a receiver's noise, and in no steps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxba.geo._positions import Measured
from jaxba.scene import LeftOut, described

MIN_FRAMES_FOR_DRIFT = 12
EXPLAINED_BY_TIME = 0.5
"""Share of the variance left by place that time must explain. In 3000 simulated flights that
follow the terrain (relief of 5 to 120 m, 3 to 15 lines to and fro) 2 reached it, both of 30 frames. Of drifts by 80 m
under noise of 2.5 m it finds all over 4 lines, 97 % over 6, 15 % over 10: a grid flown once in many lines hides a
drift, since line after line it looks like a slope."""
LEVEL_GAP = 0.25
"""Heights with a gap of this share of their range were flown on levels; a drift passes through all heights."""
FLIGHT_GAP_S = 180.0
"""A longer pause is taken as a landing, after which relative altitudes may start from another place."""
MIN_FLIGHT_HEIGHT_M = 2.0
_ONE_SIZE = 0.2  # spread of heights without their signs, as a share: a flight across sea level has heights near 0, too


@dataclass(frozen=True, kw_only=True)
class HeightDrift:
    """Heights that cannot be trusted: `first_m` to `last_m` over the flight, in frames `first` to `last`; `reason`."""

    first_m: float
    last_m: float
    first: str
    last: str
    reason: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """- `is_used`, `height_above_ground_m`, `review`, `notes`: see `Reference`.

    - `counts`: of reasons why positions are not used, by kind.

    - `drift`: None where heights are trusted.
    """

    is_used: Bool[np.ndarray, " photos"]
    height_above_ground_m: Float[np.ndarray, " photos"]
    review: tuple[LeftOut, ...]
    drift: HeightDrift | None
    counts: dict[str, int]
    notes: tuple[str, ...]


def judge_positions(
    measured: Measured,
    *,
    h_accuracy_threshold_m: float,
    altitude_variance: float,
    max_height_drift_m: float,
    max_extent_m: float,
    std_v_m: float,
) -> Judgement:
    """Return which positions are trusted, and what should be looked at, with the reason."""
    count = len(measured.names)
    reasons: list[str] = [""] * count
    counts: dict[str, int] = {}

    def gate(rows: Bool[np.ndarray, " photos"], kind: str, texts: list[str]) -> None:
        for k in np.flatnonzero(rows & np.array([not reason for reason in reasons], bool)):
            reasons[k] = texts[k]
            counts[kind] = counts.get(kind, 0) + 1

    def left() -> Bool[np.ndarray, " photos"]:
        return np.array([not reason for reason in reasons], bool)

    gate(np.isnan(measured.longitude_deg), "missing coordinates", _missing_texts(measured))
    away_m = np.hypot(*_east_north(measured, left()).T)
    gate(away_m > max_extent_m, "far from the others", [
        f"lies {away / 1000:.0f} km from the middle of the survey, over {max_extent_m / 1000:g} km "
        "(crs.max_extent_km); check its coordinates" for away in np.nan_to_num(away_m)
    ])  # fmt: skip
    drift, odd = described("Drift of heights", lambda: _height_drift(measured, left(), max_height_drift_m), None)
    notes = [f"{note}." for note in odd]
    notes += _gate_altitudes(measured, left, gate, altitude_variance, std_v_m, drift is not None)
    is_used = left()
    known = is_used.sum() + counts.get("altitude", 0)
    if counts.get("altitude", 0) > 0.2 * known:
        notes.append(
            f"{counts['altitude']} of {known} positions are off the median flight height: a flight at several heights, "
            "or over steep ground? If so raise crs.altitude_variance, so that they are used."
        )
    notes += _two_sided(measured, is_used)
    stated = measured.stated_std_h_m
    for k in np.flatnonzero(is_used & (stated > h_accuracy_threshold_m)):
        reasons[k] = (
            f"states a horizontal accuracy of {stated[k]:.2f} m, over {h_accuracy_threshold_m:g} m "
            "(crs.h_accuracy_threshold); the position is used with that sigma"
        )
    review = tuple(LeftOut(name=name, reason=text) for name, text in zip(measured.names, reasons, strict=True) if text)
    relative = measured.relative_altitude_m
    is_above = relative >= MIN_FLIGHT_HEIGHT_M
    return Judgement(
        is_used=is_used,
        height_above_ground_m=np.where(is_above, relative, np.nan),
        review=review,
        drift=drift,
        counts=counts,
        notes=tuple(notes),
    )


def _two_sided(measured: Measured, rows: Bool[np.ndarray, " photos"]) -> list[str]:
    """Return a note on heights of one size with both signs: a side of sea level was lost in some of the photos."""
    rows = rows & np.isfinite(measured.height_m)
    below, above = rows & (measured.height_m < 0), rows & (measured.height_m > 0)
    size_m = np.abs(measured.height_m[rows])
    if not below.any() or not above.any() or np.ptp(size_m) > _ONE_SIZE * np.median(size_m):
        return []
    first = [measured.names[int(np.flatnonzero(side)[0])] for side in (below, above)]
    return [
        f"Heights of {below.sum()} positions are about {np.median(size_m):.0f} m below zero (first: {first[0]}) and of "
        f"{above.sum()} as much above (first: {first[1]}): one of the two signs is wrong (GPSAltitudeRef, or a minus "
        "in the list). Mend it, or give the heights in a geo.txt."
    ]


def _missing_texts(measured: Measured) -> list[str]:
    text = "has no usable coordinates in its tags or list; it is adjusted without a measured position"
    return [text] * len(measured.names)


def _east_north(measured: Measured, rows: Bool[np.ndarray, " photos"]) -> Float[np.ndarray, "photos 2"]:
    """Return metres from the median of some rows, on a sphere: good to a percent, for gates only."""
    lon, lat = measured.longitude_deg, measured.latitude_deg
    if not rows.any():
        return np.full((len(lon), 2), np.nan)
    first = lon[rows][0]
    turned = (lon - first + 180) % 360 - 180
    east = np.radians(turned - np.median(turned[rows])) * np.cos(np.radians(np.median(lat[rows])))
    return 6.371e6 * np.stack([east, np.radians(lat - np.median(lat[rows]))], axis=1)


def _gate_altitudes(measured: Measured, left, gate, share: float, std_v_m: float, is_drifting: bool) -> list[str]:
    """Gate heights off the median flight; return notes."""
    relative, height, rows = measured.relative_altitude_m, measured.height_m, left()
    by_relative = rows & np.isfinite(relative)
    flight_m = float(np.median(relative[by_relative])) if by_relative.any() else 0.0
    knows_flight = by_relative.sum() * 2 >= rows.sum() and flight_m >= MIN_FLIGHT_HEIGHT_M
    if knows_flight:
        off = relative - flight_m
        gate(np.abs(off) > share * flight_m, "altitude", [
            f"flew {abs(o):.1f} m {'above' if o > 0 else 'below'} the median flight height of {flight_m:.1f} m, over "
            f"{share:.0%} of it (crs.altitude_variance)" for o in np.nan_to_num(off)
        ])  # fmt: skip
    rows = left() & np.isfinite(height)
    if is_drifting or not rows.any():
        return []
    # what has a relative altitude is judged by it alone: heights after another take-off differ, and may
    judged = rows & ~np.isfinite(relative) if knows_flight else rows
    if not judged.any():
        return []
    median_m = float(np.median(height[rows]))
    sigma_m = 1.4826 * float(np.median(np.abs(height[rows] - median_m)))
    limit_m = max(5 * sigma_m, 3 * std_v_m, share * flight_m if knows_flight else 0.0)
    off = height - median_m
    gate(judged & (np.abs(off) > limit_m), "altitude", [
        f"has a height of {h:.1f} m, {abs(h - median_m):.1f} m {'above' if h > median_m else 'below'} the median of "
        f"{median_m:.1f} m, over {limit_m:.1f} m (five robust sigmas of the heights, or three of crs.std_v)"
        for h in np.nan_to_num(height)
    ])  # fmt: skip
    if knows_flight:
        return []
    return [
        f"No relative altitude tells the flight height, so crs.altitude_variance has no measure: heights within "
        f"{limit_m:.1f} m of their median of {median_m:.1f} m are used."
    ]


def _height_drift(measured: Measured, rows: Bool[np.ndarray, " photos"], limit_m: float) -> HeightDrift | None:
    """Return the drift of heights during the flight, or None where they can be believed."""
    rows = rows & np.isfinite(measured.height_m) & ~measured.is_vouched
    if rows.sum() < MIN_FRAMES_FOR_DRIFT:
        return None
    order = np.flatnonzero(rows)[np.argsort(measured.time_s[rows], kind="stable")]
    height, relative = measured.height_m[order], measured.relative_altitude_m[order]
    if np.isfinite(relative).all() and np.median(relative) >= MIN_FLIGHT_HEIGHT_M:
        return _drift_against_barometer(measured, order, limit_m)
    time = measured.time_s[order]
    if np.ptp(time) == 0:
        time = np.arange(len(order), dtype=float)
    place = _east_north(measured, rows)[order]
    place = place / max(float(np.abs(place).max()), 1.0)
    time = (time - time.min()) / np.ptp(time)
    x, y = place.T
    surface = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    by_place = height - surface @ np.linalg.lstsq(surface, height, rcond=None)[0]
    both = np.column_stack([surface, time])
    solution, _, rank, _ = np.linalg.lstsq(both, height, rcond=None)
    left_over = height - both @ solution
    explained = 1 - left_over @ left_over / max(by_place @ by_place, 1e-12)
    drift_m = float(solution[-1])
    if rank < both.shape[1] and np.linalg.matrix_rank(surface) == rank:
        return None  # a single strip, where time and place are one
    if abs(drift_m) <= limit_m or explained < EXPLAINED_BY_TIME or _is_on_levels(height):
        return None
    why = (
        f"they {'climb' if drift_m > 0 else 'sink'} with time by {abs(drift_m):.0f} m, also over the same ground (time "
        f"explains {explained:.0%} of what place leaves)"
    )
    return _drift(measured, order, why, limit_m)


def _is_on_levels(height_m: Float[np.ndarray, " frames"]) -> bool:
    """Return whether heights, but for the outermost tenth, fall into levels with nothing between."""
    low, high = np.percentile(height_m, [5, 95])
    inner = np.sort(height_m[(height_m >= low) & (height_m <= high)])
    return bool(np.diff(inner).max() > LEVEL_GAP * (high - low))


def _drift_against_barometer(measured: Measured, order: np.ndarray, limit_m: float) -> HeightDrift | None:
    take_off_m = measured.height_m[order] - measured.relative_altitude_m[order]
    pauses = np.diff(measured.time_s[order]) > (FLIGHT_GAP_S if measured.has_time else np.inf)
    for flight in np.split(np.arange(len(order)), np.flatnonzero(pauses) + 1):
        low, high = np.percentile(take_off_m[flight], [5, 95])
        if len(flight) >= MIN_FRAMES_FOR_DRIFT and high - low > limit_m:
            why = f"less the relative altitude, they put the take-off point anywhere from {low:.1f} m to {high:.1f} m"
            return _drift(measured, order[flight], why, limit_m)
    return None


def _drift(measured: Measured, order: np.ndarray, why: str, limit_m: float) -> HeightDrift:
    first, last = order[0], order[-1]
    first_m, last_m = float(measured.height_m[first]), float(measured.height_m[last])
    reason = (
        f"The GNSS altitudes contradict each other: from {first_m:.1f} m ({measured.names[first]}) to {last_m:.1f} m "
        f"({measured.names[last]}) in one flight; {why}, where {limit_m:g} m are allowed (crs.max_height_drift)."
    )
    return HeightDrift(
        first_m=first_m, last_m=last_m, first=measured.names[first], last=measured.names[last], reason=reason
    )
