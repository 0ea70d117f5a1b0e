"""Material points, their state, fields and fragments; the splats they carry."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    brittle="brittle_rows distinct_rows kept_strength",
    carry="BLEND Carry Motion Points STRETCH nearest_points",
    crack_band="crack_band fracture_energy softening_energy",
    debris="REACH clinging",
    fields="LIMIT MOST breakable cut_bodies number_fields",
    fragments="Fragments components ranked rest_links",
    links="BACK FULL Hanging Links NEIGHBOURS OPEN PARTED",
    pieces="Pieces Web dust_limit find_pieces stiff",
    points=(
        "ALPHA_JITTER MAX_PARTICLES Matter POINTS_PER_CELL body_frame build_matter "
        "grid_spacing sample_points select shared_out start_of"
    ),
    state="State at_rows kinetic_energy load_state save_state",
    weld="seen weld",
)
