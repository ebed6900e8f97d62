"""Stage pairs: which photos may overlap.

1000 photos have 499,500 pairs, of which some 6,000 overlap by a third. With positions and heights above ground the
candidates are those whose footprints overlap; with positions alone, each photo's nearest ones; with neither, all pairs
of a small set, or those close in time. However they are found, each placed photo gets a few nearest partners, and
groups that would stay apart are joined by their closest pairs.

Of 1000 simulated photos with 75 or 80% forward and 60% side overlap, under 10,000 pairs are candidates. They hold all
that truly overlap by over 30% where positions are good to 1 m and attitudes to 0.5 degrees. At 80% with attitudes off
by 1 degree 0 to 2 of some 7,500 are missed; with 1.5 m and 1.5 degrees 4 to 9, all of under 40%.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.report import Told
from jaxba.scene import (
    Footprints,
    Photo,
    Reference,
    components,
    footprint_overlaps,
    footprint_pairs,
    ground_footprints,
    joining_pairs,
    nearest_pairs,
    window_pairs,
)

_GUESSED_FOCAL = 0.7  # of the longer side: a wide lens, so that footprints come out rather large
_SURE_OVERLAP = 0.25  # pairs over it are always candidates
_IMPLAUSIBLE_OVERLAP = 0.4  # of nearest photos, at heights that cannot be right
_UNKNOWN_TILT = 0.05  # radians: sigma of a gimbal's or a mount's deviation from the vertical
_ROOM = 0.07  # of the footprint's shorter side: errors that min_overlap leaves room for
_JOINING = 5


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`: of the metadata stage. `reference`: of the crs stage."""

    photos: tuple[Photo, ...]
    reference: Reference


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    method: str = parameter(
        "auto",
        choices=("auto", "footprint", "neighbours", "exhaustive", "sequential"),
        help="how candidate pairs are found",
    )
    min_overlap: float = parameter(0.16, low=0.01, high=0.25, help="of the smaller of two footprints")
    mean_partners: float = parameter(
        19.8, low=0, high=1000, help="partners a photo on average; beyond, pairs of less than 25% overlap are left out"
    )
    min_partners: int = parameter(6, low=1, high=100, help="nearest photos that are partners whatever their footprint")
    neighbours: int = parameter(20, low=2, high=500, help="nearest photos, where heights above ground are unknown")
    exhaustive_limit: int = parameter(
        60, low=2, high=5000, help="photos up to which those without a position are paired with all others"
    )
    window: int = parameter(20, low=1, high=1000, help="photos before and after that sequential pairs reach")


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """Candidate pairs in rising order.

    - `pairs`: image indices, the first below the second. `overlap`: share of a footprint that both see, NaN if unknown.
    - `method`: how they were found. `num_all`: of all pairs, for the saving. `notes`: what was assumed, in sentences.
    - `by_order`: photos without a usable position, which are paired with those near in time or name alone.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    overlap: Float[np.ndarray, " pairs"]
    method: str
    num_all: int
    by_order: Int[np.ndarray, " some"]
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Find the candidate pairs.

    Raises `JaxbaError` where the chosen method needs positions or heights above ground that the photos lack.
    """
    photos, reference = inputs.photos, inputs.reference
    count = len(photos)
    num_all = count * (count - 1) // 2
    is_placed = reference.is_used & np.isfinite(reference.xyz_m[:, :2]).all(axis=1)
    method = _method(is_placed, reference, params)
    notes: list[str] = []
    is_by_order = ~is_placed | (method == "sequential")
    is_by_order &= count > params.exhaustive_limit and params.method not in ("sequential", "exhaustive")
    footprints: Footprints | None = None
    if method == "exhaustive":
        pairs = np.stack(np.triu_indices(count, 1), axis=1)
        if params.method == "auto":
            notes.append("Every photo is paired with every other, since they have no usable positions.")
    elif method == "sequential":
        pairs = window_pairs(_flight_order(photos), params.window)
        alike = ": lines of a flight are joined by photos that look alike alone (retrieval.neighbours)"
        apart = ": lines of a flight may not be joined"
        notes.append(
            f"Photos are paired with the {params.window} before and after them by {_order_name(photos)}, since they "
            f"have no usable positions{alike if is_by_order.any() else apart}. Positions by a geo.txt are better, and "
            "pairs.method=exhaustive pairs all."
        )
    elif method == "footprint":
        footprints, note = _footprints(photos, reference, is_placed)
        pairs = _overlapping(footprints, params)
        how = f"from footprints, {note}"
    else:
        pairs = _among(is_placed, reference, params.neighbours)
        how = f"of each photo with its {params.neighbours} nearest, since heights above ground are unknown"
    if method in ("footprint", "neighbours"):
        pairs, more = _completed(pairs, footprints, is_placed, inputs, params)
        notes = [f"{len(pairs):,} of {num_all:,} pairs ({len(pairs) / max(num_all, 1):.1%}) {how}.", *more]
    overlap = np.full(len(pairs), np.nan) if footprints is None else footprint_overlaps(footprints, pairs)
    return Outputs(
        pairs=pairs.astype(np.int32), overlap=overlap, method=method, num_all=num_all,
        by_order=np.flatnonzero(is_by_order), notes=tuple(notes),
    )  # fmt: skip


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    share = f" ({len(outputs.pairs) / outputs.num_all:.0%})" if outputs.num_all else ""
    first = f"{len(outputs.pairs):,} of {outputs.num_all:,} pairs{share}, {outputs.method}"
    notes = list(outputs.notes)
    if notes and notes[0].startswith(f"{len(outputs.pairs):,} of {outputs.num_all:,} pairs"):
        first = notes.pop(0).removesuffix(".")
    return [first, *notes]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return how many pairs there are to match, of how many, and how they were found."""
    return {"pairs": {"candidates": len(outputs.pairs), "all": outputs.num_all, "method": outputs.method}}


def _method(is_placed: Bool[np.ndarray, " photos"], reference: Reference, params: Params) -> str:
    """Return the method that `auto` stands for, or the chosen one, if the photos allow it."""
    has_height = np.isfinite(reference.height_above_ground_m) & is_placed
    if params.method == "footprint" and not has_height.any():
        raise JaxbaError(
            "pairs.method=footprint: no photo with a usable position has a height above ground (a relative altitude "
            "tag); set pairs.method=neighbours, which needs positions alone."
        )
    if params.method == "neighbours" and is_placed.sum() < 2:
        raise JaxbaError(
            f"pairs.method=neighbours: {is_placed.sum()} of {len(is_placed)} photos have a usable position; give "
            "positions by a geo.txt, or set pairs.method=exhaustive."
        )
    if params.method != "auto":
        return params.method
    if is_placed.sum() < 2:
        return "exhaustive" if len(is_placed) <= params.exhaustive_limit else "sequential"
    return "footprint" if has_height.any() else "neighbours"


def _footprints(
    photos: tuple[Photo, ...], reference: Reference, is_placed: Bool[np.ndarray, " photos"]
) -> tuple[Footprints, str]:
    """Return the footprints, and in words what they assume."""
    height_m = _heights_above_ground(reference, is_placed)
    size_px = np.array([(photo.width_px, photo.height_px) for photo in photos], float)
    known = [photo.focal_px for photo in photos]
    focal_px = np.array([_GUESSED_FOCAL * max(s) if f is None else f for f, s in zip(known, size_px, strict=True)])
    short_m = height_m * size_px.min(axis=1) / focal_px
    std_m = np.sqrt(np.mean(reference.std_m[:, :2] ** 2, axis=1))
    has_attitude = np.isfinite(reference.quaternion).all(axis=1) & np.isfinite(reference.attitude_std_rad).all(axis=1)
    tilt_rad = np.where(has_attitude, reference.attitude_std_rad[:, :2].mean(axis=1), _UNKNOWN_TILT)
    margin_m = np.maximum(2 * np.hypot(std_m, tilt_rad * height_m) - _ROOM * short_m, 0.0)
    xyz_m = np.where(is_placed[:, None], reference.xyz_m, np.nan)
    footprints = ground_footprints(size_px, focal_px, xyz_m, reference.quaternion, height_m, margin_m)
    no_attitude = int((footprints.is_known & ~np.isfinite(reference.quaternion).all(axis=1)).sum())
    words = f"at {np.median(height_m[footprints.is_known]):.0f} m above ground"
    if no_attitude:
        words += f"; {no_attitude} without attitude, taken as straight down at any yaw"
    if None in known:
        words += f"; {known.count(None)} without focal length, taken as {_GUESSED_FOCAL} times the longer side"
    return footprints, words


def _heights_above_ground(reference: Reference, is_placed: Bool[np.ndarray, " photos"]) -> Float[np.ndarray, " photos"]:
    """Return the known heights; others by their up coordinate over the same ground, or the median."""
    height_m, up_m = reference.height_above_ground_m, reference.xyz_m[:, 2]
    has_up = is_placed & np.isfinite(up_m) & np.isfinite(reference.std_m[:, 2])
    known = np.isfinite(height_m) & is_placed
    both = known & has_up
    median_m = np.median(height_m[known])
    by_up_m = up_m - np.median((up_m - height_m)[both]) if both.any() else np.full(len(up_m), np.nan)
    stand_in = np.where(has_up & (by_up_m > 0.2 * median_m), by_up_m, median_m)
    return np.where(np.isfinite(height_m), height_m, stand_in)


def _overlapping(footprints: Footprints, params: Params) -> Int[np.ndarray, "pairs 2"]:
    """Return the pairs over the least overlap, or the better of them where there are too many."""
    pairs, overlap = footprint_pairs(footprints, params.min_overlap)
    limit = int(params.mean_partners * footprints.is_known.sum() / 2)
    is_kept = overlap >= _SURE_OVERLAP
    is_kept[np.argsort(-overlap, kind="stable")[:limit]] = True
    return pairs[is_kept]


def _completed(
    pairs: Int[np.ndarray, "some 2"],
    footprints: Footprints | None,
    is_placed: Bool[np.ndarray, " photos"],
    inputs: Inputs,
    params: Params,
) -> tuple[Int[np.ndarray, "pairs 2"], list[str]]:
    """Return the pairs with those that leave no photo and no group on its own, and what was done, in sentences."""
    reference, photos, notes = inputs.reference, inputs.photos, []
    placed = np.flatnonzero(is_placed)
    parts = [pairs, _among(is_placed, reference, params.min_partners)]
    if footprints is not None:
        nearest = footprint_overlaps(footprints, _among(is_placed, reference, 1))
        typical = np.nanmedian(nearest) if np.isfinite(nearest).any() else 1.0
        if typical < _IMPLAUSIBLE_OVERLAP:
            parts.append(_among(is_placed, reference, params.neighbours))
            notes.append(
                f"Nearest photos would overlap by {typical:.0%} only: the heights above ground are doubtful, and each "
                f"photo is paired with its {params.neighbours} nearest too."
            )
    has_xy = np.asarray(np.isfinite(reference.xyz_m[:, :2]).all(axis=1))
    loose = np.flatnonzero(~is_placed)
    if len(loose):
        if len(photos) <= params.exhaustive_limit:
            everyone = np.stack(np.meshgrid(loose, np.arange(len(photos)), indexing="ij"), axis=-1).reshape(-1, 2)
            parts.append(everyone[everyone[:, 0] != everyone[:, 1]])
            text = "all others"
        else:
            window = window_pairs(_flight_order(photos), params.window)
            nearest = _among(has_xy, reference, params.neighbours)
            parts += [chosen[~is_placed[chosen].all(axis=1)] for chosen in (window, nearest)]
            text = f"the {params.window} before and after by {_order_name(photos)}"
            text += ", and with those that look alike (retrieval.neighbours)"
        notes.append(f"Photos without a usable position: {len(loose)}; they are paired with {text}.")
    pairs = np.unique(np.sort(np.concatenate(parts), axis=1), axis=0)
    number = np.full(len(photos), -1)
    number[placed] = np.arange(len(placed))
    inner = number[pairs[is_placed[pairs].all(axis=1)]]
    joining = placed[joining_pairs(inner, reference.xyz_m[placed, :2], _JOINING)]
    if len(joining):
        groups = len(components(inner, len(placed)))
        notes.append(f"{groups} groups of photos that do not overlap are joined by {len(joining)} closest pairs.")
    return np.unique(np.concatenate([pairs, joining]), axis=0), notes


def _among(chosen: Bool[np.ndarray, " photos"], reference: Reference, count: int) -> Int[np.ndarray, "pairs 2"]:
    """Return the pairs of each chosen photo with its nearest chosen ones."""
    rows = np.flatnonzero(chosen)
    return rows[nearest_pairs(reference.xyz_m[rows, :2], count)]


def _flight_order(photos: tuple[Photo, ...]) -> Int[np.ndarray, " photos"]:
    """Return the photos by time where all have one, else by name."""
    if any(photo.time is None for photo in photos):
        return np.arange(len(photos))
    return np.array(sorted(range(len(photos)), key=lambda i: (str(photos[i].time), i)), int)


def _order_name(photos: tuple[Photo, ...]) -> str:
    return "name" if any(photo.time is None for photo in photos) else "time"
