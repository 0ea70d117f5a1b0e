"""A result folder: finished stages, run.json, simulated frames."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    behind="Behind held_here",
    digests="Journal require_intact",
    frames=(
        "DUST FrameWriter SavedFrame count_frames frame_head frame_path frame_positions frame_rate "
        "frame_time load_frame packed_frame save_frame"
    ),
    lock="locked",
    partition="FILE SavedBody SavedPartition SavedSplit load_partition save_partition",
    record="RunRecord read_frame shot_of",
    store="StageResult StageStore content_digest fingerprint publish",
)
