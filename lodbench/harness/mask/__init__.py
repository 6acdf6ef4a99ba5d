"""Masks corrected by people: strokes, a page, and polygons for other programs."""
