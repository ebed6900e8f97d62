"""Does a block come out as its plan foretells? `python -m benchmarks.plans --simulations 100`.

Each plan is flown that often: pixels, positions, their common offset, control points and what is known of the camera
are drawn with the sigmas that the plan assumes, and the block is adjusted by `jaxba.solve`. What positions of cameras,
check points over the area and the focal length then err by, as an RMS over all simulations, stands beside the sigmas
that `jaxba plan` tells before.
"""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np

import jaxba
from jaxba.ba import (
    ControlPointPrior,
    IntrinsicsPrior,
    PositionOffsetPrior,
    PositionPrior,
    Problem,
)
from jaxba.design import FlightPlan, Network, network_of, spots_in, with_control
from jaxba.design._sections import Flight, Gnss, Ties

_AREA_M = np.array([[-60.0, -45.0], [60.0, -45.0], [60.0, 45.0], [-60.0, 45.0]])
_FLIGHT = {"height_m": 70.0, "forward_overlap": 0.7, "side_overlap": 0.6}
_CONTROL_M = np.array([[-55.0, -40.0], [55.0, -40.0], [0.0, 40.0]])
_CHECKS = 5
_UNKNOWN = (np.inf, np.inf, np.inf)


def plans() -> dict[str, FlightPlan]:
    """Return the plans that are simulated."""
    ties = Ties(points_per_image=60.0, mean_track_length=4.0)

    def plan(kind: str, control_m: np.ndarray | None = None, **flight: object) -> FlightPlan:
        return FlightPlan(
            area_m=_AREA_M,
            flight=Flight(**{**_FLIGHT, **flight}),
            gnss=Gnss(kind=kind),
            ties=ties,
            control_m=np.zeros((0, 2)) if control_m is None else control_m,
        )

    return {
        "RTK, lines": plan("rtk"),
        "RTK, lines and 8 oblique": plan("rtk", oblique=8),
        "plain GNSS, lines": plan("plain"),
        "plain GNSS, lines, 3 control points": plan("plain", _CONTROL_M),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plans", description=__doc__)
    parser.add_argument("--simulations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    print("| plan | photos | figure | foretold | RMS of simulations | ratio |\n| --- | --- | --- | --- | --- | --- |")
    for name, plan in plans().items():
        network = network_of(plan)
        for figure, (foretold, found) in compare(network, options.simulations, options.seed).items():
            ratio = found / foretold
            print(
                f"| {name} | {network.photos.num} | {figure} | {foretold:.4f} | {found:.4f} | {ratio:.2f} |", flush=True
            )


def compare(network: Network, simulations: int, seed: int = 0) -> Mapping[str, tuple[float, float]]:
    """Return, of each figure, the sigma that is foretold, and the RMS of what simulations err by."""
    spots_m = spots_in(network.area_m, _CHECKS)
    before = network.problem.num_points
    measured = with_control(network, spots_m, _UNKNOWN).problem
    true = measured.points[before:]
    centers = network.photos.center_m
    rng = np.random.default_rng(seed)
    off_cameras, off_spots, off_focal = [], [], []
    for _ in range(simulations):
        solution = jaxba.solve(drawn(measured, rng))
        assert solution.converged, solution.result
        off_cameras.append(np.asarray(solution.poses.center) - centers)
        off_spots.append(np.asarray(solution.points)[before:] - true)
        off_focal.append(np.asarray(solution.cameras.fx)[0] - network.photos.cameras.fx[0])
    foretold = network.at(spots_m).std_m
    found = {}
    for axis, name in enumerate(("east", "north", "up")):
        found[f"check points, {name} (m)"] = _rms(foretold[:, axis]), _rms(np.array(off_spots)[..., axis])
        cameras = network.position_std_m[:, axis]
        found[f"cameras, {name} (m)"] = _rms(cameras), _rms(np.array(off_cameras)[..., axis])
    found["focal length (px)"] = network.focal_std_px, _rms(np.array(off_focal))
    return found


def drawn(problem: Problem, rng: np.random.Generator) -> Problem:
    """Return a problem that stands at its true values with measurements that err as their sigmas say."""
    observations = problem.observations
    noise = np.asarray(observations.std_px)[:, None] * rng.normal(size=observations.xy_px.shape)
    priors = []
    offset = problem.prior("position_offset")
    common = np.zeros((len(problem.position_offset), 3))
    if isinstance(offset, PositionOffsetPrior):
        common = np.asarray(offset.std_m) * rng.normal(size=common.shape)
    for prior in problem.priors:
        if isinstance(prior, PositionPrior):
            shift = prior.offset(common)
            moved = np.asarray(prior.xyz) + shift + np.asarray(prior.std_m) * rng.normal(size=np.shape(prior.xyz))
            priors.append(dataclasses.replace(prior, xyz=moved))
        elif isinstance(prior, ControlPointPrior):
            std_m = np.asarray(prior.std_m)
            error = np.where(np.isfinite(std_m), std_m, 0.0) * rng.normal(size=std_m.shape)
            priors.append(dataclasses.replace(prior, xyz=np.asarray(prior.xyz) + error))
        elif isinstance(prior, IntrinsicsPrior):
            off = np.asarray(prior.std) * rng.normal(size=np.shape(prior.std))
            priors.append(dataclasses.replace(prior, parameters=np.asarray(prior.parameters) + off))
        else:
            priors.append(prior)
    return eqx.tree_at(
        lambda p: (p.observations.xy_px, p.priors), problem, (np.asarray(observations.xy_px) + noise, tuple(priors))
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
