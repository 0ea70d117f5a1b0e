"""A result folder: finished stages, run.json, simulated frames."""
