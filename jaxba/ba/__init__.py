"""The solver: problem, residual groups, normal equations, Schur reduction, solve."""

from jaxba.ba._check_gradients import GradientCheck, GradientRow, check_gradients
from jaxba.ba._compiler import fast_jit
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._problem import AbstractPrior, Free, Observations, Problem
from jaxba.ba._projection import camera_centers, project_in_cameras
from jaxba.ba._quality import GroupErrors, Quality, quality, reprojection_errors
from jaxba.ba._reject import Rejected, rejecting, solve_and_reject
from jaxba.ba._reweighting import loss_derivatives
from jaxba.ba._rows import JacobianBlock, Rows
from jaxba.ba._scale_bars import with_scale_bars
from jaxba.ba._solution import HistoryStep, Report, Solution
from jaxba.ba._solve import solve
from jaxba.ba._solvers import SchurDogleg, SchurLevenbergMarquardt, residuals
from jaxba.ba._tune import Tuned, tune
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.checks import Dropped, Prepared, free_gauge, prepare
from jaxba.ba.groups import (
    PRIORS,
    AspectPrior,
    AttitudePrior,
    ControlPointPrior,
    IntrinsicsPrior,
    LeverArmPrior,
    PositionOffsetPrior,
    PositionPrior,
    ScaleBarPrior,
)
from jaxba.ba.tiles._batch import solve_batch
from jaxba.ba.tiles._merge import Merged, MergedTile, merge_tiles
from jaxba.ba.tiles._partition import BlockTile, Partition, partition
from jaxba.ba.tiles._solve_tiled import solve_tiled
from jaxba.ba.uncertainty._camera_covariance import camera_covariance
from jaxba.ba.uncertainty._covariance import Covariance, covariance, statistics_compiler
from jaxba.ba.uncertainty._propagate import Propagated, propagate
from jaxba.ba.uncertainty._reliability import NONCENTRALITY, RowStatistics
from jaxba.ba.uncertainty._reweight import Reweighted, solve_and_reweight
from jaxba.ba.uncertainty._statistics import Statistics, prior_statistics, statistics
from jaxba.ba.uncertainty._variance_components import VarianceComponent

__all__ = [
    "NONCENTRALITY",
    "PRIORS",
    "AbstractPrior",
    "AspectPrior",
    "AttitudePrior",
    "BlockTile",
    "ControlPointPrior",
    "Covariance",
    "Dropped",
    "Free",
    "GradientCheck",
    "GradientRow",
    "GroupErrors",
    "HistoryStep",
    "IntrinsicsPrior",
    "JacobianBlock",
    "LeverArmPrior",
    "Merged",
    "MergedTile",
    "Observations",
    "Partition",
    "Plan",
    "PlanShape",
    "PositionOffsetPrior",
    "PositionPrior",
    "Prepared",
    "Problem",
    "Propagated",
    "Quality",
    "Rejected",
    "Report",
    "Reweighted",
    "RowStatistics",
    "Rows",
    "ScaleBarPrior",
    "SchurDogleg",
    "SchurLevenbergMarquardt",
    "Solution",
    "Statistics",
    "Step",
    "Tuned",
    "Unknowns",
    "VarianceComponent",
    "camera_centers",
    "camera_covariance",
    "check_gradients",
    "covariance",
    "fast_jit",
    "free_gauge",
    "loss_derivatives",
    "make_plan",
    "merge_tiles",
    "partition",
    "prepare",
    "prior_statistics",
    "project_in_cameras",
    "propagate",
    "quality",
    "rejecting",
    "reprojection_errors",
    "residuals",
    "solve",
    "solve_and_reject",
    "solve_and_reweight",
    "solve_batch",
    "solve_tiled",
    "statistics",
    "statistics_compiler",
    "tune",
    "with_scale_bars",
]
