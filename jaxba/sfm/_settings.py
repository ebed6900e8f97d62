"""Settings of the adjustment in rounds."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What may be set; see the adjust stage's parameters."""

    loss: str = "huber"
    f_scale: float = 1.0
    max_nfev: int = 500
    ftol: float = 1e-8
    xtol: float = 1e-8
    track_threshold: float = 2.0
    mad_factor: float = 2.5
    edge_median_limit: float = 3.0
    min_angle_rad: float = 0.026
    max_rounds: int = 5
    complete_radius: float = 4.0
