"""Tables of an adjustment, for pandas: a row a measurement, units in the names of columns.

    observations: image, point, x_px, y_px, std_x_px, std_y_px, residual_x_px, ..., without_x_px, ..., redundancy_x,
                  ..., test_x, ..., detectable_x_px, ..., reach_x_m, ..., row_test, freedom, p_value, weight
    control:      point, std_x_m, ..., residual_x_m, ..., as above

and so for every prior, whose first columns say what each row is about; of scale bars each row is one bar. What the
other columns mean stands at the fields of `RowStatistics`. Residuals are adjusted minus measured.

    images, points: x_m, y_m, z_m of camera or point, std_x_m, ..., ellipse_a_m, ellipse_b_m, ellipse_azimuth_deg,
                    num_observations; images also camera and std_rot_x_rad, ... about the camera's axes
    cameras:        camera, parameter, value, std
    pairs:          image_1, image_2, num_points, distance_m, angle_deg: of images that have points in common, the
                    median angle at which their rays meet in these

The ellipse is that of one sigma in the x-y plane (39% of a normal distribution): semi-axes, and the azimuth of the
longer one from y (north) over x (east). Tables of a solution alone, whose sigmas nobody has computed, end the row of a
measurement at its residuals and have neither sigmas nor ellipses of images and points.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._projection import camera_centers, points_in_cam, project
from jaxba.ba.groups import ControlPointPrior

if TYPE_CHECKING:
    from pandas import DataFrame

    from jaxba.ba.uncertainty._covariance import Covariance
    from jaxba.ba.uncertainty._reliability import RowStatistics
    from jaxba.ba.uncertainty._variance_components import VarianceComponent
else:
    DataFrame = Any

_UNIT = {"std_m": "_m", "std_rad": "_rad"}  # by the field of a prior's sigmas


def observations_table(problem: Problem, rows: "RowStatistics | None") -> DataFrame:
    """Return a row for each observation."""
    import pandas as pd

    seen = problem.observations
    about = {
        "image": _images(problem, seen.image_index),
        "point": np.asarray(seen.point_index),
        "x_px": np.asarray(seen.xy_px)[:, 0],
        "y_px": np.asarray(seen.xy_px)[:, 1],
    }
    if rows is not None:
        return _table(about, rows, ("x", "y"), "_px")
    residual_px = project(problem, points_in_cam(problem), slice(None)).T - np.asarray(seen.xy_px)
    std_px = np.broadcast_to(np.asarray(seen.std_px)[:, None], residual_px.shape)
    return pd.DataFrame(about | _by_axis("std", std_px, "xy", "_px") | _by_axis("residual", residual_px, "xy", "_px"))


def control_table(problem: Problem) -> DataFrame:
    """Return a row for each control point; none without any."""
    import pandas as pd

    prior = next((prior for prior in problem.priors if isinstance(prior, ControlPointPrior)), None)
    index = np.zeros(0, int) if prior is None else np.asarray(prior.point_index)
    std_m, surveyed_m = (np.zeros((0, 3)),) * 2 if prior is None else (np.asarray(prior.std_m), np.asarray(prior.xyz))
    residual_m = np.where(np.isfinite(std_m), np.asarray(problem.points)[index] - surveyed_m, np.nan)
    about = {"point": index}
    return pd.DataFrame(about | _by_axis("std", std_m, "xyz", "_m") | _by_axis("residual", residual_m, "xyz", "_m"))


def prior_table(problem: Problem, prior: AbstractPrior, rows: "RowStatistics") -> DataFrame:
    """Return a row for each row of a prior."""
    about: dict[str, Any] = {}
    if prior.name == "scale_bar":
        bars = vars(prior)
        one, other = np.asarray(bars["point_index"]).reshape(-1, 2).T
        about = {"point_1": one, "point_2": other, "length_m": np.asarray(bars["length_m"])[::2]}
        return _table(about, rows, ("",), "_m")
    for kind in ("image", "point", "camera"):
        index = getattr(prior, f"{kind}_index", None)
        if index is not None:
            about[kind] = _images(problem, index) if kind == "image" else np.asarray(index)
    components = rows.std.shape[1]
    names = type(problem.cameras).parameter_names()
    axes = names if components == len(names) and hasattr(prior, "parameters") else ("x", "y", "z")
    unit = next((unit for field, unit in _UNIT.items() if hasattr(prior, field)), "")
    return _table(about, rows, axes if components > 1 else ("",), unit)


def images_table(problem: Problem, covariance: "Covariance | None") -> DataFrame:
    """Return a row for each image: its camera's place and orientation, and how well these are known."""
    import pandas as pd

    numbers = np.arange(problem.num_images)
    columns = {"image": _images(problem, numbers), "camera": np.asarray(problem.camera_index)}
    columns |= _places(camera_centers(problem.poses), None if covariance is None else covariance.centers)
    if covariance is not None:
        turns = np.sqrt(np.maximum(np.einsum("nii->ni", covariance.poses[:, :3, :3]), 0.0))
        columns |= _by_axis("std_rot", turns, "xyz", "_rad")
    seen = np.asarray(problem.observations.image_index)
    columns["num_observations"] = np.bincount(seen, minlength=problem.num_images)
    return pd.DataFrame(columns)


def points_table(problem: Problem, covariance: "Covariance | None") -> DataFrame:
    """Return a row for each point: where it lies, and how well that is known."""
    import pandas as pd

    columns = {"point": np.arange(problem.num_points)}
    columns |= _places(np.asarray(problem.points), None if covariance is None else covariance.points)
    seen = np.asarray(problem.observations.point_index)
    columns["num_observations"] = np.bincount(seen, minlength=problem.num_points)
    return pd.DataFrame(columns)


def cameras_table(problem: Problem, covariance: "Covariance") -> DataFrame:
    """Return a row for each parameter of each camera."""
    import pandas as pd

    names = type(problem.cameras).parameter_names()
    shape = problem.num_cameras, len(names)
    values = np.stack([np.broadcast_to(getattr(problem.cameras, name), shape[:1]) for name in names], axis=1)
    std = np.sqrt(np.maximum(np.einsum("nii->ni", covariance.intrinsics), 0.0))
    camera, parameter = np.indices(shape)
    return pd.DataFrame(
        {
            "camera": camera.ravel(),
            "parameter": np.array(names)[parameter.ravel()],
            "value": values.ravel(),
            "std": std.ravel(),
        }
    )


def pairs_table(problem: Problem) -> DataFrame:
    """Return a row for each pair of images that have points in common, by number of the first, then of the second."""
    import pandas as pd

    seen, centers = problem.observations, camera_centers(problem.poses)
    order = np.lexsort((np.asarray(seen.image_index), np.asarray(seen.point_index)))
    image, point = np.asarray(seen.image_index)[order], np.asarray(seen.point_index)[order]
    rays = np.asarray(problem.points, float)[point] - centers[image]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    parts = []
    for step in range(1, int(np.bincount(point).max(initial=0))):
        first = np.flatnonzero(point[step:] == point[:-step])
        cosine = np.sum(rays[first] * rays[first + step], axis=1)
        angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        parts.append(pd.DataFrame({"one": image[first], "other": image[first + step], "angle_deg": angle_deg}))
    none = pd.DataFrame({"one": np.zeros(0, int), "other": np.zeros(0, int), "angle_deg": np.zeros(0)})
    found = pd.concat([none, *parts]).groupby(["one", "other"])["angle_deg"].agg(["size", "median"]).reset_index()
    one, other = found["one"].to_numpy(), found["other"].to_numpy()
    return pd.DataFrame(
        {
            "image_1": _images(problem, one),
            "image_2": _images(problem, other),
            "num_points": found["size"],
            "distance_m": np.linalg.norm(centers[one] - centers[other], axis=1),
            "angle_deg": found["median"],
        }
    )


def _places(xyz_m: np.ndarray, covariance_m2: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return the columns of places: coordinates, and where these are known sigmas and the ellipse in the x-y plane."""
    columns = {f"{axis}_m": xyz_m[:, k] for k, axis in enumerate("xyz")}
    if covariance_m2 is None:
        return columns
    columns |= _by_axis("std", np.sqrt(np.maximum(np.einsum("nii->ni", covariance_m2), 0.0)), "xyz", "_m")
    values, vectors = np.linalg.eigh(covariance_m2[:, :2, :2])
    semi_axes = np.sqrt(np.maximum(values, 0.0))
    columns |= {"ellipse_a_m": semi_axes[:, 1], "ellipse_b_m": semi_axes[:, 0]}
    columns["ellipse_azimuth_deg"] = np.degrees(np.arctan2(vectors[:, 0, 1], vectors[:, 1, 1])) % 180.0
    return columns


def components_table(components: "tuple[VarianceComponent, ...]") -> DataFrame:
    """Return a row for each variance component."""
    import pandas as pd

    names = ("name", "count", "redundancy", "factor", "factor_std", "stated_std", "std", "is_known")
    return pd.DataFrame([{name: getattr(component, name) for name in names} for component in components])


def _images(problem: Problem, index: Any) -> np.ndarray:
    """Return the images' names, their numbers where they have none."""
    index = np.asarray(index)
    return np.array(problem.image_names)[index] if problem.image_names else index


def _by_axis(name: str, values: np.ndarray, axes: Sequence[str], unit: str) -> dict[str, np.ndarray]:
    return {f"{name}{f'_{axis}' if axis else ''}{unit}": values[:, k] for k, axis in enumerate(axes)}


def _table(about: dict[str, Any], rows: "RowStatistics", axes: tuple[str, ...], unit: str) -> DataFrame:
    import pandas as pd  # 0.3 s

    columns = dict(about)
    for name, values, unit_of in (
        ("std", rows.std, unit),
        ("residual", rows.residual, unit),
        ("without", rows.without, unit),
        ("redundancy", rows.redundancy, ""),
        ("test", rows.test, ""),
        ("detectable", rows.detectable, unit),
        ("reach", rows.reach_m, "_m"),
    ):
        columns |= _by_axis(name, values, axes, unit_of)
    columns |= {"row_test": rows.row_test, "freedom": rows.freedom, "p_value": rows.p_value, "weight": rows.weight}
    return pd.DataFrame(columns)
