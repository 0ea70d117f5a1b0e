"""Stages of a run over files: fingerprint, work, record; resumable."""
