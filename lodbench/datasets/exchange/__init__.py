"""Posed images in the formats of other programs: one module per format, reader and writer together."""
