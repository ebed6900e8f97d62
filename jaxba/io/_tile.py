"""`tile.npz`: every part of a `Problem` in a documented, versioned file of plain arrays (its schema: `_schema.py`).

Equal problems give the same bytes: arrays are converted to the schema's types and written in its order, priors in that
of `PRIORS`. The reader refuses other versions, and arrays that it does not know, rather than guess.
"""

import dataclasses
import os
from collections.abc import Mapping

import numpy as np

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError
from jaxba.ba import PRIORS, AbstractPrior, Free, Observations, Problem
from jaxba.geometry import CAMERAS, LOSSES, AbstractLoss, Pose, check_loss
from jaxba.io._check import check_arrays, check_names
from jaxba.io._npz import read_npz, write_npz
from jaxba.io._read import read_bytes
from jaxba.io._schema import (
    EXTRA,
    OBSERVATION_LOSS,
    SCHEMA,
    SCHEMA_NAME,
    VERSION,
    all_specs,
    loss_of,
    loss_specs,
    prior_specs,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Contents:
    """What a file holds.

    - `loss`: robust loss that its observations are to be adjusted under; None where it says nothing.
    - `extras`: further arrays of a tile, by their names without `extra_`.
    """

    problem: Problem
    loss: AbstractLoss | None = None
    extras: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


def read_tile(path: str | os.PathLike[str]) -> Problem:
    """Return the problem in a tile; its loss (`read_loss`) and arrays named `extra_...` are left unread.

    Raises:
        JaxbaError: the file is missing, truncated or damaged; another schema or version; arrays that are missing,
            unknown, of a wrong type or shape, or with indices out of range.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "tile.npz")
    >>> np.savez(
    ...     path, schema="jaxba.tile", version=1, camera_model="SIMPLE_PINHOLE",
    ...     pose_quaternion_wxyz=[[1.0, 0, 0, 0]], pose_translation_m=[[0.0, 0, 0]],
    ...     camera_parameters=[[800.0, 320, 240]], camera_index=[0], point_xyz_m=[[0.0, 0, 50]],
    ...     observation_xy_px=[[320.5, 239]], observation_image_index=[0], observation_point_index=[0],
    ... )
    >>> read_tile(path).observations.std_px.tolist()
    [1.0]
    """
    return tile_of_bytes(read_bytes(path), os.fspath(path)).problem


def read_loss(path: str | os.PathLike[str]) -> AbstractLoss | None:
    """Return the robust loss that a tile names for its observations, as `solve` takes it; None where it names none.

    Raises `JaxbaError` as `read_tile` does.

    >>> import pathlib, tempfile
    >>> import jaxba
    >>> path = pathlib.Path(tempfile.mkdtemp(), "tile.npz")
    >>> jaxba.write_tile(path, jaxba.synthetic.uav_block(8).problem, loss=jaxba.Huber(1.5))
    >>> jaxba.read_loss(path)
    Huber(f_scale=1.5)
    """
    return tile_of_bytes(read_bytes(path), os.fspath(path)).loss


def tile_of_bytes(data: bytes, label: str) -> Contents:
    """Return what the bytes of a tile hold.

    `label` names the file in messages. Raises `JaxbaError` as `read_tile` does.
    """
    arrays = read_npz(data, label)
    extras = {name.removeprefix(EXTRA): array for name, array in arrays.items() if name.startswith(EXTRA)}
    checked = _checked(arrays, label)
    loss = _loss(OBSERVATION_LOSS, checked) if OBSERVATION_LOSS in arrays else None
    return Contents(_problem_from_arrays(checked), loss, extras)


def write_tile(
    path: str | os.PathLike[str],
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    extras: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a problem, whole or not at all; `read_tile` returns it exactly.

    - `loss`: robust loss that its observations are to be adjusted under; `read_loss` returns it, `jaxba solve` uses it.
    - `extras`: further arrays for other programs, e.g. an inlier mask: each is written as `extra_<name>`.

    Raises:
        JaxbaError: a camera model, prior or loss without a name in files, arrays that contradict each other, an extra
            that holds Python objects; or the file cannot be written.

    >>> import pathlib, tempfile
    >>> from jaxba.geometry import Pinhole
    >>> observations = Observations(np.zeros((1, 2)), np.ones(1), np.zeros(1, int), np.zeros(1, int))
    >>> pose = Pose(np.eye(4)[:1], np.zeros((1, 3)))
    >>> problem = Problem.build(pose, Pinhole(800.0, 800.0, 320.0, 240.0), np.ones((1, 3)), observations)
    >>> write_tile(pathlib.Path(tempfile.mkdtemp(), "tile.npz"), problem)
    """
    label = os.fspath(path)
    arrays = arrays_of(problem, label, loss)
    for name, extra in (extras or {}).items():
        arrays[EXTRA + name] = np.asarray(extra)
        if arrays[EXTRA + name].dtype.hasobject:
            raise JaxbaError(f"{label}: extra {name!r} holds Python objects; give numbers, booleans or strings.")
    with write_atomically(path) as file:
        write_npz(file, arrays)


def arrays_of(problem: Problem, label: str, loss: AbstractLoss | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of a problem as a tile holds them; `label` names the file, which is not written, in messages.

    Raises `JaxbaError` as `write_tile` does.
    """
    arrays = _arrays_from_problem(problem, label, loss)
    checked = _checked(arrays, f"{label}, not written")
    return {name: checked[name] for name in arrays}


def _checked(arrays: Mapping[str, np.ndarray], label: str) -> dict[str, np.ndarray]:
    """Return the arrays of a problem in the schema's types, defaults filled in, everything about them checked."""
    _check_version(arrays, label)
    check_names(arrays, label)
    specs = [*SCHEMA, *loss_specs(OBSERVATION_LOSS)]
    for name in PRIORS:
        specs_of_prior = (*prior_specs(name), *loss_specs(loss_of(name)))
        if any(spec.name in arrays for spec in specs_of_prior):
            specs += specs_of_prior
    model = _choice(arrays, "camera_model", CAMERAS, label)
    names = CAMERAS[model].parameter_names()
    given = arrays.get("camera_parameter_names")
    if given is not None and given.tolist() != list(names):
        raise JaxbaError(
            f"{label}: camera_parameter_names are {given.tolist()}, but {model} has {list(names)}; reorder the columns "
            "of camera_parameters, or add zeros for those that are missing."
        )
    checked = check_arrays(arrays, specs, {"parameters": len(names)}, label)
    alone = [spec.name for spec in loss_specs(OBSERVATION_LOSS)[1:] if spec.name in arrays]
    if alone and OBSERVATION_LOSS not in arrays:
        raise JaxbaError(
            f"{label}: {alone[0]} is given, but no {OBSERVATION_LOSS}; name the loss, or remove the array."
        )
    for prefix in (OBSERVATION_LOSS, *map(loss_of, PRIORS)):
        if prefix not in checked:
            continue
        loss = _choice(checked, prefix, LOSSES, label)
        parameters = _parameters(LOSSES[loss])
        for spec in loss_specs(prefix)[1:]:
            if spec.name in arrays and spec.name.removeprefix(f"{prefix}_") not in parameters:
                raise JaxbaError(
                    f"{label}: {spec.name} is given, but {loss} has {', '.join(parameters)} only; remove the array."
                )
        for parameter in parameters:
            array = f"{prefix}_{parameter}"
            try:
                check_loss("loss", LOSSES[loss](**{parameter: checked[array].item()}))
            except JaxbaError as error:
                raise JaxbaError(f"{label}: {array}: {error}") from error
    return checked


def _problem_from_arrays(a: Mapping[str, np.ndarray]) -> Problem:
    """Return the problem in checked arrays."""
    columns = (np.ascontiguousarray(column) for column in a["camera_parameters"].T)
    return Problem(
        poses=Pose(a["pose_quaternion_wxyz"], a["pose_translation_m"]),
        cameras=CAMERAS[a["camera_model"].item()](*columns),
        camera_index=a["camera_index"],
        points=a["point_xyz_m"],
        observations=Observations(
            a["observation_xy_px"],
            a["observation_std_px"],
            a["observation_image_index"],
            a["observation_point_index"],
        ),
        priors=tuple(_prior(name, a) for name in PRIORS if loss_of(name) in a),
        lever_arm=a["lever_arm_m"],
        free=Free(**{field.name: a[f"free_{field.name}"] for field in dataclasses.fields(Free)}),
        lower=a["bounds_lower"],
        upper=a["bounds_upper"],
        image_names=tuple(a["image_names"].tolist()) if "image_names" in a else (),
        position_offset=a.get("position_offset_m", np.zeros((0, 3))),
    )


def _check_version(arrays: Mapping[str, np.ndarray], label: str) -> None:
    """Check what must be known before anything else may be judged."""
    if "schema" not in arrays or "version" not in arrays:
        found = ", ".join(list(arrays)[:5]) or "none"
        raise JaxbaError(
            f"{label}: is not a tile, it lacks the arrays schema = '{SCHEMA_NAME}' and version = {VERSION} "
            f"(it has {found}); add them."
        )
    schema, version = arrays["schema"], arrays["version"]
    if schema.shape or schema.item() != SCHEMA_NAME:
        raise JaxbaError(f"{label}: schema is {schema.tolist()!r}, expected '{SCHEMA_NAME}'; give a tile.")
    if version.shape or version.dtype.kind not in "iu" or version.item() != VERSION:
        raise JaxbaError(
            f"{label}: version is {version.tolist()!r}, this jaxba reads version {VERSION} (an integer); "
            "update jaxba, or write the tile in that version."
        )


def _choice(arrays: Mapping[str, np.ndarray], name: str, choices: Mapping[str, object], label: str) -> str:
    """Return the value of a scalar string array that must be one of `choices`."""
    if name not in arrays:
        raise JaxbaError(f"{label}: arrays are missing, add them: {name} () str, one of {', '.join(choices)}.")
    value = arrays[name].tolist()
    if not isinstance(value, str) or value not in choices:
        raise JaxbaError(f"{label}: {name} is {value!r}; use one of {', '.join(choices)}.")
    return value


def _prior(name: str, a: Mapping[str, np.ndarray]) -> AbstractPrior:
    values = {spec.name.removeprefix(f"prior_{name}_"): a[spec.name] for spec in prior_specs(name) if spec.name in a}
    return PRIORS[name](**values, loss=_loss(loss_of(name), a))


def _loss(prefix: str, a: Mapping[str, np.ndarray]) -> AbstractLoss:
    loss = LOSSES[a[prefix].item()]
    return loss(**{parameter: a[f"{prefix}_{parameter}"].item() for parameter in _parameters(loss)})


def _parameters(loss: type[AbstractLoss]) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(loss))


def _loss_values(prefix: str, loss: AbstractLoss, label: str) -> dict[str, object]:
    parameters = {f"{prefix}_{parameter}": getattr(loss, parameter) for parameter in _parameters(type(loss))}
    return {prefix: _name_of(type(loss), LOSSES, label), **parameters}


def _arrays_from_problem(problem: Problem, label: str, loss: AbstractLoss | None) -> dict[str, np.ndarray]:
    """Return the arrays of a problem in the schema's types and order."""
    names = type(problem.cameras).parameter_names()
    columns = [np.broadcast_to(getattr(problem.cameras, name), (problem.num_cameras,)) for name in names]
    observations, free = problem.observations, problem.free
    values: dict[str, object] = {
        "schema": SCHEMA_NAME,
        "version": VERSION,
        "camera_model": _name_of(type(problem.cameras), CAMERAS, label),
        "pose_quaternion_wxyz": problem.poses.quaternion,
        "pose_translation_m": problem.poses.translation,
        "camera_parameters": np.stack(columns, axis=1),
        "camera_parameter_names": names,
        "camera_index": problem.camera_index,
        "point_xyz_m": problem.points,
        "observation_xy_px": observations.xy_px,
        "observation_std_px": observations.std_px,
        "observation_image_index": observations.image_index,
        "observation_point_index": observations.point_index,
        "free_poses": free.poses,
        "free_points": free.points,
        "free_intrinsics": free.intrinsics,
        "free_lever_arm": free.lever_arm,
        "bounds_lower": problem.lower,
        "bounds_upper": problem.upper,
        "lever_arm_m": problem.lever_arm,
    }
    if len(problem.position_offset):
        values |= {"free_position_offset": free.position_offset, "position_offset_m": problem.position_offset}
    if loss is not None:
        values |= _loss_values(OBSERVATION_LOSS, loss, label)
    if problem.image_names:
        values["image_names"] = problem.image_names
    for prior in problem.priors:
        prefix = f"prior_{_name_of(type(prior), PRIORS, label)}"
        if f"{prefix}_loss" in values:
            raise JaxbaError(f"{label}: two priors named {prior.name!r}; a tile holds one, concatenate their rows.")
        for spec in prior_specs(prior.name):
            value = getattr(prior, spec.name.removeprefix(f"{prefix}_"))
            if value is not None:
                values[spec.name] = value
        values |= _loss_values(loss_of(prior.name), prior.loss, label)
    order = [spec.name for spec in all_specs() if spec.name in values]
    return {name: np.asarray(values[name]) for name in order}


def _name_of(cls: type, table: Mapping[str, type], label: str) -> str:
    """Return the name that files use for a class."""
    for name, known in table.items():
        if cls is known:
            return name
    known_names = ", ".join(known.__name__ for known in table.values())
    raise JaxbaError(f"{label}: {cls.__name__} has no name in files; use one of {known_names}.")
