"""Limbs in arrays: scans across an outline, the search for a whole outline, edges and segmentation."""
