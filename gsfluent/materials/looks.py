"""How shiny the presets are: k_s and n_s of Blinn-Phong, chosen by eye on a lit ball.

A polished or wet surface has a strong narrow highlight, a waxy one a weak wide one, cloth and crumb
next to none. A preset that is not named keeps the plain ones of :class:`Material`.
"""

from __future__ import annotations

LOOK: dict[str, tuple[float, float]] = {
    "fruit.watermelon": (0.06, 28.0),
    "fruit.apple": (0.12, 40.0),
    "fruit.orange": (0.06, 18.0),
    "fruit.pumpkin": (0.05, 18.0),
    "glass": (0.6, 160.0),
    "ceramic": (0.3, 80.0),
    "bone": (0.05, 14.0),
    "chocolate": (0.12, 20.0),
    "bread": (0.0, 8.0),
    "jelly": (0.4, 70.0),
    "plush": (0.0, 8.0),
    "rubber": (0.05, 10.0),
    "concrete": (0.01, 8.0),
    "rock": (0.02, 8.0),
    "ice": (0.4, 90.0),
    "wood": (0.03, 12.0),
    "plaster": (0.01, 8.0),
    "foam": (0.0, 8.0),
    "snow": (0.02, 8.0),
    "sand": (0.0, 8.0),
    "gravel": (0.01, 8.0),
    "soil": (0.0, 8.0),
    "steel": (0.6, 60.0),
    "aluminium": (0.5, 40.0),
    "copper": (0.5, 50.0),
    "plasticine": (0.06, 14.0),
    "clay": (0.02, 8.0),
    "water": (0.5, 120.0),
    "milk": (0.3, 80.0),
    "oil": (0.5, 100.0),
    "honey": (0.5, 90.0),
}
