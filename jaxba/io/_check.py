"""Checks of a tile's arrays against the schema; every message names the array, what was found and what was expected."""

import difflib
from collections.abc import Iterable, Mapping

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.io._schema import EXTRA, ArraySpec, Kind, all_specs, shape_text

_ACCEPTED: dict[Kind, str] = {"float64": "fiu", "int32": "iu", "bool": "b", "str": "U"}
"""numpy's kinds of types that convert to the schema's without loss."""
_CURE: dict[Kind, str] = {
    "float64": "use numpy.float64",
    "int32": "use numpy.int32",
    "bool": "use numpy.bool_",
    "str": "use numpy.array of str, not of bytes or objects",
}
_UNIT_NORM_TOLERANCE = 1e-6  # quaternions that were float32 are unit to 1e-7


def check_arrays(
    arrays: Mapping[str, np.ndarray], specs: Iterable[ArraySpec], sizes: Mapping[str, int], label: str
) -> dict[str, np.ndarray]:
    """Return the arrays of `specs` in the schema's types, those left out filled with their defaults ("" stays out).

    `sizes` are known already; the others follow from the first array that has them. `label` names the file in messages.

    Raises:
        JaxbaError: arrays that are missing, of a wrong type or shape, indices out of range, quaternions not unit.
    """
    specs = tuple(specs)
    missing = [spec for spec in specs if spec.default is None and spec.name not in arrays]
    if missing:
        listed = "; ".join(f"{spec.name} {shape_text(spec.shape)} {spec.kind}" for spec in missing)
        raise JaxbaError(f"{label}: arrays are missing, add them: {listed}.")
    known: dict[str | int, int] = {"ends": 2, **sizes}  # of a scale bar
    source: dict[str | int, str] = dict.fromkeys(sizes, "camera_model")
    checked = {}
    for spec in specs:
        if spec.name in arrays:
            array = checked[spec.name] = _in_kind(arrays[spec.name], spec, label)
            if array.ndim == len(spec.shape):
                for size, length in zip(spec.shape, array.shape, strict=True):
                    if isinstance(size, str) and size not in known:
                        known[size], source[size] = length, spec.name
            expected = tuple(known.get(size, size) for size in spec.shape)
            if array.shape != expected:
                given = ", ".join(f"{known[s]} {s} by {source[s]}" for s in dict.fromkeys(spec.shape) if s in known)
                raise JaxbaError(
                    f"{label}: {spec.name} has the shape {array.shape}, expected {shape_text(spec.shape)} = {expected}"
                    f"{' with ' + given if given else ''}; correct the array."
                )
    for spec in specs:
        if spec.name in checked:
            _check_values(checked[spec.name], spec, known, label)
        elif spec.default != "":
            shape = [known[size] if isinstance(size, str) else size for size in spec.shape]
            checked[spec.name] = np.full(shape, spec.default)
    return checked


def check_names(names: Iterable[str], label: str) -> None:
    """Raise a `JaxbaError` for a name that is not in the schema, with the nearest that is."""
    known = {spec.name for spec in all_specs()}
    for name in names:
        if name not in known and not name.startswith(EXTRA):
            near = difflib.get_close_matches(name, known, n=1)
            hint = f" (is it {near[0]!r}?)" if near else ""
            raise JaxbaError(
                f"{label}: array {name!r} is not in the schema{hint}; rename it, or begin its name with {EXTRA!r} "
                "to carry it along unread."
            )


def _in_kind(array: np.ndarray, spec: ArraySpec, label: str) -> np.ndarray:
    """Return the array in the schema's type, where that loses nothing."""
    fits = array.dtype.kind in _ACCEPTED[spec.kind]
    if fits and spec.kind == "int32" and array.size:
        info = np.iinfo(np.int32)
        fits = bool(array.min() >= info.min and array.max() <= info.max)
    if not fits:
        raise JaxbaError(f"{label}: {spec.name} has the type {array.dtype}, expected {spec.kind}: {_CURE[spec.kind]}.")
    return array if spec.kind == "str" else array.astype(spec.kind, copy=False)


def _check_values(array: np.ndarray, spec: ArraySpec, known: Mapping[str | int, int], label: str) -> None:
    if spec.indexes:
        count = known.get(spec.indexes, 0)  # of offsets there may be none
        bad = np.flatnonzero((array < 0) | (array >= count))
        if bad.size:
            raise JaxbaError(
                f"{label}: {spec.name}[{bad[0]}] is {array[bad[0]]}, but {spec.indexes} go from 0 to "
                f"{count - 1}; correct it ({bad.size} of {array.size} are out of range)."
            )
    if spec.unit_norm:
        with np.errstate(over="ignore"):
            norm = np.linalg.norm(array, axis=-1)
        bad = np.flatnonzero(~(np.abs(norm - 1) <= _UNIT_NORM_TOLERANCE))
        if bad.size:
            raise JaxbaError(
                f"{label}: {spec.name}[{bad[0]}] has the norm {norm[bad[0]]:.6g}, expected 1; "
                f"divide each quaternion (scalar first) by its norm ({bad.size} of {norm.size} are wrong)."
            )
