"""Material points, their state, fields and fragments; the splats they carry."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.matter.carry": (
            "BLEND",
            "Carry",
            "Motion",
            "Points",
            "STRETCH",
            "nearest_points",
        ),
        "gsfluent.pipeline.matter.debris": ("REACH", "clinging"),
        "gsfluent.pipeline.matter.fields": (
            "LIMIT",
            "MOST",
            "breakable",
            "cut_bodies",
            "number_fields",
            "units",
        ),
        "gsfluent.pipeline.matter.fragments": (
            "Fragments",
            "STRETCH_LIMIT",
            "components",
            "find_fragments",
            "rest_links",
        ),
        "gsfluent.pipeline.matter.links": ("BACK", "FULL", "Hanging", "NEIGHBOURS", "OPEN"),
        "gsfluent.pipeline.matter.points": (
            "ALPHA_JITTER",
            "MAX_PARTICLES",
            "Matter",
            "POINTS_PER_CELL",
            "body_frame",
            "build_matter",
            "grid_spacing",
            "sample_points",
            "select",
        ),
        "gsfluent.pipeline.matter.state": (
            "State",
            "at_rows",
            "kinetic_energy",
            "load_state",
            "save_state",
        ),
    },
)
