"""A result folder: finished stages, run.json, simulated frames."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.results.frames": (
            "SavedFrame",
            "count_frames",
            "frame_path",
            "frame_rate",
            "frame_time",
            "load_frame",
            "save_frame",
        ),
        "gsfluent.results.record": ("RunRecord", "read_frame", "shot_of"),
        "gsfluent.results.store": (
            "StageResult",
            "StageStore",
            "content_digest",
            "fingerprint",
            "publish",
        ),
    },
)
