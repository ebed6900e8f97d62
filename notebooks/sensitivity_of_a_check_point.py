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
# # Which measurement moves this check point most?
#
# The derivative of one adjusted coordinate by every measurement of the block, in one reverse pass. It tells a
# surveyor which pixel, and which GNSS position, a height hangs on.

# %%
import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxba

jax.config.update("jax_enable_x64", True)  # derivatives are computed in double precision
survey = jaxba.synthetic.uav_block(20, seed=4, num_check=12, outlier_fraction=0.02)
loss = jaxba.Huber(1.0)
solution = jaxba.solve(survey.problem, loss=loss)
problem, truth = solution.apply(survey.problem), survey.truth
plan = jaxba.make_plan(problem)
middle = np.argmin(np.linalg.norm(truth.points[truth.check_index, :2] - truth.points[:, :2].mean(axis=0), axis=1))
point = int(truth.check_index[middle])


def height(measured):
    """Height of the check point, m, from pixels and GNSS positions."""
    xy_px, gnss = measured
    changed = eqx.tree_at(lambda p: (p.observations.xy_px, p.priors[0].xyz), problem, (xy_px, gnss))
    return jaxba.solve(changed, loss=loss, plan=plan).points[point, 2]


by_pixel, by_gnss = jax.grad(height)((problem.observations.xy_px, problem.priors[0].xyz))
by_pixel, by_gnss = np.asarray(by_pixel), np.asarray(by_gnss)
print(f"{by_pixel.size} + {by_gnss.size} derivatives in one pass")

# %% [markdown]
# The ten observations that move it most, in millimetres for each pixel. Most are its own marks; others are of
# points that hold the same images.

# %%
strength = 1e3 * np.linalg.norm(by_pixel, axis=1)
for i in np.argsort(-strength)[:10]:
    own = (
        "its own mark"
        if problem.observations.point_index[i] == point
        else f"point {problem.observations.point_index[i]}"
    )
    print(f"image {problem.observations.image_index[i]:3d}, {own:14s} {strength[i]:7.2f} mm a pixel")

# %% [markdown]
# The same derivatives give the height's sigma: by the law of error propagation the measurements' variances go
# through them. For least squares, that is the height's entry in the covariance of the whole block.

# %%
linear = jaxba.solve(survey.problem)
problem, loss = linear.apply(survey.problem), jaxba.Linear()
by = jax.grad(height)((problem.observations.xy_px, problem.priors[0].xyz))
sigma_px, sigma_m = problem.observations.std_px[:, None], problem.priors[0].std_m
propagated = float(np.sqrt(np.sum((by[0] * sigma_px) ** 2) + np.sum((by[1] * sigma_m) ** 2)))
predicted = float(np.sqrt(jaxba.covariance(problem).points[point, 2, 2]))
print(f"sigma of the height: {propagated:.5f} m propagated, {predicted:.5f} m in the covariance")

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.6))
centers = np.asarray(problem.poses.center)
axes[0].scatter(*np.asarray(problem.points)[problem.observations.point_index, :2].T, c=np.log10(strength + 1e-4), s=4)
axes[0].plot(*np.asarray(problem.points)[point, :2], "r*", markersize=14)
axes[0].set(xlabel="east (m)", ylabel="north (m)", title="log10 of mm of height for each pixel", aspect="equal")
up = by_gnss[:, 2]
dots = axes[1].scatter(
    centers[:, 0], centers[:, 1], c=up, s=60, cmap="coolwarm", vmin=-abs(up).max(), vmax=abs(up).max()
)
axes[1].plot(*np.asarray(problem.points)[point, :2], "k*", markersize=14)
axes[1].set(xlabel="east (m)", title=f"m of height for each m of a GNSS height (sum {up.sum():.2f})", aspect="equal")
figure.colorbar(dots, ax=axes[1])
figure.tight_layout()
plt.show()

# %%
assert abs(propagated / predicted - 1) < 0.05  # second derivatives of the residuals are in one, not in the other
assert abs(up.sum() - 1) < 0.02  # all GNSS heights up by a metre: so is the point
