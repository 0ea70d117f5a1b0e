"""What every problem runs in: bodies, engine, driver, registry."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.world.driver": ("World",),
        "gsfluent.lab.world.drives": ("Drives", "damage"),
        "gsfluent.lab.world.invariants": (
            "KINDS",
            "Limits",
            "OfWorld",
            "State",
            "Violation",
            "check",
            "first_violation",
            "observe",
            "search",
        ),
        "gsfluent.lab.world.registry": ("Result", "compare", "problem"),
        "gsfluent.lab.world.resident": ("Resident",),
        "gsfluent.lab.world.shapes": (
            "ball",
            "box",
            "disc",
            "moduli",
            "nacc",
            "parameters",
            "rotation",
            "sheet",
            "wave_speed",
        ),
        "gsfluent.lab.world.walls": ("PLANE_STRAIN", "between_planes", "wall"),
    },
)
