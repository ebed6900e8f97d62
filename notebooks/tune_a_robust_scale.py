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
# # Tuning a robust loss through the adjustment
#
# Where should a loss turn robust? Too narrow and good measurements are thrown away, too wide and wrong matches
# bend the block. With surveyed check points there is an answer: the scale whose adjusted block misses them least.
# `jaxba.solve` has derivatives, so the scale is found by following the error's slope, through the whole
# adjustment.

# %%
import functools

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxba

jax.config.update("jax_enable_x64", True)  # derivatives are computed in double precision
survey = jaxba.synthetic.uav_block(16, seed=5, outlier_fraction=0.2, num_check=30)
problem, truth = survey.problem, survey.truth
plan = jaxba.make_plan(problem)
check = truth.check_index


def check_point_error(log_scale, **tolerances):
    """Mean squared distance of the adjusted check points from the truth, m^2."""
    solution = jaxba.solve(problem, loss=jaxba.Huber(f_scale=jnp.exp(log_scale)), plan=plan, **tolerances)
    return jnp.mean(jnp.sum((solution.points[check] - truth.points[check]) ** 2, axis=1))


error, slope = jax.value_and_grad(check_point_error)(0.0)
print(f"scale 1: check points off by {np.sqrt(error):.4f} m RMS, slope {slope:.2e} m^2 for each e-fold of the scale")

# %% [markdown]
# The error over the scale, and the slope that the adjoint gives at each of these scales: one solve and one more
# linear system each, no differences.

# %%
log_scales = np.linspace(np.log(0.2), np.log(30), 13)
curve = [jax.value_and_grad(check_point_error)(s) for s in log_scales]

# %% [markdown]
# Descent from a scale that is far too wide, with Adam's steps. Check points are not part of the fit; each step
# solves the block anew from the optimum before it.

# %%
tuned = jaxba.tune(
    problem, loss=jaxba.Huber(20.0), check_points=(check, truth.points[check]), steps=15, learning_rate=0.4
)
rms = np.sqrt(tuned.history[:, 0])
print(f"from {rms[0]:.4f} m at scale 20 to {np.sqrt(tuned.score):.4f} m at scale {tuned.learned['loss scale']:.2f}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.2))
errors = np.array([np.sqrt(e) for e, _ in curve])
axes[0].plot(np.exp(log_scales), errors, "o")
for s, (e, g) in zip(log_scales, curve, strict=True):
    d = np.array([-0.15, 0.15])
    axes[0].plot(np.exp(s + d), np.sqrt(e) + g / (2 * np.sqrt(e)) * d, "k-", linewidth=1)
axes[0].set(xscale="log", xlabel="scale of Huber's loss (sigmas)", ylabel="check points, RMS (m)")
axes[0].set_title("error, and its slope by the adjoint")
axes[1].plot(rms, "o-")
axes[1].set(xlabel="step of the descent", ylabel="check points, RMS (m)", title="tuned through the solve")
figure.tight_layout()
plt.show()

# %% [markdown]
# The slopes are tangents of the curve, and the descent ends near its lowest point. One slope beside a difference:

# %%
assert rms[-1] < rms[0] / 2
lowest = int(np.argmin(errors))
at, step = np.log(3.0), 1e-3
tight = {"ftol": 0.0, "xtol": 1e-12}
slope_at = jax.grad(functools.partial(check_point_error, **tight))(at)
difference = (check_point_error(at + step, **tight) - check_point_error(at - step, **tight)) / (2 * step)
print(f"slope at scale 3: {slope_at:.5e} by the adjoint, {difference:.5e} by two more solves")
assert abs(slope_at / difference - 1) < 1e-3  # where so few errors lie near the scale that no step crosses a corner
print("lowest of the curve at scale", float(np.exp(log_scales[lowest]).round(2)))
