"""Geometry in pure jax: rotations, poses, cameras, robust losses, triangulation."""

from jaxba.geometry._cameras import (
    BAL,
    CAMERAS,
    AbstractCamera,
    OpenCV,
    OpenCVFisheye,
    Pinhole,
    Radial,
    SimplePinhole,
    SimpleRadial,
)
from jaxba.geometry._losses import (
    LOSSES,
    AbstractLoss,
    Arctan,
    Barron,
    Cauchy,
    GemanMcClure,
    Huber,
    Linear,
    SoftL1,
    Tukey,
    check_loss,
)
from jaxba.geometry._numbers import require_number
from jaxba.geometry._pose import Pose, se3_exp, se3_log
from jaxba.geometry._rotation import (
    hat,
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_from_matrix,
    quaternion_log,
    quaternion_multiply,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
)
from jaxba.geometry._similarity import Similarity, umeyama
from jaxba.geometry._triangulate import Triangulation, refine_point, triangulate, triangulate_two_view

__all__ = [
    "BAL", "CAMERAS", "LOSSES", "AbstractCamera", "AbstractLoss", "Arctan", "Barron", "Cauchy", "GemanMcClure", "Huber",
    "Linear", "OpenCV", "OpenCVFisheye", "Pinhole", "Pose", "Radial", "Similarity", "SimplePinhole", "SimpleRadial",
    "SoftL1", "Triangulation", "Tukey", "check_loss", "hat", "matrix_from_quaternion", "quaternion_conjugate",
    "quaternion_exp", "quaternion_from_matrix", "quaternion_log", "quaternion_multiply", "refine_point",
    "require_number", "se3_exp", "se3_log", "so3_exp", "so3_left_jacobian_inverse", "so3_log", "triangulate",
    "triangulate_two_view", "umeyama",
]  # fmt: skip
