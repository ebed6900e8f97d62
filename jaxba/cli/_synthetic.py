"""`jaxba synthetic`: a synthetic survey as a tile, and the truth behind it as extras."""

from pathlib import Path

import numpy as np

from jaxba.cli._text import many
from jaxba.io import write_tile
from jaxba.simulation.synthetic import Truth, uav_block

_GNSS_STD_M = (0.03, 0.03, 0.06)


def run(
    out: Path,
    *,
    num_images: int,
    seed: int,
    outlier_fraction: float,
    num_cameras: int,
    points_per_image: float,
    pixel_std_px: float,
    num_control: int,
    gnss: bool,
) -> int:
    """Make the survey, write it and say so; return the exit code."""
    survey = uav_block(
        num_images,
        seed=seed,
        outlier_fraction=outlier_fraction,
        num_cameras=num_cameras,
        points_per_image=points_per_image,
        pixel_std_px=pixel_std_px,
        num_control=num_control,
        gnss_std_m=_GNSS_STD_M if gnss else None,
    )
    write_tile(out, survey.problem, extras=truth_arrays(survey.truth))
    problem = survey.problem
    print(
        f"{out}: {many(problem.num_images, 'image')}, {many(problem.num_points, 'point')}, "
        f"{many(problem.num_observations, 'observation')}, {np.count_nonzero(survey.truth.is_outlier)} of them outliers"
    )
    return 0


def truth_arrays(truth: Truth) -> dict[str, np.ndarray]:
    """Return the truth as extras of a tile, named like the arrays that they are the truth of."""
    cameras = truth.cameras
    columns = [np.atleast_1d(getattr(cameras, name)) for name in type(cameras).parameter_names()]
    return {
        "truth_pose_quaternion_wxyz": np.asarray(truth.poses.quaternion),
        "truth_pose_translation_m": np.asarray(truth.poses.translation),
        "truth_camera_parameters": np.stack(columns, axis=1),
        "truth_point_xyz_m": truth.points,
        "truth_observation_xy_px": truth.xy_px,
        "truth_lever_arm_m": truth.lever_arm,
        "truth_is_outlier": truth.is_outlier,
        "truth_gnss_is_outlier": truth.gnss_is_outlier,
        "truth_control_index": truth.control_index,
        "truth_check_index": truth.check_index,
    }
