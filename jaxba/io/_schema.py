"""The schema of `tile.npz`: each array's name, shape, type, unit and frame, in one table for reader and README.

A tile holds every part of a `Problem` in plain arrays, so that any program can write one with `numpy.savez` alone.
Shapes are symbolic: images, cameras, points, observations, and parameters (of the camera model). The arrays of priors
follow from the fields of the classes in `PRIORS` and `LOSSES`: a new prior is in the schema by itself.
"""

import dataclasses
from typing import Any, Literal, get_args

import numpy as np

from jaxba.ba import PRIORS
from jaxba.geometry import CAMERAS, LOSSES

SCHEMA_NAME = "jaxba.tile"
VERSION = 1
OBSERVATION_LOSS = "observation_loss"
EXTRA = "extra_"
"""Arrays whose names begin like this are carried by a tile and not read."""

Kind = Literal["float64", "int32", "bool", "str"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArraySpec:
    """One array of a tile.

    - `shape`: numbers and names of sizes.
    - `default`: the value of every element where the array is left out; None: it is needed; "": nothing then.
    - `indexes`: the size that bounds its values, where they are indices. `unit_norm`: rows are unit quaternions.
    """

    name: str
    shape: tuple[str | int, ...]
    kind: Kind
    unit: str = ""
    frame: str = ""
    default: float | bool | str | None = None
    meaning: str
    indexes: str = ""
    unit_norm: bool = False


SCHEMA: tuple[ArraySpec, ...] = (
    ArraySpec(name="schema", shape=(), kind="str", meaning=f"`{SCHEMA_NAME}`"),
    ArraySpec(name="version", shape=(), kind="int32", meaning=f"{VERSION}"),
    ArraySpec(name="camera_model", shape=(), kind="str", meaning="one of " + ", ".join(f"`{n}`" for n in CAMERAS)),
    ArraySpec(
        name="pose_quaternion_wxyz", shape=("images", 4), kind="float64", unit="1", frame="cam_from_world",
        meaning="rotation of each image, unit quaternion, scalar first", unit_norm=True,
    ),
    ArraySpec(
        name="pose_translation_m", shape=("images", 3), kind="float64", unit="m", frame="camera",
        meaning="t in x_cam = R x_world + t; not the camera's position",
    ),
    ArraySpec(
        name="camera_parameters", shape=("cameras", "parameters"), kind="float64", unit="px, 1", frame="image",
        meaning="intrinsics in the model's order: " + "; ".join(
            f"{name}: {', '.join(model.parameter_names())}" for name, model in CAMERAS.items()
        ),
    ),
    ArraySpec(
        name="camera_parameter_names", shape=("parameters",), kind="str", default="",
        meaning="names of the intrinsics, compared with the model's where given",
    ),
    ArraySpec(
        name="camera_index", shape=("images",), kind="int32", indexes="cameras",
        meaning="camera of each image; zeros where all share one",
    ),
    ArraySpec(name="point_xyz_m", shape=("points", 3), kind="float64", unit="m", frame="world", meaning="points"),
    ArraySpec(
        name="observation_xy_px", shape=("observations", 2), kind="float64", unit="px", frame="image",
        meaning="measured pixel; the centre of the first pixel is (0.5, 0.5) (`BAL`: from the image's centre, y down)",
    ),
    ArraySpec(
        name="observation_std_px", shape=("observations",), kind="float64", unit="px", frame="image", default=1.0,
        meaning="standard deviation of each coordinate",
    ),
    ArraySpec(
        name="observation_image_index", shape=("observations",), kind="int32", indexes="images",
        meaning="image of each observation",
    ),
    ArraySpec(
        name="observation_point_index", shape=("observations",), kind="int32", indexes="points",
        meaning="point of each observation",
    ),
    ArraySpec(
        name="free_poses", shape=("images",), kind="bool", default=True, meaning="true: the adjustment may change it"
    ),
    ArraySpec(name="free_points", shape=("points",), kind="bool", default=True, meaning="the same for points"),
    ArraySpec(
        name="free_intrinsics", shape=("cameras", "parameters"), kind="bool", default=True,
        meaning="the same for each intrinsic of each camera",
    ),
    ArraySpec(name="free_lever_arm", shape=(), kind="bool", default=False, meaning="the same for the lever arm"),
    ArraySpec(
        name="free_position_offset", shape=(), kind="bool", default=False, meaning="the same for the position offset"
    ),
    ArraySpec(
        name="bounds_lower", shape=("cameras", "parameters"), kind="float64", unit="px, 1", frame="image",
        default=-np.inf, meaning="lower bounds on the intrinsics",
    ),
    ArraySpec(
        name="bounds_upper", shape=("cameras", "parameters"), kind="float64", unit="px, 1", frame="image",
        default=np.inf, meaning="upper bounds on the intrinsics",
    ),
    ArraySpec(
        name="lever_arm_m", shape=(3,), kind="float64", unit="m", frame="camera", default=0.0,
        meaning="from the camera's centre to the GNSS antenna, shared by all images",
    ),
    ArraySpec(
        name="position_offset_m", shape=("offsets", 3), kind="float64", unit="m", frame="world", default="",
        meaning="what measured positions have in common beside their errors, measured minus true: a row for all, or "
        "one a flight",
    ),
    ArraySpec(name="image_names", shape=("images",), kind="str", default="", meaning="names for messages"),
)  # fmt: skip
"""The arrays of every tile; those of priors and losses come from `prior_specs` and `loss_specs`."""

_PRIOR_FIELDS = {
    "xyz": ("m", "world", "measured position (position: of the antenna; control: of the point)"),
    "lever_arm_xyz": ("m", "camera", "measured lever arm"),
    "position_offset_xyz": ("m", "world", "expected offset, mostly zero"),
    "offset_weights": ("1", "", "by which each position offset counts in each row; 1 where it is left out"),
    "position_offset_offset_index": ("", "", "position offset of each row; in their order where it is left out"),
    "scale_bar_offset_index": ("", "", "end of the bar, a row of position_offset_m: the last ones"),
    "scale_bar_end_index": ("", "", "0 in the row of a bar's first end, 1 in that of its second"),
    "scale_bar_xyz": ("m", "world", "what the end is counted from"),
    "scale_bar_other_xyz": ("m", "world", "the same of the bar's other end"),
    "scale_bar_length_m": ("m", "", "length of the bar, the same in both rows"),
    "scale_bar_std_m": ("m", "", "standard deviation of the length"),
    "std_m": ("m", "that of xyz", "standard deviation an axis; infinite where it is not measured"),
    "quaternion": ("1", "cam_from_world", "measured rotation, unit quaternion, scalar first"),
    "std_rad": ("rad", "camera", "standard deviation about each axis"),
    "parameters": ("px, 1", "image", "calibrated intrinsics, in the model's order"),
    "std": ("px, 1", "image", "standard deviation of each; infinite where it is not known"),
}
"""Unit, frame and meaning by `<prior>_<field>` or `<field>`; a field not named here has its unit in its own name."""


def all_specs() -> tuple[ArraySpec, ...]:
    """Return every array that a tile may hold."""
    of_priors = (spec for name in PRIORS for spec in (*prior_specs(name), *loss_specs(loss_of(name))))
    return (*SCHEMA, *loss_specs(OBSERVATION_LOSS), *of_priors)


def loss_of(prior: str) -> str:
    """Return the name of the array that names a prior's loss."""
    return f"prior_{prior}_loss"


def prior_specs(name: str) -> tuple[ArraySpec, ...]:
    """Return the arrays of one prior, without its loss."""
    return tuple(_prior_spec(name, f) for f in dataclasses.fields(PRIORS[name]) if f.name != "loss")


def loss_specs(prefix: str) -> tuple[ArraySpec, ...]:
    """Return the arrays of one loss: its name, and the parameters of all losses.

    - `prefix`: the first array's name, with which those of the others begin.
    """
    names = ", ".join(f"`{loss}`" for loss in LOSSES)
    specs = [ArraySpec(name=prefix, shape=(), kind="str", default="linear", meaning=f"robust loss, one of {names}")]
    defaults: dict[str, dict[str, Any]] = {}  # by parameter, then by loss
    for loss, cls in LOSSES.items():
        for field in dataclasses.fields(cls):
            defaults.setdefault(field.name, {})[loss] = field.default
    for parameter, having in defaults.items():
        specs.append(
            ArraySpec(
                name=f"{prefix}_{parameter}",
                shape=(),
                kind="float64",
                unit="sigma" if parameter == "f_scale" else "1",
                default=float(next(iter(having.values()))),
                meaning="of " + ("every loss" if len(having) == len(LOSSES) else ", ".join(f"`{n}`" for n in having)),
            )
        )
    return tuple(specs)


def schema_markdown() -> str:
    """Return the schema as a table in markdown, for the README of `jaxba.io`.

    >>> print(schema_markdown().splitlines()[0])
    | array | shape | dtype | unit | frame | default | meaning |
    """
    of_priors = (spec for name in PRIORS for spec in prior_specs(name))
    specs = [*SCHEMA, *loss_specs(OBSERVATION_LOSS), *of_priors, *loss_specs(loss_of("*"))]
    rows = [(f"`{s.name}`", shape_text(s.shape), s.kind, s.unit, s.frame, _default_text(s), s.meaning) for s in specs]
    header = ("array", "shape", "dtype", "unit", "frame", "default", "meaning")
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _prior_spec(prior: str, field: dataclasses.Field) -> ArraySpec:
    """Return one array of a prior, its shape and type those of the field's annotation."""
    annotation = get_args(field.type)[0]  # of Float[Array | np.ndarray, "rows 3"], its half for jax
    dims = [int(dim) if dim.isdigit() else dim for dim in annotation.dim_str.split()]
    kinds: tuple[Kind, ...] = ("float64", "int32", "bool")
    stem, _, last = field.name.rpartition("_")
    fallback = (last if last in ("m", "px", "rad") else "", "", str(PRIORS[prior].__doc__).splitlines()[0])
    if last == "index":
        fallback = ("", "", f"{stem} of each row")
    unit, frame, meaning = _PRIOR_FIELDS.get(f"{prior}_{field.name}", _PRIOR_FIELDS.get(field.name, fallback))
    return ArraySpec(
        name=f"prior_{prior}_{field.name}",
        shape=tuple(f"{prior}_rows" if dim == "rows" else dim for dim in dims),
        kind=next(kind for kind in kinds if kind in annotation.dtypes),
        unit=unit,
        frame=frame,
        default=None if field.default is dataclasses.MISSING else "",
        meaning=meaning,
        indexes=f"{stem}s" if last == "index" else "",
        unit_norm=field.name.startswith("quaternion"),
    )


def shape_text(shape: tuple[str | int, ...]) -> str:
    """Return a shape as a tuple of names and numbers is written."""
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


def _default_text(spec: ArraySpec) -> str:
    if spec.default is None:
        return "needed with its prior" if spec.name.startswith("prior_") else "needed"
    if spec.default == "":
        return "none"
    return {"True": "true", "False": "false"}.get(str(spec.default), f"{spec.default}")
