"""Whole files or none, under the name by which the layers above ``io`` know them."""

from giantlike.core.atomic import write_bytes_atomic, write_text_atomic

__all__ = ["write_bytes_atomic", "write_text_atomic"]
