"""Mistakes planted in simulated surveys, and what is said of them: `python -m benchmarks.control`.

Twelve photos with five check points and 3, 5 or 12 control points (2 cm across, 3 cm in height, marks of 0.3 px that
nobody states), positions of an RTK receiver (2 and 4 cm) or a plain one (3 and 5 m). Errors are drawn anew for each
survey. `--clean`: surveys without a mistake, of each kind. `--planted`: surveys of each mistake. `--blocks`: without
control, for coverage. `--only`: `faults`, `clean`, `power` or `coverage`. Prints Markdown.

- A mistake is *named* where the findings say whose and of which kind it is, *beside* where they accuse anything else.
- *Refused*: the verdict is that the result must not be used.
- NSE: mean normalised squared error of cameras and of check points, over surveys that were not refused; 1 is expected.
- *Coverage*: how often ellipsoids of 95% hold the truth, of positions, rotations, points, and the intrinsics together.
- *Theory*: the power of Baarda's test, from the smallest error that the clean surveys say shows.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, ncx2

from jaxba import sfm
from jaxba.ba import NONCENTRALITY
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.scene import Control, Finding
from jaxba.simulation.staged import Simulated, measured_anew, simulate, spread_control

_GNSS_M = {"RTK": (0.02, 0.02, 0.04), "plain": (3.0, 3.0, 5.0)}
_SIZES_M = (0.1, 0.3, 3.0)
_COUNTS = (3, 5, 12)
_NUM_CHECK = 5
_SETTINGS = sfm.Settings(max_rounds=4)
_AXES = {"east": (0, 2), "up": (2, 1)}  # axis, and degrees of freedom of its test
_WRONG = {"control point set aside", "control point contradicts", "control labels exchanged", "gnss off control",
          "control scatters", "check points shifted", "positions scatter", "positions contradict"}  # fmt: skip

Given = tuple[Simulated, Control]


@dataclasses.dataclass(frozen=True)
class Judged:
    """What came of a survey: findings that accuse, the verdict, squared errors over their sigmas, what would show."""

    accused: frozenset[tuple[str, str]]
    is_usable: bool
    cameras: float
    checks: float
    detectable_m: np.ndarray
    scale: np.ndarray


def judge(given: Given) -> Judged:
    """Adjust a survey as the stage does, and compare it with the truth."""
    survey, control = given
    block = sfm.with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
    parts = survey.reference, survey.photos
    adjusted = sfm.adjust(block, survey.tracks, survey.view_graph, *parts, _SETTINGS, control=control)
    control = dataclasses.replace(control, mark_std_px=adjusted.mark_std_px)
    sigmas = sfm.uncertainty(adjusted, survey.reference)
    controlled = sfm.apply_control(adjusted, sigmas, control, survey.reference)
    fit, gnss = controlled.fit, sfm.gnss_fit(controlled.block, survey.reference)
    found = (
        *sfm.control_findings(adjusted, control, fit, *parts),
        *sfm.findings(adjusted, survey.block, sigmas, gnss, *parts, is_controlled=controlled.is_fixed),
    )
    off = adjusted.block.centers_m - np.asarray(survey.survey.truth.poses.center)[adjusted.block.image_index]
    assert sigmas.covariance is not None
    inverse = np.linalg.inv(sigmas.covariance.centers)
    over = fit.residual_m[control.is_check] / np.hypot(fit.std_m, control.std_m)[control.is_check]
    return Judged(
        accused=frozenset(culprit for finding in found for culprit in _culprits(finding)),
        is_usable=all(finding.kind != "do not use" for finding in found),
        cameras=float(np.mean(np.einsum("ni,nij,nj->n", off, inverse, off)) / 3),
        checks=float(np.mean(over**2)),
        detectable_m=fit.detectable_m,
        scale=fit.scale,
    )


def _culprits(finding: Finding) -> list[tuple[str, str]]:
    if finding.kind not in _WRONG:
        return []
    figures = finding.figures
    if finding.kind == "control labels exchanged":
        return [(finding.kind, " ".join(figures["names"]))]
    return [(finding.kind, figures.get("name", ""))]


def moved(control: Control, row: int, by_m: tuple[float, float, float]) -> Control:
    xyz_m = control.xyz_m.copy()
    xyz_m[row] += by_m
    return dataclasses.replace(control, xyz_m=xyz_m)


def exchanged(control: Control, first: int, second: int) -> Control:
    xyz_m = control.xyz_m.copy()
    xyz_m[[first, second]] = xyz_m[[second, first]]
    return dataclasses.replace(control, xyz_m=xyz_m)


def away(survey: Simulated, by_m: tuple[float, float, float]) -> Simulated:
    reference = dataclasses.replace(survey.reference, xyz_m=survey.reference.xyz_m + np.array(by_m))
    return dataclasses.replace(survey, reference=reference)


class Draws:
    """Surveys of one flight, with errors drawn anew."""

    def __init__(self) -> None:
        self.flight = simulate(12, seed=4, points_per_image=300.0)

    def __call__(self, kind: str, num_control: int, seed: int) -> Given:
        rng = np.random.default_rng(seed)
        survey = measured_anew(self.flight, rng, _GNSS_M[kind])
        return survey, spread_control(survey, num_control, _NUM_CHECK, rng)


def faults(draw: Draws, count: int) -> None:
    """Print the table of mistakes."""
    print("| planted | positions | named | beside | refused | NSE cameras | NSE check points |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    aside, base = "control point set aside", (1.0, -0.8, 0.8)

    def rows(given: Given) -> tuple[int, int]:
        first, second = np.flatnonzero(~given[1].is_check)[1:3]
        return int(first), int(second)

    def point(by_m: tuple[float, float, float]) -> Callable[[Given], tuple[Given, set[tuple[str, str]]]]:
        def plant(given: Given) -> tuple[Given, set[tuple[str, str]]]:
            row = rows(given)[0]
            return (given[0], moved(given[1], row, by_m)), {(aside, given[1].names[row])}

        return plant

    def labels(given: Given) -> tuple[Given, set[tuple[str, str]]]:
        first, second = rows(given)
        names = f"{given[1].names[first]} {given[1].names[second]}"
        return (given[0], exchanged(given[1], first, second)), {("control labels exchanged", names)}

    def shifted(given: Given) -> tuple[Given, set[tuple[str, str]]]:
        return (away(given[0], base), given[1]), {("gnss off control", "")}

    def unheld(given: Given) -> tuple[Given, set[tuple[str, str]]]:
        control = dataclasses.replace(given[1], is_check=np.ones(given[1].num_points, bool))
        return (away(given[0], base), control), {("check points shifted", "")}

    for text, kind, plant in (
        ("0.3 m in one control height", "plain", point((0.0, 0.0, 0.3))),
        ("0.3 m east in one control point", "RTK", point((0.3, 0.0, 0.0))),
        ("two labels exchanged", "RTK", labels),
        ("two labels exchanged", "plain", labels),
        ("base off by (1.0, -0.8, 0.8) m", "RTK", shifted),
        ("the same, no control, check points alone", "RTK", unheld),
    ):
        made, named, beside = [], 0, 0
        for seed in range(count):
            given, expected = plant(draw(kind, 5, seed))
            judged = judge(given)
            made.append(judged)
            named += expected <= judged.accused
            beside += bool(judged.accused - expected)
        _row(text, kind, f"{named} of {count}", beside, made)


def clean(draw: Draws, count: int) -> None:
    """Print what is said of surveys without a mistake."""
    print("| control points | positions | surveys | accused | refused | NSE cameras | NSE check points |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for kind in _GNSS_M:
        for num_control in _COUNTS:
            made = [judge(draw(kind, num_control, 1000 + seed)) for seed in range(count)]
            _row(str(num_control), kind, str(count), sum(bool(j.accused) for j in made), made)


def _row(first: str, kind: str, named: str, beside: int, made: list[Judged]) -> None:
    used = [j for j in made if j.is_usable]
    mean = [f"{np.mean([getattr(j, of) for j in used]):.2f}" if used else "" for of in ("cameras", "checks")]
    print(f"| {first} | {kind} | {named} | {beside} | {len(made) - len(used)} | {mean[0]} | {mean[1]} |", flush=True)


def power(draw: Draws, count: int) -> None:
    """Print how often an error of a control point is found, beside what theory says."""
    print("| positions | control points | error | found | as theory says | another accused | refused |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for kind in _GNSS_M:
        for num_control in _COUNTS:
            shown = judge(draw(kind, num_control, 2000))
            for axis, (k, freedom) in _AXES.items():
                for size_m in _SIZES_M:
                    by_m = np.zeros(3)
                    by_m[k] = size_m
                    found = other = refused = 0
                    expected = []
                    for seed in range(count):
                        survey, control = draw(kind, num_control, 3000 + seed)
                        row = int(np.flatnonzero(~control.is_check)[seed % num_control])
                        judged = judge((survey, moved(control, row, (by_m[0], by_m[1], by_m[2]))))
                        mine = ("control point set aside", control.names[row])
                        found += mine in judged.accused
                        other += bool(judged.accused - {mine})
                        refused += not judged.is_usable
                        center = (NONCENTRALITY * size_m / shown.detectable_m[row, k]) ** 2
                        expected.append(ncx2.sf(chi2.isf(1e-3, freedom), freedom, center))
                    print(
                        f"| {kind} | {num_control} | {size_m} m {axis} | {found / count:.0%} | {np.mean(expected):.0%} "
                        f"| {other / count:.0%} | {refused / count:.0%} |",
                        flush=True,
                    )


def coverage(draw: Draws, count: int) -> None:
    """Print how often ellipsoids of 95% hold the truth, in blocks that positions alone place."""
    print("| positions | what | number | within 95% | NSE |")
    print("| --- | --- | --- | --- | --- |")
    for kind in _GNSS_M:
        squares: dict[tuple[str, int], list[np.ndarray]] = {}
        for seed in range(count):
            survey, _ = draw(kind, 3, 5000 + seed)
            block = sfm.with_points(survey.block, survey.tracks, min_angle_rad=0.02, max_error_px=20.0)
            parts = survey.tracks, survey.view_graph, survey.reference, survey.photos
            adjusted = sfm.adjust(block, *parts, _SETTINGS)
            for key, values in _squares(adjusted, sfm.uncertainty(adjusted, survey.reference), survey).items():
                squares.setdefault(key, []).append(values)
        for (name, freedom), parts in squares.items():
            values = np.concatenate(parts)
            held = np.mean(values < chi2.isf(0.05, freedom))
            print(f"| {kind} | {name} | {len(values):,} | {held:.1%} | {values.mean() / freedom:.2f} |", flush=True)


def _squares(adjusted: sfm.Adjusted, sigmas: sfm.Uncertainty, survey: Simulated) -> dict[tuple[str, int], np.ndarray]:
    """Return squared errors over their covariances, by what they are of and their degrees of freedom."""
    block, truth, found = adjusted.block, survey.survey.truth, sigmas.covariance
    assert found is not None

    def over(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)

    true = Rotation.from_quat(np.asarray(truth.poses.quaternion)[block.image_index], scalar_first=True)
    turned = (Rotation.from_quat(block.quaternion, scalar_first=True) * true.inv()).as_rotvec()
    points = over(block.points_m - truth.points[block.track_index], found.points[: block.num_points])
    views = np.bincount(block.observation_point, minlength=block.num_points)
    names = type(truth.cameras).parameter_names()
    camera = np.array([float(np.ravel(getattr(truth.cameras, name))[0]) for name in names])
    free = np.diagonal(found.intrinsics[0]) > 0
    error = (block.camera_parameters[0] - camera)[None, free]
    return {
        ("positions", 3): over(block.centers_m - np.asarray(truth.poses.center)[block.image_index], found.centers),
        ("rotations", 3): over(turned, found.poses[:, :3, :3]),
        ("points of two rays", 3): points[views == 2],
        ("points of more", 3): points[views > 2],
        ("intrinsics together", int(free.sum())): over(error, found.intrinsics[0][np.ix_(free, free)][None]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clean", type=int, default=50)
    parser.add_argument("--planted", type=int, default=20)
    parser.add_argument("--blocks", type=int, default=200)
    parser.add_argument("--only", choices=("faults", "clean", "power", "coverage"))
    args = parser.parse_args()
    use_compilation_cache()
    draw, begun = Draws(), time.monotonic()
    for name, table, count in (("faults", faults, args.planted), ("clean", clean, args.clean),
                               ("power", power, args.planted), ("coverage", coverage, args.blocks)):  # fmt: skip
        if args.only in (None, name):
            print(f"\n{name}, {count} surveys of each:\n")
            table(draw, count)
    print(f"\n{time.monotonic() - begun:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
