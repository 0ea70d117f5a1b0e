"""Built-in objects with a known inside: photographs of them, and the truth to judge results by."""

from __future__ import annotations

from gsfluent.demo.capture import DemoPaths, cut_photograph, make_capture, make_object, photograph
from gsfluent.demo.error import interior_error
from gsfluent.demo.objects import DemoObject
from gsfluent.demo.splats import make_splats
from gsfluent.demo.truth import load_truth, sample_truth

__all__ = [
    "DemoObject",
    "DemoPaths",
    "cut_photograph",
    "interior_error",
    "load_truth",
    "make_capture",
    "make_object",
    "make_splats",
    "photograph",
    "sample_truth",
]
