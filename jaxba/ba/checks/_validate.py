"""Validation: what makes a problem unsolvable as it was given, found before anything is computed.

Each check names the field, the entry and its value, and what to do. Cost: a pass over every array; 500k observations
take 40 ms.
"""

import dataclasses
import typing
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba.checks._plausible import implausible_cameras
from jaxba.geometry import Linear, check_loss

_QUATERNION_NORM = 1e-3  # files round quaternions to a few digits; more than this is a mistake

_LARGEST = 1e30  # of any number, and of one over any sigma: the fourth power is finite in float64

_Label = Callable[[int], str]


def validate(problem: Problem) -> None:
    """Raise `JaxbaError` if the problem contradicts itself or holds impossible values."""
    parameters = type(problem.cameras).parameter_names()
    sizes = {
        "images": _length(problem.poses.translation),
        "points": _length(problem.points),
        "observations": _length(problem.observations.xy_px),
        "cameras": _length(problem.lower),
        "parameters": len(parameters),
        "offsets": _length(problem.position_offset),
        "ends": 2,
    }
    if problem.image_names and len(problem.image_names) != sizes["images"]:
        names, images = len(problem.image_names), sizes["images"]
        raise JaxbaError(f"image_names has {names} names for {images} images; give one an image, or none.")
    seen, free = problem.observations, problem.free
    _check_shape("poses.quaternion", problem.poses.quaternion, "images 4", sizes)
    _check_shape("poses.translation", problem.poses.translation, "images 3", sizes)
    for name in parameters:
        _check_shape(f"cameras.{name}", getattr(problem.cameras, name), "cameras", sizes)
    _check_shape("points", problem.points, "points 3", sizes)
    _check_shape("observations.xy_px", seen.xy_px, "observations 2", sizes)
    _check_shape("observations.std_px", seen.std_px, "observations", sizes)
    _check_shape("lever_arm", problem.lever_arm, "3", sizes)
    _check_shape("position_offset", problem.position_offset, "offsets 3", sizes)
    _check_shape("lower", problem.lower, "cameras parameters", sizes)
    _check_shape("upper", problem.upper, "cameras parameters", sizes)
    for field, value, dims in (
        ("poses", free.poses, "images"),
        ("points", free.points, "points"),
        ("intrinsics", free.intrinsics, "cameras parameters"),
        ("lever_arm", free.lever_arm, ""),
        ("position_offset", free.position_offset, ""),
    ):
        _check_shape(f"free.{field}", value, dims, sizes)
        if np.asarray(value).dtype != bool:
            raise JaxbaError(f"free.{field} has type {np.asarray(value).dtype}; give True (free) and False (fixed).")
    _check_index(problem, "camera_index", problem.camera_index, "images", "cameras", sizes)
    _check_index(problem, "observations.image_index", seen.image_index, "observations", "images", sizes)
    _check_index(problem, "observations.point_index", seen.point_index, "observations", "points", sizes)

    image, point, camera, observation = (_label(problem, kind) for kind in ("image", "point", "camera", "observation"))
    _check_finite("poses.translation", problem.poses.translation, image)
    _check_quaternion("poses.quaternion", problem.poses.quaternion, image)
    for name in parameters:
        _check_finite(f"cameras.{name}", getattr(problem.cameras, name), camera)
    _check_finite("points", problem.points, point)
    _check_finite("observations.xy_px", seen.xy_px, observation)
    _check_finite("observations.std_px", seen.std_px, observation)
    _check_positive("observations.std_px", seen.std_px, observation)
    _check_finite("lever_arm", problem.lever_arm, _label(problem, "axis"))
    _check_finite("position_offset", problem.position_offset, _label(problem, "offset"))
    if free.position_offset and not len(problem.position_offset):
        raise JaxbaError("free.position_offset is True, but position_offset has no row; give it zeros((1, 3)).")
    _check_duplicates(problem)
    _check_bounds(problem)
    for i, prior in enumerate(problem.priors):
        if any(other.name == prior.name for other in problem.priors[:i]):
            raise JaxbaError(f"prior {prior.name} is given twice; join its rows into one prior.")
        _check_prior(problem, prior, sizes)
    if not (np.any(free.poses) or np.any(free.points) or np.any(free.intrinsics) or problem.free_antenna.any()):
        raise JaxbaError("Nothing is free, so there is nothing to adjust. Free the poses, points or intrinsics.")
    if sizes["observations"] == 0:
        raise JaxbaError("observations are empty; an adjustment needs points measured in images.")
    implausible = implausible_cameras(problem)
    if implausible:
        raise JaxbaError(f"cameras: {implausible[0]}{_more(np.array(implausible))}.")


def _length(value: Any) -> int:
    shape = np.shape(value)
    return shape[0] if shape else 0


def _check_shape(field: str, value: Any, dims: str, sizes: Mapping[str, int]) -> None:
    expected = tuple(sizes[d] if d in sizes else int(d) for d in dims.split())
    if np.shape(value) != expected:
        axes = f"({dims.replace(' ', ', ')})"
        raise JaxbaError(f"{field} has shape {np.shape(value)}, expected {axes} = {expected}; make the arrays agree.")


def _check_index(problem: Problem, field: str, value: Any, of: str, into: str, sizes: Mapping[str, int]) -> None:
    index = np.asarray(value)
    _check_shape(field, index, of, sizes)
    if index.dtype.kind not in "iu":
        raise JaxbaError(f"{field} has type {index.dtype}; give integers counted from 0.")
    bad = np.flatnonzero((index < 0) | (index >= sizes[into]))
    if len(bad):
        owner = problem.image_label(int(bad[0])) if of == "images" else f"{of[:-1]} {bad[0]}"
        raise JaxbaError(
            f"{field}: {owner} refers to {into[:-1]} {index[bad[0]]}, but there are {sizes[into]} {into}, "
            f"counted from 0{_more(bad)}. Correct the index or leave the entry out."
        )


def _check_finite(field: str, value: Any, label: _Label) -> None:
    array = np.asarray(value)
    if not np.isfinite(array).all():
        _raise_entry(field, array, ~np.isfinite(array), label, "give a finite value or leave the entry out")
    if np.max(np.abs(array), initial=0.0) > _LARGEST:
        cure = f"correct it or leave the entry out: beyond {_LARGEST:g}, squares are no longer finite"
        _raise_entry(field, array, np.abs(array) > _LARGEST, label, cure)


def _check_positive(field: str, value: Any, label: _Label) -> None:
    array = np.asarray(value)
    if not (array > 0).all():
        _raise_entry(field, array, ~(array > 0), label, "a sigma must be positive")
    absurd = (array < 1 / _LARGEST) | (np.isfinite(array) & (array > _LARGEST))
    if absurd.any():
        cure = f"give a sigma from {1 / _LARGEST:g} to {_LARGEST:g}"
        _raise_entry(field, array, absurd, label, cure)


def _check_precision(field: str, value: np.ndarray, std: np.ndarray, label: _Label) -> None:
    """Refuse coordinates that have been float32 where its steps are coarser than their sigmas: 0.5 m at 4.6e6 m.

    What is float64 by now has been float32 where every coordinate of an axis is one that float32 has: of other numbers
    one in 500 million is. Whole numbers are all that an axis of true ones may hold by chance.
    """
    if not value.size or not np.max(np.abs(value)) <= _LARGEST or value.shape != std.shape:
        return
    step = np.spacing(np.abs(value).astype(np.float32)).astype(float)
    is_single = np.ones(value.shape[1], bool)
    if value.dtype == np.float64:
        is_single = np.all(value == value.astype(np.float32), axis=0)
        is_single &= np.any(value != np.round(value), axis=0) | np.all(step >= 2, axis=0)
    coarse = is_single & (step > std)
    if coarse.any():
        row, more = int(np.argwhere(coarse)[0][0]), _more(np.unique(np.argwhere(coarse)[:, 0]))
        raise JaxbaError(
            f"{field}: {label(row)}: {value[coarse][0]:.9g}{more} is rounded to steps of {step[coarse][0]:g} m, as "
            f"float32 is there, coarser than its sigma of {std[coarse][0]:g} m; subtract an origin near the block in "
            "float64 before, or give float64."
        )


def _check_quaternion(field: str, value: Any, label: _Label) -> None:
    _check_finite(field, value, label)
    norm = np.linalg.norm(np.asarray(value, float), axis=-1)
    bad = np.abs(norm - 1) > _QUATERNION_NORM
    if bad.any():
        _raise_entry(f"norm of {field}", norm, bad, label, "a rotation's is 1: normalise it")


def _raise_entry(field: str, array: np.ndarray, bad: np.ndarray, label: _Label, cure: str) -> None:
    where = np.argwhere(bad)
    rows = np.unique(where[:, 0])
    raise JaxbaError(f"{field}: {label(int(where[0][0]))} has {array[tuple(where[0])]:g}{_more(rows)}; {cure}.")


def _label(problem: Problem, kind: str) -> _Label:
    """How to call an entry of a kind in messages."""
    seen = problem.observations

    def observation(index: int) -> str:
        image = problem.image_label(int(seen.image_index[index]))
        return f"observation {index} (point {seen.point_index[index]} in {image})"

    if kind == "image":
        return problem.image_label
    return observation if kind == "observation" else lambda index: f"{kind} {index}"


def _more(bad: np.ndarray) -> str:
    return f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""


def _check_duplicates(problem: Problem) -> None:
    image, point = problem.observations.image_index, problem.observations.point_index
    key = np.asarray(image).astype(np.int64) * problem.num_points + np.asarray(point)
    ordered = key
    if not np.all(np.diff(key) > 0):
        ordered = np.sort(key)
    twice = np.unique(ordered[1:][np.diff(ordered) == 0])
    if len(twice):
        which = np.flatnonzero(key == twice[0])[:2]
        label = problem.image_label(int(twice[0] // problem.num_points))
        raise JaxbaError(
            f"observations {which[0]} and {which[1]}: point {twice[0] % problem.num_points} is measured twice in "
            f"{label}{_more(twice)}; keep one of them, or make two points."
        )


def _check_bounds(problem: Problem) -> None:
    names = type(problem.cameras).parameter_names()
    start = np.stack([np.asarray(getattr(problem.cameras, name), float) for name in names], axis=1)
    lower, upper = np.asarray(problem.lower), np.asarray(problem.upper)
    for camera, column in np.argwhere(~(lower < upper)):
        raise JaxbaError(
            f"bounds of {names[column]} of camera {camera}: {lower[camera, column]:g},{upper[camera, column]:g}; "
            "the lower bound must be below the upper one."
        )
    outside = np.asarray(problem.free.intrinsics) & ((start < lower) | (start > upper))
    for camera, column in np.argwhere(outside):
        raise JaxbaError(
            f"{names[column]} of camera {camera} starts at {start[camera, column]:g}, outside its bounds "
            f"{lower[camera, column]:g},{upper[camera, column]:g}; widen the bounds or change the start value."
        )


def _check_prior(problem: Problem, prior: AbstractPrior, sizes: Mapping[str, int]) -> None:
    """Check any prior from its fields: `<kind>_index` refers to a kind, `std...` is a sigma, all else are values."""
    check_loss(f"prior {prior.name}: loss", prior.loss)
    fields = [f for f in dataclasses.fields(prior) if f.name != "loss" and getattr(prior, f.name) is not None]
    values = {f.name: np.asarray(getattr(prior, f.name)) for f in fields}
    sizes = {**sizes, "rows": _length(values[fields[0].name])}
    indices = [name for name in values if name.endswith("_index")]
    index_name = indices[0] if indices else None
    kind = index_name.removesuffix("_index") if index_name else "row"
    label = _label(problem, kind)
    if index_name:
        index, of_kind = values[index_name], label
        _check_index(problem, f"prior {prior.name}: {index_name}", index, "rows", f"{kind}s", sizes)
        found, counts = np.unique(index, return_counts=True)
        twice = found[counts > 1]
        if len(twice):
            raise JaxbaError(
                f"prior {prior.name}: {label(int(twice[0]))} has more than one row{_more(twice)}; keep one of them."
            )
        label = lambda row: of_kind(int(index[row]))  # noqa: E731
    if prior.name == "scale_bar":
        _check_bars(problem, prior, values)
    if prior.name == "position_offset" and not indices:
        every = np.arange(sizes["rows"])
        _check_index(problem, f"prior {prior.name}: rows", every, "rows", "offsets", sizes)
    for name in indices[1:]:
        _check_index(problem, f"prior {prior.name}: {name}", values[name], "rows", f"{name[:-6]}s", sizes)
    for field in fields:
        if field.name.endswith("_index"):
            continue
        name, value = f"prior {prior.name}: {field.name}", values[field.name]
        _check_shape(name, value, _dims(field.type), sizes)
        if field.name == "xyz":
            _check_precision(name, value, values["std_m"], label)
        if field.name.startswith("std"):
            _check_positive(f"{name} (infinite where nothing is known)", value, label)
        elif field.name == "quaternion":
            _check_quaternion(name, value, label)
        else:
            _check_finite(f"{name} (any number where the sigma is infinite)", value, label)


def _check_bars(problem: Problem, prior: AbstractPrior, values: Mapping[str, np.ndarray]) -> None:
    if not isinstance(prior.loss, Linear):
        raise JaxbaError(
            f"prior scale_bar: loss {type(prior.loss).__name__}; it is to be Linear: two rows share what a bar is off, "
            "and a robust loss would judge each by its part. Test bars by statistics, and leave out a wrong one."
        )
    ends, offsets = values["offset_index"], _length(problem.position_offset)
    in_pairs = len(ends) % 2 == 0 and np.array_equal(values["end_index"], np.arange(len(ends)) % 2)
    are_last = np.array_equal(ends, np.arange(offsets - len(ends), offsets))
    if not (in_pairs and are_last and problem.free.position_offset):
        raise JaxbaError(
            "prior scale_bar: two rows, one after the other, are one bar, and the ends of all bars are the last rows "
            "of position_offset, which is free; make them by with_scale_bars."
        )


def _dims(annotation: Any) -> str:
    """The axes of a jaxtyping annotation such as `Float[Array | np.ndarray, "rows 3"]`."""
    return (typing.get_args(annotation) or (annotation,))[0].dim_str
