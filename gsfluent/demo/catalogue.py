"""The demo objects by name."""

from __future__ import annotations

from gsfluent.demo.baked import Bread, Cake, Melons
from gsfluent.demo.fruit import Orange, Watermelon
from gsfluent.demo.objects import DemoObject
from gsfluent.demo.tableware import Bowl, Chocolate, Egg, Pane

OBJECTS: dict[str, type[DemoObject]] = {
    cls.name: cls for cls in (Watermelon, Orange, Bread, Cake, Melons, Pane, Bowl, Egg, Chocolate)
}
