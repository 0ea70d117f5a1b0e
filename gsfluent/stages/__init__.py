"""Stages of a run over files: fingerprint, work, record; resumable."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    breaking="SURE breaking_rows breaks_from is_slender landing_speed",
    chain="run_stages",
    check="check_shot",
    context="RunContext",
    findings="THIN cells_for cells_for_walls lowered setting summary thin_walls walls_note",
    known="extended is_solid known_solid parted source_digest",
    select="select_mask",
    show="render_again render_stage",
    simulate="build_scene moving_settings saved solver_options",
    solids="context_of load_solids make_solids",
)
