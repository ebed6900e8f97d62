"""The picture of benchmarks/README.md: `python -m benchmarks.picture` writes benchmarks/results/block.png.

LeftOut, a block of 100 photos with 2% wrong matches, adjusted with Huber's loss: the errors of the adjusted camera
positions against the truth, and the ellipses that the adjustment predicts for them (95%). Right, how the cost falls
with time beside Ceres, from the results that `python -m benchmarks.run` has stored.
"""

import json
from pathlib import Path

import matplotlib
import numpy as np

import jaxba

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Ellipse

RESULTS = Path(__file__).parent / "results"
_CONVERGENCE = ("uav500", "uav500_outliers")
_SCALE = 1000.0  # errors are drawn this much larger than the block
_CHI_SQUARE_95 = 5.991  # two degrees of freedom


def main() -> None:
    survey = jaxba.synthetic.uav_block(100, seed=1, outlier_fraction=0.02, num_check=30)
    solution = jaxba.solve(survey.problem, loss=jaxba.Huber(1.0))
    predicted = jaxba.covariance(solution.apply(survey.problem), loss=jaxba.Huber(1.0)).centers[:, :2, :2]
    truth = np.asarray(survey.truth.poses.center)
    error = (np.asarray(solution.poses.center) - truth)[:, :2]

    figure, axes = plt.subplots(1, 2, figsize=(12, 5), width_ratios=(1, 1.1))
    axis = axes[0]
    points = survey.truth.points
    axis.scatter(points[:, 0], points[:, 1], c=points[:, 2], s=2, cmap="terrain", alpha=0.35)
    axis.quiver(
        truth[:, 0], truth[:, 1], error[:, 0], error[:, 1], angles="xy", scale_units="xy", scale=1 / _SCALE, width=0.003
    )
    for center, matrix in zip(truth, predicted, strict=True):
        values, vectors = np.linalg.eigh(matrix)
        width, height = 2 * _SCALE * np.sqrt(_CHI_SQUARE_95 * values)
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        axis.add_patch(Ellipse(center[:2], width, height, angle=angle, fill=False, edgecolor="tab:red", linewidth=0.8))
    axis.set(aspect="equal", xlabel="east (m)", ylabel="north (m)")
    axis.set_title(f"errors of adjusted positions and predicted 95% ellipses, x{_SCALE:.0f}")

    axis = axes[1]
    for color, name in zip(("tab:blue", "tab:orange"), _CONVERGENCE, strict=True):
        path = RESULTS / f"{name}.json"
        if not path.exists():
            continue
        entries = json.loads(path.read_text())["solvers"]
        best = min(entry["final_cost"] for entry in entries)
        for entry in entries:
            seconds = [entry["seconds_preprocess"] + step["seconds"] for step in entry["history"]]
            above = [step["cost"] / best - 1 for step in entry["history"]]
            style = "-o" if entry["solver"].startswith("jaxba") else ":s"
            axis.loglog(seconds, above, style, color=color, markersize=3, label=f"{name}, {entry['solver']}")
    axis.axhline(1e-3, color="gray", linewidth=0.8)
    axis.set(xlabel="seconds", ylabel="cost above the best", ylim=(1e-8, None), title="500 images, 124k observations")
    axis.legend(fontsize=8)
    figure.tight_layout()
    RESULTS.mkdir(exist_ok=True)
    figure.savefig(RESULTS / "block.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
