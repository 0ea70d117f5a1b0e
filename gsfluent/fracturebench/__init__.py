"""FractureBench: frozen scenes with known answers, and the scorer that any simulator can use.

Only NumPy is imported here, and nothing of gsfluent: with ``PYTHONPATH=gsfluent`` the package is
``fracturebench`` and scores without torch. :mod:`~gsfluent.fracturebench.scene` is what a simulator
is given, :mod:`~gsfluent.fracturebench.run` what it hands in,
:mod:`~gsfluent.fracturebench.registry` the list of cases (how a scene is built at any resolution,
and how a run of it is judged).
"""
