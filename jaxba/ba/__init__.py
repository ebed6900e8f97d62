"""The solver: problem, residual groups, normal equations, Schur reduction, solve."""

from jaxba.ba._check_gradients import GradientCheck, GradientRow, check_gradients
from jaxba.ba._covariance import Covariance, covariance
from jaxba.ba._gauge import free_gauge
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._problem import AbstractPrior, Free, Observations, Problem
from jaxba.ba._quality import GroupErrors, Quality, quality, reprojection_errors
from jaxba.ba._reject import Rejected, solve_and_reject
from jaxba.ba._rows import Rows, Step, Unknowns
from jaxba.ba._solution import HistoryStep, Report, Solution
from jaxba.ba._solve import solve
from jaxba.ba._solvers import SchurDogleg, SchurLevenbergMarquardt, residuals
from jaxba.ba._tune import Tuned, tune
from jaxba.ba.groups import (
    PRIORS,
    AttitudePrior,
    ControlPointPrior,
    IntrinsicsPrior,
    LeverArmPrior,
    PositionPrior,
)

__all__ = [
    "PRIORS",
    "AbstractPrior",
    "AttitudePrior",
    "ControlPointPrior",
    "Covariance",
    "Free",
    "GradientCheck",
    "GradientRow",
    "GroupErrors",
    "HistoryStep",
    "IntrinsicsPrior",
    "LeverArmPrior",
    "Observations",
    "Plan",
    "PositionPrior",
    "Problem",
    "Quality",
    "Rejected",
    "Report",
    "Rows",
    "SchurDogleg",
    "SchurLevenbergMarquardt",
    "Solution",
    "Step",
    "Tuned",
    "Unknowns",
    "check_gradients",
    "covariance",
    "free_gauge",
    "make_plan",
    "quality",
    "reprojection_errors",
    "residuals",
    "solve",
    "solve_and_reject",
    "tune",
]
