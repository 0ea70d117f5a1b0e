"""gsfluent run: the whole shot, the demo, single stages, the report."""
