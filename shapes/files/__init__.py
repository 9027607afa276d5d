"""The file formats of shapes, one module each: bytes to a raw surface, and a mesh to bytes.

``formats`` chooses by the end of the file name; only ``giantlike.shapes.load`` and ``save`` speak to it.
"""
