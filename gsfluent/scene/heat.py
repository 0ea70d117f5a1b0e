"""What is around the things of a scene that have a temperature."""

from __future__ import annotations

import dataclasses

from gsfluent.scene.parts import number


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """Air and floor that heat comes from or goes to.

    Args:
        air: Temperature of the air [degrees C].
        transfer: Heat that it gives or takes [W/(m^2 K)]; 5 to 10 in still air, 0 for none.
        floor: Temperature of the floor [degrees C]; None for a floor that lets no heat through.
        speed: How many times faster heat flows than things move: ice melts in an hour, a film has
            seconds.

    Raises:
        InputError: A number that is not finite or outside its range.
    """

    air: float = 20.0
    transfer: float = 10.0
    floor: float | None = None
    speed: float = 1.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        number("heat: air", self.air, low=-273.15)
        number("heat: transfer", self.transfer, low=0.0)
        number("heat: speed", self.speed, low=0.0)
        if self.floor is not None:
            number("heat: floor", self.floor, low=-273.15)
