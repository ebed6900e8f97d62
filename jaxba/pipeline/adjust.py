"""Stage adjust: the bundle adjustment in rounds, with rejection, pruning of edges and triangulation anew."""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._room import Room
from jaxba.engine._words import many
from jaxba.report import (
    Told,
    bar_facts,
    control_facts,
    flight_facts,
    flight_lines,
    grouped,
    sentences,
    statistics_facts,
)
from jaxba.scene import (
    BarFit,
    Block,
    CommonOffset,
    Control,
    ControlFit,
    Features,
    Finding,
    FlightOffsets,
    Photo,
    PrunedEdge,
    Reference,
    ScaleBars,
    SurveyStatistics,
    Tracks,
    ViewGraph,
    described,
)


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`, `reference`, `view_graph`, `tracks`, `block`: of the stages before.

    - `features`: of every photo, by its index, to complete tracks from; opened one after the other.
    - `control`: surveyed points. `bars`: known distances between marked points.
    - `chunk_size`: images of a tile, for a block that has more; None for one that has not.
    - `held`: intrinsics that stay as they are, by name.
    """

    photos: tuple[Photo, ...]
    reference: Reference
    view_graph: ViewGraph
    tracks: Tracks
    block: Block
    features: Mapping[int, Features] = field(default_factory=dict)
    control: Control = field(default_factory=Control.nothing)
    bars: ScaleBars = field(default_factory=ScaleBars.nothing)
    chunk_size: int | None = None
    held: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    loss: str = parameter(
        "huber",
        choices=("linear", "soft_l1", "huber", "cauchy", "arctan", "tukey", "geman_mcclure"),
        help="robust loss of the reprojections",
    )
    f_scale: float = parameter(1.0, low=0.5, high=5, help="where the loss turns robust, px")
    max_nfev: int = parameter(500, low=100, high=5000, help="the most steps of a solve")
    ftol: float = parameter(1e-8, low=1e-12, high=1e-6, help="stop when the cost changes by less than this share")
    xtol: float = parameter(1e-8, low=1e-12, high=1e-6, help="stop when the unknowns change by less than this share")
    track_threshold: float = parameter(2.0, low=1, high=4, help="acceptance of a triangulated track, px")
    mad_factor: float = parameter(2.5, low=2, high=5, help="reject over median + factor x MAD")
    min_angle: float = parameter(1.5, low=0.1, high=10, help="least angle between two rays of a point, degrees")
    max_rounds: int = parameter(5, low=1, high=20, help="the most rounds of solving, rejection and triangulation")
    complete_radius: float = parameter(
        4.0, low=0, high=50, help="look for features that matching missed so near to a point's pixel, px; 0: do not"
    )
    edge_median_limit: float = parameter(3.0, low=2, high=6, help="edges of the view graph over it are pruned, px")


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """The adjusted block and its errors.

    - `block`: what was adjusted; its observations are those used.
    - `error_px`: reprojection error of each observation. `point_error_px`: mean over each point's observations.
    - `position_std_m`: sigma of each registered image's position, east, north, up; NaN where it was not computed.
    - `position_covariance_m2`: of the same; NaN in the rows and columns of axes without a sigma.
    - `point_std_m`: sigma of each point; NaN likewise.
    - `intrinsics_std`: sigma of each intrinsic.
    - `gnss_residual_m`: adjusted minus measured position, less what its flight is off; NaN where none was used.
    - `median_px`, `inlier_rate`, `variance_factor`, `num_rejected`, `rounds`: figures of the adjustment.
    - `gnss_rms_m`: RMS of adjusted minus measured position an axis over the `num_gnss` positions that are no outliers.
    - `limit_px`: error over which an observation was rejected, if its track is long; shorter ones fit better by chance.
    - `std_px`: sigma of an observation's coordinates. `spread`: times it that errors really bear on the result, which
      the sigmas of the results allow for. `loss`, `loss_f_scale`: of the observations, its scale in those sigmas.
    - `position_scale`: factor on the sigmas of positions, an axis.
    - `pruned`: edges left out, with their figures. `solver`: why the last solve stopped, as `Solution.result` names it.
    - `common`: what positions have in common as an unknown, and its prior sigma; None where it was none.
    - `flights`: what positions of each flight are off in common; None where flights are not told apart.
    - `control`: how the surveyed points fit. `mark_used`: of all marks, those that agree with the others.
    - `mark_std_px`: sigma of a mark that weighed them. `bars`: how the scale bars fit.
    - `statistics`: of measurements and shared unknowns; None where sigmas were not computed.
    - `affine`: 3 x 4, what coordinates take beside the block, of `control.method=affine`; else the identity.
    - `findings`: what a surveyor should know, in figures: ambiguities, contradictions, bounds reached.
    """

    block: Block
    error_px: Float[np.ndarray, " observations"]
    point_error_px: Float[np.ndarray, " points"]
    position_std_m: Float[np.ndarray, "images 3"]
    point_std_m: Float[np.ndarray, "points 3"]
    intrinsics_std: Float[np.ndarray, "cameras parameters"]
    gnss_residual_m: Float[np.ndarray, "images 3"]
    gnss_rms_m: tuple[float, float, float] | None
    num_gnss: int
    median_px: float
    inlier_rate: float
    variance_factor: float
    num_rejected: int
    rounds: int
    std_px: float
    position_scale: Float[np.ndarray, "3"]
    findings: tuple[Finding, ...] = ()
    pruned: tuple[PrunedEdge, ...] = ()
    solver: str = ""
    common: CommonOffset | None = None
    flights: FlightOffsets | None = None
    control: ControlFit = field(default_factory=ControlFit.nothing)
    mark_used: Bool[np.ndarray, " marks"] = field(default_factory=lambda: np.zeros(0, bool))
    mark_std_px: float = 1.0
    bars: BarFit = field(default_factory=BarFit.nothing)
    spread: float = 1.0
    loss: str = "linear"
    loss_f_scale: float = 1.0
    statistics: SurveyStatistics | None = None
    affine: Float[np.ndarray, "3 4"] = field(default_factory=lambda: np.eye(3, 4))
    position_covariance_m2: Float[np.ndarray, "images 3 3"] | None = None
    limit_px: float = np.nan

    @property
    def gnss_minus_control_m(self) -> Float[np.ndarray, "3"]:
        """What all GNSS positions are off from control in common; NaN where it is not known."""
        return self.control.gnss_minus_control_m

    @property
    def is_usable(self) -> bool:
        """Whether no finding says that the result must not be used."""
        return all(finding.kind != "do not use" for finding in self.findings)


def run(inputs: Inputs, params: Params, room: Room | None = None) -> Outputs:
    """Adjust the block; `room` is for solving it in tiles.

    Raises `JaxbaError` where it has fewer than two images, or no point of it is left.
    """
    return run_and_keep(inputs, params, room)[0]


def run_and_keep(inputs: Inputs, params: Params, room: Room | None = None) -> tuple[Outputs, Any]:
    """Return what `run` does, and the `jaxba.sfm.Adjusted` behind it, whose problem can be asked for more."""
    from jaxba import sfm  # loads jax, which `--help` must not

    options = {f.name: getattr(params, f.name) for f in fields(params) if f.name != "min_angle"}
    settings = sfm.Settings(min_angle_rad=float(np.deg2rad(params.min_angle)), held=inputs.held, **options)
    reference, photos = inputs.reference, inputs.photos
    tiling = sfm.Tiling(chunk_size=inputs.chunk_size or inputs.block.num_images)
    if room is not None:
        tiling = dataclasses.replace(tiling, max_memory=room.memory_bytes, folder=room.folder, crew=room.crew)
    adjusted = sfm.adjust(
        inputs.block,
        inputs.tracks,
        inputs.view_graph,
        reference,
        photos,
        settings,
        inputs.features or None,
        inputs.control,
        tiling,
        inputs.bars,
        with_statistics=True,
    )
    sigmas = sfm.uncertainty(adjusted, reference, with_statistics=True)
    judged = sigmas.statistics
    flights = sfm.flight_offsets(adjusted, sigmas, reference)
    control = dataclasses.replace(inputs.control, mark_std_px=adjusted.mark_std_px)
    controlled = sfm.apply_control(adjusted, sigmas, control, reference)
    reference = sfm.without_offsets(reference, flights)
    block, bar_fit = controlled.block, adjusted.bars
    if controlled.fit.method in ("helmert", "affine") and inputs.bars.num:
        mapped = functools.partial(sfm.apply_affine, controlled.affine)
        bar_fit = sfm.compared_bars(block, mapped, inputs.bars, control)
    fit = sfm.gnss_fit(block, reference)
    sigmas = controlled.sigmas
    found = sfm.findings(
        dataclasses.replace(adjusted, block=block),
        inputs.block,
        sigmas,
        fit,
        reference,
        photos,
        is_controlled=controlled.is_fixed,
    )
    on_control, notes = described(
        "Findings on control",
        lambda: sfm.control_findings(adjusted, control, controlled.fit, reference, photos),
        (),
    )
    found = (
        *on_control,
        *sfm.bar_findings(inputs.bars, bar_fit, block),
        *found,
        *(Finding.of("note", text=f"{note}.") for note in notes),
    )
    total = np.bincount(block.observation_point, adjusted.error_px, minlength=block.num_points)
    outputs = Outputs(
        block=block,
        error_px=adjusted.error_px,
        point_error_px=total / np.bincount(block.observation_point, minlength=block.num_points),
        position_std_m=sigmas.position_std_m,
        point_std_m=sigmas.point_std_m,
        intrinsics_std=sigmas.intrinsics_std,
        gnss_residual_m=fit.residual_m,
        gnss_rms_m=fit.rms_m,
        num_gnss=fit.num,
        median_px=adjusted.medians_px[-1],
        inlier_rate=block.num_observations / adjusted.num_judged,
        variance_factor=sigmas.variance_factor,
        num_rejected=adjusted.num_rejected,
        rounds=len(adjusted.medians_px),
        std_px=adjusted.std_px,
        position_scale=adjusted.position_scale,
        findings=found,
        pruned=adjusted.pruned,
        solver=adjusted.solution.result,
        common=adjusted.common,
        flights=flights,
        control=controlled.fit,
        mark_used=adjusted.mark_used,
        mark_std_px=adjusted.mark_std_px,
        bars=bar_fit,
        spread=adjusted.spread,
        loss=params.loss,
        loss_f_scale=float(adjusted.loss.f_scale) / adjusted.spread,
        statistics=None
        if judged is None
        else sfm.survey_statistics(adjusted, judged, inputs.reference, inputs.control),
        affine=controlled.affine,
        position_covariance_m2=_position_covariance(sigmas),
        limit_px=adjusted.limit_px,
    )
    return outputs, adjusted


def _position_covariance(sigmas: Any) -> Float[np.ndarray, "images 3 3"]:
    """Return the covariances of the cameras' places, NaN along axes that have no sigma."""
    known = np.isfinite(sigmas.position_std_m)
    blocks = np.zeros((*known.shape, 3)) if sigmas.covariance is None else sigmas.covariance.centers
    return np.where(known[:, :, None] & known[:, None, :], blocks, np.nan)


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    made, factor = [f"median {outputs.median_px:.2f} px, {many(outputs.rounds, 'round')}"], outputs.variance_factor
    if np.isfinite(factor):
        made.append(
            f"Variance factor {factor:.2f}: residuals scatter by {np.sqrt(factor):.2f} times the "
            f"{outputs.std_px:.2f} px that weighed them; the sigmas of the results allow for it."
        )
    made += [f"Flight {line}." for line in flight_lines(flight_facts(outputs.flights))]
    return [*made, *grouped(told.left_out)]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return the figures of the adjustment, its findings, and how it fits control."""
    block = outputs.block
    seen = np.bincount(block.observation_point, minlength=block.num_points)
    cameras = zip(block.camera_names, block.camera_parameters, outputs.intrinsics_std, strict=True)
    adjusted = {
        "photos": len(told.photos),
        "images": block.num_images,
        "points": block.num_points,
        "points_seen_thrice": int((seen >= 3).sum()),
        "observations": block.num_observations,
        "median_px": outputs.median_px,
        "inlier_rate": outputs.inlier_rate,
        "variance_factor": outputs.variance_factor if np.isfinite(outputs.variance_factor) else None,
        "std_px": outputs.std_px,
        "gnss_rms_m": None if outputs.gnss_rms_m is None else list(outputs.gnss_rms_m),
        "num_gnss": outputs.num_gnss,
        "flights": flight_facts(outputs.flights),
        "camera_model": block.camera_model,
        "cameras": {
            name: {"parameters": list(map(float, row)), "std": list(map(float, std))} for name, row, std in cameras
        },
        "statistics": statistics_facts(outputs.statistics),
        "usable": outputs.is_usable,
        "findings": sentences(outputs.findings),
        "edges_left_out": [dataclasses.asdict(edge) for edge in outputs.pruned],
    }
    found: dict[str, Any] = {"adjust": adjusted}
    if told.bars.num:
        found["bars"] = bar_facts(told.bars, outputs.bars)
    if told.control.num_points:
        found["control"] = control_facts(told.control, outputs.control)
    return found
