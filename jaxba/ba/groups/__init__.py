"""Residual groups: one file each. A new prior is one file and, where files are to hold it, one line in `PRIORS`."""

from jaxba.ba._problem import AbstractPrior
from jaxba.ba.groups._aspect import AspectPrior
from jaxba.ba.groups._attitude import AttitudePrior
from jaxba.ba.groups._control import ControlPointPrior
from jaxba.ba.groups._intrinsics import IntrinsicsPrior
from jaxba.ba.groups._lever_arm import LeverArmPrior
from jaxba.ba.groups._position import PositionPrior
from jaxba.ba.groups._position_offset import PositionOffsetPrior
from jaxba.ba.groups._reprojection import Reprojection
from jaxba.ba.groups._scale_bar import ScaleBarPrior

_IN_FILES = (
    PositionPrior, AttitudePrior, IntrinsicsPrior, ControlPointPrior, LeverArmPrior, PositionOffsetPrior, ScaleBarPrior,
)  # fmt: skip
PRIORS: dict[str, type[AbstractPrior]] = {prior.name: prior for prior in _IN_FILES}
"""Every prior that a file can hold, by name; `tile.npz` and messages are driven by this table."""

__all__ = [
    "PRIORS", "AspectPrior", "AttitudePrior", "ControlPointPrior", "IntrinsicsPrior", "LeverArmPrior",
    "PositionOffsetPrior", "PositionPrior", "Reprojection", "ScaleBarPrior",
]  # fmt: skip
