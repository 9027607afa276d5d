"""Deprecated: names of :mod:`giantlike.viewer` by their old place, with a warning."""

from giantlike.core.deprecation import forward_names

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.viewer": "Session backplanes_of explain layers_of",
        "giantlike.viewer.layers": "LAYERS MarkLayer",
        "giantlike.viewer.planes": "with_terminators write_backplanes",
        "giantlike.viewer.session": "SeenImage verdict_of",
    },
    until="0.4",
)
