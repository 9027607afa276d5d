"""The analyst's bench: look into a run image by image, at the shell, in Python and in a browser."""

from giantlike.bench.explain import explain
from giantlike.bench.layers import LAYERS, MarkLayer, layers_of
from giantlike.bench.planes import backplanes_of, with_terminators, write_backplanes
from giantlike.bench.session import SeenImage, Session, verdict_of

__all__ = [
    "LAYERS",
    "MarkLayer",
    "SeenImage",
    "Session",
    "backplanes_of",
    "explain",
    "layers_of",
    "verdict_of",
    "with_terminators",
    "write_backplanes",
]
