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
# # Are the gradients right?
#
# `jaxba.check_gradients` perturbs every kind of input of an adjustment, solves again on either side, and holds
# the derivative of the optimum against the difference. `python -m jaxba gradcheck tile.npz` is the same as a
# command.

# %%
import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import jaxba

camera = jaxba.SimpleRadial(f=3600.0, cx=2736.0, cy=1824.0, k1=0.01)
survey = jaxba.synthetic.uav_block(4, seed=1, outlier_fraction=0.05, num_control=3, camera=camera)
problem = survey.problem.fix(points=[12], intrinsics=["k1"])
checks = {
    name: jaxba.check_gradients(problem, loss=loss)
    for name, loss in (("least squares", jaxba.Linear()), ("Cauchy", jaxba.Cauchy(2.0)))
}
for name, checked in checks.items():
    print(name)
    print(checked.table(), "\n")

# %% [markdown]
# The last column is what the Gauss-Newton approximation would give: `J^T J` in place of the second derivatives.
# Under least squares with small residuals it is off by a few tenths of a percent; under a robust loss that has
# wrong matches to deal with, it can be off by as much as the derivative itself.

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), sharex=True)
for axis, (name, checked) in zip(axes, checks.items(), strict=True):
    rows = [dataclasses.asdict(row) for row in checked.rows]
    place = np.arange(len(rows))
    axis.barh(place - 0.2, [row["error"] for row in rows], 0.4, label="exact second derivatives")
    axis.barh(place + 0.2, [row["gauss_newton_error"] for row in rows], 0.4, label="Gauss-Newton")
    axis.axvline(1e-5, color="k", linestyle=":")
    axis.set(xscale="log", yticks=place, yticklabels=[row["name"] for row in rows], title=name, xlabel="relative error")
    axis.invert_yaxis()
axes[0].legend()
figure.tight_layout()
plt.show()

# %%
assert all(checked.passed for checked in checks.values())
