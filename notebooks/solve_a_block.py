# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Are the predicted errors the real ones?
#
# A synthetic survey of 60 photos knows its truth: GNSS with 3 cm noise, half a pixel of noise, 5% wrong matches, start
# values a degree and metres off. Solve it with and without a robust loss, and hold the adjusted camera positions and
# check points against the truth and against the covariances that the adjustment itself predicts.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxba

survey = jaxba.synthetic.uav_block(60, seed=3, outlier_fraction=0.05, num_check=40)
problem, truth = survey.problem, survey.truth
print(problem.num_images, "images,", problem.num_points, "points,", problem.num_observations, "observations")

# %%
solutions = {
    "least squares": jaxba.solve(problem),
    "huber": jaxba.solve(problem, loss=jaxba.Huber(1.0)),
}
for name, solution in solutions.items():
    error = solution.points[truth.check_index] - truth.points[truth.check_index]
    rms = np.sqrt((error**2).mean(axis=0))
    print(f"{name:14s} {solution.result}, {int(solution.num_steps)} steps; check points, RMS e n u (m): {rms.round(3)}")

# %% [markdown]
# Five wrong matches in a hundred bend the least-squares block by decimetres; Huber's loss keeps it.

# %%
robust = solutions["huber"]
figure, axes = plt.subplots(1, 2, figsize=(11, 4.2))
for name, solution in solutions.items():
    history = solution.report.history
    axes[0].semilogy([s.step for s in history], [s.cost for s in history], "o-", label=name)
axes[0].set(xlabel="step", ylabel="cost", title="convergence")
axes[0].legend()
quality = jaxba.quality(robust.apply(problem))
bins = np.linspace(0, 4, 80)
axes[1].hist(quality.error_px[~truth.is_outlier], bins, label="good matches")
axes[1].hist(quality.error_px[truth.is_outlier], bins, label="wrong matches")
axes[1].axvline(quality.threshold_px, color="k", linestyle=":", label="median + 2.5 MAD")
axes[1].set(xlabel="reprojection error (px)", ylabel="observations", title="after Huber")
axes[1].legend()
figure.tight_layout()
plt.show()

# %% [markdown]
# Now the honest part: errors divided by their predicted covariance. If the prediction is right, the squared lengths
# follow a chi-square distribution with three degrees of freedom.

# %%
covariance = jaxba.covariance(robust.apply(problem), loss=jaxba.Huber(1.0))
check = truth.check_index
scaled = {
    "camera positions": (
        np.asarray(robust.poses.center) - np.asarray(truth.poses.center),
        covariance.centers,
    ),
    "check points": (robust.points[check] - truth.points[check], covariance.points[check]),
}
figure, axis = plt.subplots(figsize=(6, 4.2))
for name, (error, matrix) in scaled.items():
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(matrix), error)
    print(f"{name}: mean squared scaled error {squared.mean():.2f} (expected 3)")
    axis.step(np.sort(squared), np.arange(1, len(squared) + 1) / len(squared), label=name)
grid = np.linspace(0, 15, 200)
density = np.sqrt(grid / (2 * np.pi)) * np.exp(-grid / 2)
axis.plot(grid, np.cumsum(density) * (grid[1] - grid[0]), "k:", label="chi-square, 3 degrees of freedom")
axis.set(xlabel="squared error over predicted covariance", ylabel="share", xlim=(0, 15))
axis.legend()
plt.show()
