"""Control networks: points, poses, and the rotation and size of a body, adjusted to measures in many images."""

from giantlike.network.adjust import adjust
from giantlike.network.files import write_network
from giantlike.network.isis import read_isis
from giantlike.network.landmarks import FoundTracks, LandmarkMeasures, TrackOptions, find_tracks, photo_of
from giantlike.network.options import NetworkOptions
from giantlike.network.photos import Photo, Tracks
from giantlike.network.result import NetworkFix
from giantlike.network.rotation import Rotating
from giantlike.network.spc import pck_of, read_spc, write_spc

__all__ = [
    "FoundTracks",
    "LandmarkMeasures",
    "NetworkFix",
    "NetworkOptions",
    "Photo",
    "Rotating",
    "TrackOptions",
    "Tracks",
    "adjust",
    "find_tracks",
    "pck_of",
    "photo_of",
    "read_isis",
    "read_spc",
    "write_network",
    "write_spc",
]
