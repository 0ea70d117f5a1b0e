"""What is simulated: bodies, things that move by themselves, events."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.scene.parts": ("Impulse", "number", "quaternion_to", "turned", "unit", "vector"),
        "gsfluent.scene.scene": ("Blade", "Body", "Collider", "Part", "Scene"),
    },
)
