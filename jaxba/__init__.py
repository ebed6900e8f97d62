"""Bundle adjustment, differentiable, on JAX.

`import jaxba` takes milliseconds and loads no jax: a public name loads its module when it is first used (PEP 562).
"""

from typing import TYPE_CHECKING

from jaxba._lazy import lazy

__version__ = "0.1.0"

_NAMES = {
    "jaxba._errors": ("JaxbaError",),
    "jaxba.ba": (
        "AttitudePrior",
        "ControlPointPrior",
        "Covariance",
        "Free",
        "GradientCheck",
        "HistoryStep",
        "IntrinsicsPrior",
        "LeverArmPrior",
        "Observations",
        "Plan",
        "PositionPrior",
        "Problem",
        "Quality",
        "Rejected",
        "Report",
        "SchurDogleg",
        "SchurLevenbergMarquardt",
        "Solution",
        "Tuned",
        "check_gradients",
        "covariance",
        "free_gauge",
        "make_plan",
        "quality",
        "reprojection_errors",
        "residuals",
        "solve",
        "solve_and_reject",
        "tune",
    ),
    "jaxba.geometry": (
        "BAL",
        "Arctan",
        "Barron",
        "Cauchy",
        "GemanMcClure",
        "Huber",
        "Linear",
        "OpenCV",
        "OpenCVFisheye",
        "Pinhole",
        "Pose",
        "Radial",
        "SimplePinhole",
        "SimpleRadial",
        "SoftL1",
        "Triangulation",
        "Tukey",
        "triangulate",
        "triangulate_two_view",
    ),
    "jaxba.io": ("read_bal", "read_problem", "read_tile", "write_bal", "write_tile"),
}
"""Public names by the module that defines them. A new one is a word here and one below; a test holds the two equal."""

_MODULES = {
    "ba": "jaxba.ba",
    "geometry": "jaxba.geometry",
    "io": "jaxba.io",
    "synthetic": "jaxba.scene.synthetic",
}
"""Public modules by their public name; `jaxba.geometry` works after `import jaxba` alone."""

if TYPE_CHECKING:
    from jaxba import ba as ba, geometry as geometry, io as io
    from jaxba._errors import JaxbaError as JaxbaError
    from jaxba.ba import (
        AttitudePrior as AttitudePrior,
        ControlPointPrior as ControlPointPrior,
        Covariance as Covariance,
        Free as Free,
        GradientCheck as GradientCheck,
        HistoryStep as HistoryStep,
        IntrinsicsPrior as IntrinsicsPrior,
        LeverArmPrior as LeverArmPrior,
        Observations as Observations,
        Plan as Plan,
        PositionPrior as PositionPrior,
        Problem as Problem,
        Quality as Quality,
        Rejected as Rejected,
        Report as Report,
        SchurDogleg as SchurDogleg,
        SchurLevenbergMarquardt as SchurLevenbergMarquardt,
        Solution as Solution,
        Tuned as Tuned,
        check_gradients as check_gradients,
        covariance as covariance,
        free_gauge as free_gauge,
        make_plan as make_plan,
        quality as quality,
        reprojection_errors as reprojection_errors,
        residuals as residuals,
        solve as solve,
        solve_and_reject as solve_and_reject,
        tune as tune,
    )
    from jaxba.geometry import (
        BAL as BAL,
        Arctan as Arctan,
        Barron as Barron,
        Cauchy as Cauchy,
        GemanMcClure as GemanMcClure,
        Huber as Huber,
        Linear as Linear,
        OpenCV as OpenCV,
        OpenCVFisheye as OpenCVFisheye,
        Pinhole as Pinhole,
        Pose as Pose,
        Radial as Radial,
        SimplePinhole as SimplePinhole,
        SimpleRadial as SimpleRadial,
        SoftL1 as SoftL1,
        Triangulation as Triangulation,
        Tukey as Tukey,
        triangulate as triangulate,
        triangulate_two_view as triangulate_two_view,
    )
    from jaxba.io import (
        read_bal as read_bal,
        read_problem as read_problem,
        read_tile as read_tile,
        write_bal as write_bal,
        write_tile as write_tile,
    )
    from jaxba.scene import synthetic as synthetic

_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}

__getattr__, __dir__ = lazy(__name__, _MODULE_OF, _MODULES)
