"""What every problem runs in: bodies, engine, driver, registry."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    driver="World place",
    drives="Drives damage",
    invariants="KINDS Limits OfWorld State Violation check first_violation observe search",
    registry="Result compare problem",
    resident="Resident",
    shapes="ball box disc moduli nacc parameters rotation sheet wave_speed",
    walls="PLANE_STRAIN between_planes wall",
)
