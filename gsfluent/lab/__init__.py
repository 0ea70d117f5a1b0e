"""Problems with known answers: what the solver must reproduce, and how far it is from it.

:class:`gsfluent.lab.world.driver.World` runs one scene; :mod:`gsfluent.lab.world.registry` holds
the problems; ``scripts/accuracy/battery.py`` runs them all and writes the table of
``docs/measured/accuracy.md``.
"""
