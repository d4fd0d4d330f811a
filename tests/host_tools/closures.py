"""A closure as results hold it, for tests of what is made of closures."""

from host_tools.results import ClosureResult


def closure(**changes: object) -> ClosureResult:
    values: dict[str, object] = {
        "t_s": 80.0,
        "from_vehicle": 0,
        "from_submap": 0,
        "from_time_s": 10.0,
        "to_vehicle": 0,
        "to_submap": 1,
        "to_time_s": 60.0,
        "measured_north_m": 103.0,
        "measured_east_m": 4.0,
        "sigma_north_m": 1.0,
        "sigma_east_m": 1.0,
        "residual": 0.01,
        "stage": "gated",
        "active_at_end": True,
    }
    return ClosureResult(**{**values, **changes})  # type: ignore[arg-type]
