"""What is simulated: bodies, things that move by themselves, events."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    heat="Surroundings",
    parts="Impulse number quaternion_to turned unit vector",
    scene="Blade Body Collider Part Scene",
)
